"""The job `imports`: load a measurement folder into the store."""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import Field, field_validator
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service.base.errors import ConflictError
from service.base.fields import Model, Text
from service.base.progress import NamedSteps
from service.base.settings import Settings
from service.jobs.kind import Context, Kind, Result
from service.jobs.uploads import content_of, find_upload, import_of
from service.sources.files import confined_to
from service.sources.folder import MeasurementFolder, read_folder
from service.store.job_tables import JobRow
from service.store.rows import serialize_writers
from service.twin.importing import Imported, import_folder
from service.twin.runtime import Runtime


class ImportIn(Model):
    """Load a measurement folder on the service's machine, inside the folder that its operator
    allowed.
    """

    folder: Text = Field(
        min_length=1,
        description="Path relative to the allowed folder; `.` is that folder itself.",
        examples=["stj"],
    )
    uploaded: bool = Field(default=False, description="`folder` is the name of an uploaded one.")

    @field_validator("folder")
    @classmethod
    def _normalise(cls, folder: str) -> str:
        """`./stj` and `stj/` are `stj`."""
        return str(PurePosixPath(folder))


def import_root(settings: Settings) -> Path:
    """The folder whose subfolders may be imported; ConflictError if the operator allowed none."""
    if settings.import_root is None:
        raise ConflictError(
            "no folder may be imported: the operator sets HELIOTWIN_IMPORT_ROOT first"
        )
    return settings.import_root


def allowed_folder(root: Path, folder: str) -> Path:
    """The folder of this name inside ``root``, with links and ``..`` resolved.

    Raises
    ------
    InvalidInputError
        If it does not exist or is outside.
    """
    top = root.resolve()
    path = (top / folder).resolve()
    # The answer is the same for missing and outside folders, so that it reveals nothing about the
    # disk.
    if not path.is_relative_to(top) or not path.is_dir():
        raise InvalidInputError(
            f"folder: there is no folder {folder!r} under the one that may be imported"
        )
    return path


def _require_folder(payload: ImportIn, runtime: Runtime) -> None:
    if not payload.uploaded:
        import_root(runtime.settings)


def _job_of_upload(session: Session, payload: ImportIn, settings: Settings) -> JobRow | None:
    """The job of an upload, or None if it has none yet.

    Raises
    ------
    NotFoundError
        If there is neither the job nor the upload.
    """
    if not payload.uploaded:
        return None
    serialize_writers(session)
    job = import_of(session, [payload.folder]).get(payload.folder)
    if job is None:
        find_upload(settings, payload.folder)
    return job


def import_allowed(context: Context, payload: ImportIn) -> Result:
    """Import the plant, heliostats, images and measured surfaces of a folder; keep existing ones.

    Files that cannot be read, or that a link leads to outside of the allowed folder, are skipped.
    """
    settings = context.runtime.settings
    if payload.uploaded:
        root = folder = content_of(settings, payload.folder)
    else:
        root = import_root(settings)
        folder = allowed_folder(root, payload.folder)
    with confined_to(root):
        return _import(context, read_folder(folder, whole_field=True))


def _import(context: Context, folder: MeasurementFolder) -> Result:
    images = [
        len(item.images)
        for name in folder.plant.heliostats
        for item in folder.measurements(name, False)
    ]
    steps = NamedSteps(
        len(folder.plant.heliostats) + sum(images), context.report, "heliostats and images"
    )
    imported = Imported()
    with context.keeping("import", imported.to_json):
        return Result(import_folder(context.runtime, folder, steps, context.created_by, imported))


def _until_then(steps: Mapping[str, Mapping[str, Any]]) -> Mapping[str, object]:
    """The partial result of a cancelled import, which is a single step."""
    return next(iter(steps.values()), {})


KIND = Kind(
    "imports",
    ImportIn,
    import_allowed,
    "Load a measurement folder into the store.",
    so_far=_until_then,
    require=_require_folder,
    existing=_job_of_upload,
)
