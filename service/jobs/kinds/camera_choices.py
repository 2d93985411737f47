"""The job `camera-choices`: the camera of stored images without background. Workers start it."""

from sqlalchemy.orm import Session

from model.camera_choice import MIN_IMAGES
from service.base.errors import ConflictError
from service.base.fields import Model
from service.base.settings import Settings
from service.jobs.kind import Context, Kind, Result
from service.twin import model_versions
from service.twin.studies.cameras import count_images, find_camera, read_mirrors


class CameraChoicesIn(Model):
    """Choose the camera by the stored images. There are no options."""


def choose(context: Context, _payload: CameraChoicesIn) -> Result:
    """Compare stored images with forecasts by either camera; nothing is changed.

    Raises
    ------
    ConflictError
        If a camera is declared.
    """
    with context.runtime.database.reading() as session:
        if model_versions.declares_camera(session):
            raise ConflictError("the plant's model declares its cameras; they are not chosen")
        model, mirrors = model_versions.get_model(session), read_mirrors(session)
    context.report(0.0, phase="heliostats", n_done=0, n_total=len(mirrors))
    choice = find_camera(context.runtime, model, mirrors)
    return Result({"answer": None} if choice is None else choice.to_json())


def due(session: Session, _settings: Settings) -> str | None:
    """The key of a due job: the first images, and again as often as their number has doubled."""
    if model_versions.declares_camera(session) or (count := count_images(session)) < MIN_IMAGES:
        return None
    return f"camera-choices-{(count // MIN_IMAGES).bit_length()}"


KIND = Kind(
    "camera-choices",
    CameraChoicesIn,
    choose,
    "Choose the camera of images without background.",
    due=due,
)
