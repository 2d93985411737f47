"""Measurement folders that were uploaded as ZIP files, stored until their import has ended.

An upload is the folder ``uploads/NAME`` with its record `upload.json` and its ``content``. While it
is unpacked or deleted, its name begins with a dot, and its lock file is held.
"""

import logging
import re
import secrets
import shutil
from collections.abc import Collection, Iterable
from contextlib import ExitStack
from datetime import datetime, timedelta
from pathlib import Path
from typing import IO

from pydantic import BaseModel, Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service.base.errors import ConflictError, NotFoundError, StoreFullError, TooManyError
from service.base.processes import file_lock
from service.base.settings import Settings
from service.sources.files import confined_to, unpack_archive
from service.sources.folder import read_folder
from service.store import audit
from service.store.columns import now
from service.store.job_tables import JobRow
from service.store.plant import require_origin
from service.store.queue import ENDED
from service.twin.runtime import Runtime

logger = logging.getLogger("heliotwin.jobs")

MAX_UPLOADS_OF_KEY = 5
"""Most uploads of one key that wait for the end of their import."""

# An upload without an import is deleted after so long.
_UNUSED = timedelta(hours=24)

_RECORD, _CONTENT, _LOCK = "upload.json", "content", "lock"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9-]{0,80}")


class UploadedFolder(BaseModel):
    """An uploaded folder, and what it has."""

    folder: str = Field(description="Name: that of the ZIP file, and a random number.")
    created_at: datetime = Field(
        default_factory=now,
        description="When it was uploaded. It is deleted a day later, if it is not imported.",
    )
    created_by: str = Field(description="Name of the key that uploaded it.")
    size_bytes: int = Field(description="Size of its files [bytes].")
    n_heliostats: int = Field(0, description="Number of heliostats.")
    n_measurements: int = Field(0, description="Number of measurements, with an image or without.")
    n_images: int = Field(0, description="Number of images.")
    n_unreadable: int = Field(0, description="Number of entries that its import will skip.")
    job: int | None = Field(
        None, description="Id of the job that imports it; null: no import was requested."
    )


def receive_upload(runtime: Runtime, file: IO[bytes], name: str, actor: str) -> UploadedFolder:
    """Unpack and check a ZIP file called ``name``.

    Raises
    ------
    InvalidInputError
        If it is no ZIP file, or has no measurement folder.
    ConflictError
        If it is of another plant.
    TooLargeError
        If it is too large unpacked.
    TooManyError
        If the uploads of the key ``actor`` already take its share.
    StoreFullError
        If the disk has no space for the folder and its import.
    """
    stem = re.sub(r"[^A-Za-z0-9]+", "-", Path(name).stem).strip("-")[:40] or "folder"
    folder = f"{stem}-{secrets.token_hex(8)}"
    partial = runtime.settings.uploads_dir / f".{folder}"
    with ExitStack() as lock:

        def admit(size_bytes: int) -> None:
            upload = UploadedFolder(folder=folder, created_by=actor, size_bytes=size_bytes)
            with runtime.database.changing():
                _require_share(runtime.settings, upload)
                (partial / _CONTENT).mkdir(parents=True)
                lock.enter_context(file_lock(partial / _LOCK))
                _write_record(partial, upload)

        most = runtime.settings.max_unpacked_bytes
        try:
            unpack_archive(file, partial / _CONTENT, most, admit)
            upload = _load(partial)
            assert upload is not None, "it was admitted"
            upload = upload.model_copy(update=_count(runtime, partial / _CONTENT))
            _write_record(partial, upload)
            with runtime.database.changing() as session:
                about = {"file": name[:200], "n_measurements": upload.n_measurements}
                audit.record(session, actor, "upload.received", f"upload {folder}", **about)
                partial.rename(partial.with_name(folder))
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
    return upload


def _require_share(settings: Settings, upload: UploadedFolder) -> None:
    """Raise TooManyError or StoreFullError if a key's share or the disk is too small for it."""
    known = {path: there for path in _paths(settings) if (there := _load(path)) is not None}
    sizes = [there.size_bytes for there in known.values() if there.created_by == upload.created_by]
    most = settings.max_unpacked_bytes
    if len(sizes) >= MAX_UPLOADS_OF_KEY or sum(sizes) + upload.size_bytes > most:
        raise TooManyError(
            f"file: {len(sizes)} uploads of {upload.created_by} wait, with {sum(sizes)} bytes;"
            f" {MAX_UPLOADS_OF_KEY} with {most} bytes are the most: import or delete some"
        )
    # What others are unpacking now may not be on the disk yet.
    unpacking = sum(there.size_bytes for path, there in known.items() if path.name.startswith("."))
    settings.uploads_dir.mkdir(parents=True, exist_ok=True)
    free = max(0, shutil.disk_usage(settings.uploads_dir).free - unpacking)
    if 2 * upload.size_bytes > free:
        raise StoreFullError(
            f"file: it takes {upload.size_bytes} bytes unpacked, and its import as many again, but"
            f" the disk of the service has {free} free; delete uploads, or ask its operator for"
            " space"
        )


