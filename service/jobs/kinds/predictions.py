"""The job `predictions`: predict the surfaces of many heliostats."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, TypedDict

import numpy as np
from pydantic import Field, model_validator

from model.progress import Progress
from service import store
from service.base.choices import require_images
from service.base.errors import SKIPPED
from service.base.fields import Method, Model, ModelVersion, Moment, Whole
from service.jobs.kind import Context, Heliostats, Kind, Result, chosen_names, require_some
from service.sources.documents import read_heliostat
from service.sources.schema import STORED
from service.twin import model_versions
from service.twin.runtime import Runtime
from service.twin.surfaces.evaluation import PARTS
from service.twin.surfaces.prediction import (
    READING,
    STORING,
    MeasurementChoice,
    StoredSurface,
    compute_surface,
    keep_surface,
    share_of,
)


class PredictionsIn(Model):
    """Predict the surfaces of many heliostats, each from its newest accepted measurements.

    A new surface becomes active, unless the active one forecasts unseen photographs better or is
    from a higher-ranked source.
    """

    heliostats: Heliostats = None
    method: Method = Field(
        default="network",
        description=(
            "network: at once, if one was trained for the mirror; otherwise as refined. refined:"
            " fitted through the ray tracer, which takes up to minutes."
        ),
    )
    images: Whole = Field(
        default=8,
        ge=1,
        le=64,
        description="How many measurements to take of each heliostat; 8 the network.",
    )
    since: Moment | None = Field(
        default=None,
        description=(
            "Only measurements taken since then, when the mirror changed: they judge the surface,"
            " and an active one begins an epoch. null: since the present epoch began."
        ),
    )
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _not_too_many(self) -> Self:
        require_images(self.method, self.images)
        return self


def predict_many(context: Context, payload: PredictionsIn) -> Result:
    """Store a new surface version of each heliostat, once each even if the job restarts."""
    names, done = chosen_names(context.runtime, payload.heliostats), context.steps()
    version = _model_number(context.runtime, payload.model_version)
    for index, name in enumerate(names):
        progress = _Progress(context, name, index, len(names))
        progress(READING, 0, 1)
        if name not in done:
            _predict_step(context, payload, name, version, progress)
    figures = changes(context.steps())
    require_some(len(figures["surfaces"]) + len(figures["unchanged"]), figures["skipped"])
    return Result(figures)


class PredictionReport(TypedDict):
    """Results by heliostat: new and unchanged versions, comparisons with the active one, skipped
    ones.
    """

    surfaces: dict[str, int]
    unchanged: dict[str, int]
    judged: dict[str, object]
    skipped: dict[str, str]


def changes(steps: Mapping[str, Mapping[str, Any]]) -> PredictionReport:
    """Collect the results of the steps."""

    def by_heliostat(key: str) -> dict[str, Any]:
        return {name: step[key] for name, step in steps.items() if step.get(key) is not None}

    return {
        "surfaces": by_heliostat("version"),
        "unchanged": by_heliostat("unchanged"),
        "judged": by_heliostat("judged"),
        "skipped": by_heliostat("skipped"),
    }


def _model_number(runtime: Runtime, number: int | None) -> int:
    """The number of the requested or current model version, the same for a whole job."""
    with runtime.database.reading() as session:
        return model_versions.get_model(session, number).number


@dataclass(frozen=True, eq=False)
class _Progress:
    """Progress of heliostat ``index`` of ``total``, as a part of the whole job."""

    context: Context
    name: str
    index: int
    total: int

    def __call__(self, what: str, done: int, steps: int) -> None:
        counts = (
            ("surfaces of heliostats", self.index, self.total)
            if self.total > 1
            else (what, done, steps)
        )
        phase, n_done, n_total = counts
        share = (self.index + share_of(what, done, steps)) / self.total
        self.context.report(
            share, f"{self.name}: {what}", phase=phase, n_done=n_done, n_total=n_total
        )


def _predict_step(
    context: Context, payload: PredictionsIn, name: str, model_version: int, progress: Progress
) -> None:
    try:
        predicted = compute_surface(
            context.runtime,
            name,
            payload.method,
            MeasurementChoice(payload.images, payload.since),
            model_version=model_version,
            progress=progress,
        )
        progress(STORING, 0, 1)
        with context.runtime.database.writing() as session:
            context.keep(session, name, _step(keep_surface(session, predicted, context.created_by)))
    except SKIPPED as error:
        with context.runtime.database.writing() as session:
            context.keep(session, name, {"skipped": str(error)})


def _step(stored: StoredSurface) -> dict[str, object]:
    """The result for a heliostat."""
    if not stored.is_new:
        return {"unchanged": stored.row.version}
    decision = stored.decision
    judged = (
        None
        if decision is None
        else {
            "became_active": decision.became_active,
            "against": decision.previous,
            "before": decision.accuracy_before,
            "after": decision.accuracy_after,
            "photographs": decision.photographs,
            "reason": decision.reason,
        }
    )
    return {"version": stored.row.version, "judged": judged}


EACH_S: Mapping[Method, float] = {
    "network": 0.5 * (1 + PARTS["network"]),
    "refined": 60.0 * (1 + PARTS["refined"]),
}
"""Stated duration per heliostat [s] by method, cross-validation included."""

# Heliostats whose type is looked up for all of a job.
_SAMPLE = 50


def expected_s(payload: PredictionsIn, runtime: Runtime) -> float:
    """Estimated duration [s]; mirrors that no network was trained for are refined."""
    names = chosen_names(runtime, payload.heliostats)
    refined = 1.0 if payload.method == "refined" else _share_refined(runtime, names[:_SAMPLE])
    return len(names) * (refined * EACH_S["refined"] + (1 - refined) * EACH_S["network"])


def _share_refined(runtime: Runtime, names: Sequence[str]) -> float:
    """Share of heliostats that no network was trained for; 0 of those that are not stored."""
    with runtime.database.reading() as session:
        rows = store.get_heliostats(session, names)
        if not rows:
            return 0.0
        origin = np.array(store.get_plant(session).origin)
    mirrors = [read_heliostat(name, row.properties, origin, STORED) for name, row in rows.items()]
    return sum(not runtime.operations.has_network(mirror) for mirror in mirrors) / len(mirrors)


KIND = Kind(
    "predictions",
    PredictionsIn,
    predict_many,
    "Predict the surfaces of many heliostats.",
    so_far=changes,
    expected_s=expected_s,
)
