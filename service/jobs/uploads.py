"""Measurement folders that were uploaded as ZIP files, stored until their import has ended."""

import logging
import re
import secrets
import shutil
import time
from pathlib import Path
from typing import IO

from pydantic import BaseModel, Field
from sqlalchemy import select

from model.errors import InvalidInputError
from service.base.errors import TooManyError
from service.base.settings import Settings
from service.sources.archive import unpack_archive
from service.sources.files import confined_to
from service.sources.folder import read_folder
from service.store.job_tables import JobRow
from service.store.jobs.queue import ENDED
from service.twin.runtime.runtime import Runtime

logger = logging.getLogger("heliotwin.jobs")

_MAX_UPLOADS = 20
# An upload without an import is deleted after so long [s].
_UNUSED_S = 24 * 3600.0


class UploadedFolder(BaseModel):
    """What an uploaded folder has."""

    folder: str = Field(description="Name: that of the ZIP file, and a random number.")
    n_heliostats: int = Field(description="Number of heliostats.")
    n_measurements: int = Field(description="Number of measurements, with an image or without.")
    n_unreadable: int = Field(description="Number of entries that its import will skip.")


def receive_upload(settings: Settings, file: IO[bytes], name: str) -> UploadedFolder:
    """Unpack and check a ZIP file called ``name``.

    Raises
    ------
    InvalidInputError
        If it is no ZIP file, or has no measurement folder.
    TooManyError
        If many uploads wait for their import.
    """
    stem = re.sub(r"[^A-Za-z0-9]+", "-", Path(name).stem)[:40] or "folder"
    folder = settings.uploads_dir / f"{stem}-{secrets.token_hex(8)}"
    folder.mkdir(parents=True)
    try:
        if len(list(settings.uploads_dir.iterdir())) > _MAX_UPLOADS:
            raise TooManyError(f"file: {_MAX_UPLOADS} uploads wait for their import; import some")
        unpack_archive(file, folder, settings.max_unpacked_bytes)
        return read_upload(folder)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def read_upload(path: Path) -> UploadedFolder:
    """Count what an upload has; InvalidInputError if it is no measurement folder."""
    try:
        with confined_to(path):
            folder = read_folder(path, whole_field=True)
            names = folder.plant.heliostats
            count = sum(len(folder.measurements(name, with_images=False)) for name in names)
    except InvalidInputError as error:
        raise InvalidInputError(str(error).replace(str(path), "file")) from None
    return UploadedFolder(
        folder=path.name,
        n_heliostats=len(names),
        n_measurements=count,
        n_unreadable=len(folder.skipped),
    )


def delete_unused_uploads(runtime: Runtime) -> None:
    """Delete the uploads whose import has ended, and old ones that nobody imported."""
    uploads = runtime.settings.uploads_dir
    folders = list(uploads.iterdir()) if uploads.is_dir() else []
    if not folders:
        return
    name = JobRow.payload["folder"].as_string()
    imports = select(name, JobRow.state).where(name.in_([folder.name for folder in folders]))
    with runtime.database.reading() as session:
        jobs = session.execute(imports).all()
    needed = {name for name, state in jobs if state not in ENDED}
    ended = {name for name, state in jobs} - needed
    for folder in folders:
        try:
            is_old = time.time() - folder.stat().st_mtime > _UNUSED_S
            if folder.name in ended or (is_old and folder.name not in needed):
                shutil.rmtree(folder)
        except OSError as error:
            if folder.exists():  # else another process deleted it at the same time
                logger.error("upload %s is not deleted: %s", folder.name, error)