def _count(runtime: Runtime, path: Path) -> dict[str, int]:
    """Count what a folder has.

    InvalidInputError if it is no measurement folder, ConflictError if it is another plant's.
    """
    try:
        with confined_to(path):
            folder = read_folder(path, whole_field=True)
            names = folder.plant.heliostats
            measurements = [one for name in names for one in folder.measurements(name, False)]
    except InvalidInputError as error:
        raise InvalidInputError(str(error).replace(str(path), "file")) from None
    with runtime.database.reading() as session:
        require_origin(session, folder.plant.name, folder.plant.origin)
    return {
        "n_heliostats": len(names),
        "n_measurements": len(measurements),
        "n_images": sum(len(one.images) for one in measurements),
        "n_unreadable": len(folder.skipped),
    }


def _paths(settings: Settings) -> list[Path]:
    uploads = settings.uploads_dir
    return list(uploads.iterdir()) if uploads.is_dir() else []


def _load(path: Path) -> UploadedFolder | None:
    """The record of an upload; None without one."""
    try:
        return UploadedFolder.model_validate_json((path / _RECORD).read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        return None


def _write_record(path: Path, upload: UploadedFolder) -> None:
    """Write an upload's record so that a reader finds all of it or that of before."""
    file = path / f"{_RECORD}.new"
    file.write_text(upload.model_dump_json(exclude={"job"}))
    file.replace(path / _RECORD)


def find_upload(settings: Settings, name: str) -> UploadedFolder:
    """An upload by its name; NotFoundError if there is none."""
    upload = _load(settings.uploads_dir / name) if _NAME.fullmatch(name) else None
    if upload is None:
        raise NotFoundError(
            f"there is no upload {name!r}: an upload is deleted after its import, or after a day"
        )
    return upload


def content_of(settings: Settings, name: str) -> Path:
    """The measurement folder of an upload; NotFoundError if there is no such upload."""
    return settings.uploads_dir / find_upload(settings, name).folder / _CONTENT


def import_of(session: Session, names: Collection[str]) -> dict[str, JobRow]:
    """The jobs that import uploads, by their names; each upload has one at most."""
    name, uploaded = JobRow.payload["folder"].as_string(), JobRow.payload["uploaded"].as_boolean()
    query = select(name, JobRow).where(JobRow.kind == "imports", uploaded, name.in_(names))
    return dict(session.execute(query).all())


def list_uploads(runtime: Runtime) -> list[UploadedFolder]:
    """All uploads that were unpacked, oldest first."""
    paths = [path for path in _paths(runtime.settings) if not path.name.startswith(".")]
    found = [upload for path in paths if (upload := _load(path)) is not None]
    with runtime.database.reading() as session:
        jobs = import_of(session, [upload.folder for upload in found])
    shown = [
        upload.model_copy(update={"job": jobs[upload.folder].id if upload.folder in jobs else None})
        for upload in found
    ]
    return sorted(shown, key=lambda upload: upload.created_at)


def delete_upload(runtime: Runtime, name: str, actor: str) -> None:
    """Delete an upload, and audit it.

    Raises
    ------
    NotFoundError
        If there is no such upload.
    ConflictError
        If a job is to import it.
    """
    with runtime.database.changing() as session:
        upload = _set_aside(session, runtime.settings, name)
        audit.record(
            session, actor, "upload.deleted", f"upload {name}", size_bytes=upload.size_bytes
        )
    _remove([runtime.settings.uploads_dir / f".{name}"])


def _set_aside(session: Session, settings: Settings, name: str) -> UploadedFolder:
    """Rename an upload so that nobody finds it; ConflictError if a job is to import it."""
    upload, job = find_upload(settings, name), import_of(session, [name]).get(name)
    if job is not None and job.state not in ENDED:
        raise ConflictError(f"job {job.id} imports the upload {name}; cancel it first")
    (settings.uploads_dir / name).rename(settings.uploads_dir / f".{name}")
    return upload


def delete_unused_uploads(runtime: Runtime) -> None:
    """Delete uploads whose import has ended, old ones that nobody imported, and left-overs.

    A left-over is of a process that was killed while it unpacked or deleted an upload.
    """
    settings = runtime.settings
    if not _paths(settings):
        return
    with runtime.database.reading() as session:
        jobs = import_of(session, [path.name for path in _paths(settings)])
    before = now() - _UNUSED
    for upload in list_uploads(runtime):
        job = jobs.get(upload.folder)
        if upload.created_at < before if job is None else job.state in ENDED:
            try:
                with runtime.database.changing() as session:
                    _set_aside(session, settings, upload.folder)
            except (NotFoundError, ConflictError) as error:  # somebody was faster
                logger.info("upload %s is not deleted: %s", upload.folder, error)
    with runtime.database.changing():  # a folder is locked before another process sees it
        left = [path for path in _paths(settings) if path.name[0] == "." or _load(path) is None]
    _remove(left)


def _remove(paths: Iterable[Path]) -> None:
    """Delete what no process works on."""
    for path in paths:
        try:
            if path.is_dir():
                with file_lock(path / _LOCK, wait=False) as is_free:
                    if is_free:
                        shutil.rmtree(path)
            else:
                path.unlink()
        except OSError as error:
            if path.exists():  # else another process deleted it at the same time
                logger.error("upload %s is not deleted: %s", path.name, error)
