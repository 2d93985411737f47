"""The job `imports`: load a measurement folder into the store."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from model.errors import InvalidInputError
from service.base.errors import ConflictError
from service.base.fields import Model, Text
from service.base.progress import Steps
from service.base.settings import Settings
from service.jobs.kind import Context, Kind, Result
from service.sources.files import confined_to
from service.sources.folder import MeasurementFolder, read_folder
from service.twin.transfer.importing import Imported, import_folder


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


def allowed_root(settings: Settings, *, uploaded: bool = False) -> Path:
    """The folder whose subfolders may be imported; ConflictError if the operator allowed none."""
    if uploaded:
        return settings.uploads_dir
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
            f"folder: there is no folder {folder!r} under the one that may be imported; an uploaded"
            " one is deleted after its import, or after a day"
        )
    return path


def import_allowed(context: Context, payload: ImportIn) -> Result:
    """Import the plant, heliostats, images and measured surfaces of a folder; keep existing ones.

    Files that cannot be read, or that a link leads to outside of the allowed folder, are skipped.
    """
    root = allowed_root(context.runtime.settings, uploaded=payload.uploaded)
    with confined_to(root):
        return _import(context, read_folder(allowed_folder(root, payload.folder), whole_field=True))


def _import(context: Context, folder: MeasurementFolder) -> Result:
    images = [
        len(item.images)
        for name in folder.plant.heliostats
        for item in folder.measurements(name, False)
    ]
    steps = Steps(
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
    require=lambda payload, settings: allowed_root(settings, uploaded=payload.uploaded),
)
