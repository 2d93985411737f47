"""The job `predictions`: surfaces of many heliostats."""

from collections.abc import Mapping
from typing import Any, Self

from pydantic import Field, model_validator

from service.base.choices import require_images
from service.base.faults import SKIPPED
from service.base.fields import Method, Model, ModelVersion, Whole
from service.jobs.common import Heliostats, chosen_names, require_some
from service.jobs.kind import Context, Kind, Result
from service.twin import versions
from service.twin.prediction import Kept, compute_surface, keep_surface
from service.twin.runtime import Runtime


class PredictionsIn(Model):
    """Predict the surfaces of many heliostats, each from its newest accepted measurements.

    A new surface becomes today's unless the one that is forecasts unseen photographs better, or is better founded.
    """

    heliostats: Heliostats = None
    method: Method = Field(default="network", description="network: at once; refined: fitted through the ray tracer.")
    images: Whole = Field(
        default=8, ge=1, le=64, description="How many measurements to take of each heliostat; 8 the network."
    )
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _not_too_many(self) -> Self:
        require_images(self.method, self.images)
        return self


def predict_many(context: Context, payload: PredictionsIn) -> Result:
    """A new surface version for each heliostat, once each however often the job is begun."""
    names, done = chosen_names(context.runtime, payload.heliostats), context.steps()
    version = _model_number(context.runtime, payload.model_version)
    for index, name in enumerate(names):
        context.report(index / len(names), name)
        if name not in done:
            _predict_step(context, payload, name, version)
    made = changes(context.steps())
    require_some(len(made["surfaces"]) + len(made["unchanged"]), made["skipped"])
    return Result(made)


def changes(steps: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """What was done for each heliostat, by name: new versions, how they compare with today's, and what stays."""
    kinds = {"surfaces": "version", "unchanged": "unchanged", "judged": "judged", "skipped": "skipped"}
    return {
        kind: {name: step[key] for name, step in steps.items() if step.get(key) is not None}
        for kind, key in kinds.items()
    }


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
            context.keep(session, name, _step(keep_surface(session, predicted, context.created_by)))
    except SKIPPED as error:
        with context.runtime.database.writing() as session:
            context.keep(session, name, {"skipped": str(error)})


def _step(kept: Kept) -> dict[str, Any]:
    """What was done for a heliostat."""
    if not kept.is_new:
        return {"unchanged": kept.row.version}
    decision = kept.decision
    judged = (
        None
        if decision is None
        else {
            "taken": decision.taken,
            "against": decision.previous,
            "before": decision.accuracy_before,
            "after": decision.accuracy_after,
            "photographs": decision.photographs,
            "reason": decision.reason,
        }
    )
    return {"version": kept.row.version, "judged": judged}


KIND = Kind("predictions", PredictionsIn, predict_many, "Predict the surfaces of many heliostats.", so_far=changes)
