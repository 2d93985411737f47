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
        version = model_versions.current_version(session)
        model, mirrors = model_versions.get_model(session), read_mirrors(session)
    context.report(0.0, phase="heliostats", n_done=0, n_total=len(mirrors))
    choice = find_camera(context.runtime, model, mirrors)
    found = {"answer": None} if choice is None else choice.to_json()
    return Result({**found, "model_version": version})


def due(session: Session, _settings: Settings) -> str | None:
    """The key of a due job: for each version of the model, and whenever images have doubled."""
    if model_versions.declares_camera(session) or (count := count_images(session)) < MIN_IMAGES:
        return None
    current = model_versions.find_current(session)
    version = 0 if current is None else current.number
    return f"camera-choices-{version}-{(count // MIN_IMAGES).bit_length()}"


KIND = Kind(
    "camera-choices",
    CameraChoicesIn,
    choose,
    "Choose the camera of images without background.",
    due=due,
)
