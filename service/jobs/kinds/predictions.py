"""The job `predictions`: surfaces of many heliostats."""

from pydantic import Field

from service.base.faults import SKIPPED
from service.base.fields import Method, Model, ModelVersion, Whole
from service.jobs.common import Heliostats, chosen_names, require_some
from service.jobs.kind import Context, Kind, Result
from service.twin import versions
from service.twin.prediction import compute_surface, keep_surface
from service.twin.runtime import Runtime


class PredictionsIn(Model):
    """Predict the surfaces of many heliostats, each from its newest accepted measurements."""

    heliostats: Heliostats = None
    method: Method = Field(default="network", description="network: at once; refined: fitted through the ray tracer.")
    images: Whole = Field(default=8, ge=1, le=8, description="How many measurements to take of each heliostat.")
    model_version: ModelVersion = None


def predict_many(context: Context, payload: PredictionsIn) -> Result:
    """A new surface version for each heliostat, once each however often the job is begun."""
    names, done = chosen_names(context.runtime, payload.heliostats), context.steps()
    version = _model_number(context.runtime, payload.model_version)
    for index, name in enumerate(names):
        context.report(index / len(names), name)
        if name not in done:
            _predict_step(context, payload, name, version)
    steps = context.steps()
    skipped = {name: step["skipped"] for name, step in steps.items() if "skipped" in step}
    versions = {name: step["version"] for name, step in steps.items() if "version" in step}
    require_some(len(versions), skipped)
    return Result({"surfaces": versions, "skipped": skipped})


def _model_number(runtime: Runtime, wanted: int | None) -> int:
    """The version of the plant's model that is wanted, or the current one: the same for all heliostats of a job."""
    with runtime.database.reading() as session:
        return versions.get_model(session, wanted).number


def _predict_step(context: Context, payload: PredictionsIn, name: str, model_version: int) -> None:
    try:
        predicted = compute_surface(
            context.runtime, name, payload.method, images=payload.images, model_version=model_version
        )
        with context.runtime.database.writing() as session:
            row = keep_surface(session, predicted, context.created_by)
            context.keep(session, name, {"version": row.version})
    except SKIPPED as error:
        with context.runtime.database.writing() as session:
            context.keep(session, name, {"skipped": str(error)})


KIND = Kind("predictions", PredictionsIn, predict_many, "Predict the surfaces of many heliostats.")
