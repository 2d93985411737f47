"""The job `imports`: a measurement folder into the store."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from model.errors import InvalidInputError
from service.base.faults import ConflictError
from service.base.fields import Model
from service.base.progress import Steps
from service.base.settings import Settings
from service.jobs.kind import Context, Kind, Result
from service.sources.files import require_regular
from service.sources.folder import read_folder
from service.twin.importing import Imported, import_folder


class ImportIn(Model):
    """Load a measurement folder that lies on the service's machine, under the folder that its operator allowed."""

    folder: str = Field(
        min_length=1,
        max_length=500,
        pattern=r"^[^\x00-\x1f\x7f]+$",
        description="Path relative to the allowed folder; `.` is that folder itself.",
        examples=["stj"],
    )


def allowed_root(settings: Settings) -> Path:
    """The folder whose subfolders may be imported; ConflictError where the operator allowed none."""
    if settings.import_root is None:
        raise ConflictError("no folder may be imported: the operator sets HELIOTWIN_IMPORT_ROOT first")
    return settings.import_root


def _require_root(settings: Settings) -> None:
    allowed_root(settings)


def allowed_folder(root: Path, folder: str) -> Path:
    """The folder of this name under ``root``; nothing that a link or a ``..`` leads to outside of it.

    Raises
    ------
    InvalidInputError
        Where it is none, leads outside, or holds a link that does, or what is no file of a bearable size: a pipe would
        be waited for without end, and the job with it.
    """
    top = root.resolve()
    path = (top / folder).resolve()
    # The answer is the same for what does not exist and what lies outside: it tells nothing of the rest of the disk.
    if not path.is_relative_to(top) or not path.is_dir():
        raise InvalidInputError(f"folder: there is no folder {folder!r} under the one that may be imported")
    for entry in path.rglob("*"):
        if entry.is_symlink() and not entry.resolve().is_relative_to(top):
            raise InvalidInputError(f"folder: {entry.relative_to(top)} leads outside; copy what it links to")
        if not entry.is_dir():
            require_regular(entry, f"folder: {entry.relative_to(top)}")
    return path


def import_allowed(context: Context, payload: ImportIn) -> Result:
    """The plant, heliostats, images and measured surfaces of a folder; what is there already stays as it is."""
    folder = read_folder(allowed_folder(allowed_root(context.runtime.settings), payload.folder))
    images = [len(item.images) for name in folder.plant.heliostats for item in folder.measurements(name, False)]
    steps = Steps(len(folder.plant.heliostats) + sum(images), context.report)
    made = Imported()
    with context.keeping("import", made.to_json):
        return Result(import_folder(context.runtime, folder, steps, context.created_by, made))


def _until_then(steps: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """What a cancelled import had done: it is one step."""
    return next((dict(step) for step in steps.values()), {})


KIND = Kind(
    "imports",
    ImportIn,
    import_allowed,
    "Load a measurement folder into the store.",
    so_far=_until_then,
    require=_require_root,
)
