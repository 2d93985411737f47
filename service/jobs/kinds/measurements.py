"""The job `measurements`: re-measure stored photographs with the current cameras and version."""

from collections.abc import Mapping
from typing import Any, TypedDict, get_args

from pydantic import Field

from service import store
from service.base.choices import Method
from service.base.errors import SKIPPED, ConflictError, GoneError
from service.base.fields import Model, Reason
from service.jobs.enqueuing import enqueue
from service.jobs.kind import Context, Heliostats, Kind, Result, chosen_names, require_some
from service.jobs.kinds import predictions
from service.jobs.kinds.predictions import PredictionsIn
from service.twin import model_versions
from service.twin.photographs.corrections import remeasure
from service.twin.runtime import Runtime


class MeasurementsIn(Model):
    """Re-measure the stored photographs of many heliostats.

    This is useful after a camera was declared or heliotwin was updated. Each photograph's history
    records what changed. Surfaces from these photographs remain until they are predicted again.
    """

    camera: model_versions.CameraAnswer | None = Field(
        default=None,
        description=(
            "First declare what images without background are: srgb, differences of sRGB counts as"
            " PAINT's, or linear light. Afterwards surfaces are predicted again."
        ),
    )

    heliostats: Heliostats = None
    reason: Reason = Field(
        default="measured again", description="Why; kept in the history of each."
    )


class Remeasured(TypedDict):
    """Numbers of measured and changed photographs and of those without image; skipped ones."""

    measured: int
    changed: int
    gone: int
    skipped: dict[str, str]


def measure_many(context: Context, payload: MeasurementsIn) -> Result:
    """Re-measure every photograph that still has its image, by heliostat.

    After a restart the job continues with the remaining ones.
    """
    names, done = chosen_names(context.runtime, payload.heliostats), context.steps()
    if payload.camera is not None and not done:
        with context.runtime.database.writing() as session:
            model_versions.declare_camera(
                session, payload.camera, context.created_by, payload.reason
            )
    for index, name in enumerate(names):
        context.report(
            index / len(names), name, phase="heliostats", n_done=index, n_total=len(names)
        )
        if name not in done:
            step: Remeasured = {"measured": 0, "changed": 0, "gone": 0, "skipped": {}}
            with context.keeping(name, step.copy):
                _measure_step(context, name, payload.reason, (index, len(names)), step)
            with context.runtime.database.writing() as session:
                context.keep(session, name, step)
    figures = counts(context.steps())
    require_some(figures["measured"] + figures["gone"], figures["skipped"])
    if payload.camera is not None:
        _predict_again(context)
    return Result(figures)


def _predict_again(context: Context) -> None:
    """Queue predictions of active surfaces that another version of the model made."""
    with context.runtime.database.reading() as session:
        outdated = store.outdated_surfaces(session, model_versions.current_version(session))
    for method in get_args(Method):  # that of the active surface
        names = [one.heliostat for one in outdated if one.source == method and not one.waits]
        if names:
            payload, key = PredictionsIn(heliostats=names, method=method), context.lease.job_id
            by = context.created_by
            enqueue(context.runtime, predictions.KIND, payload, by, f"after-{key}-{method}")


def _require_undeclared(payload: MeasurementsIn, runtime: Runtime) -> None:
    with runtime.database.reading() as session:
        if payload.camera is not None and model_versions.declares_camera(session):
            raise ConflictError("camera: the plant's model declares its cameras already")


def counts(steps: Mapping[str, Mapping[str, Any]]) -> Remeasured:
    """Sum the counts of the steps."""
    each = steps.values()
    return {
        "measured": sum(step["measured"] for step in each),
        "changed": sum(step["changed"] for step in each),
        "gone": sum(step["gone"] for step in each),
        "skipped": {name: reason for step in each for name, reason in step["skipped"].items()},
    }


def _measure_step(
    context: Context, name: str, reason: str, place: tuple[int, int], step: Remeasured
) -> None:
    """Re-measure the photographs of a heliostat and count the outcomes in ``step``.

    ``place`` is the index of the heliostat and the total number.
    """
    index, total = place
    try:
        with context.runtime.database.reading() as session:
            identifiers = store.list_identifiers(session, store.get_heliostat(session, name))
    except SKIPPED as error:
        step["skipped"][name] = str(error)
        return
    for number, identifier in enumerate(identifiers):
        share = (index + number / len(identifiers)) / total
        context.report(
            share, f"{name} {identifier}", phase="heliostats", n_done=index, n_total=total
        )
        try:
            step["changed"] += remeasure(
                context.runtime, name, identifier, reason, context.created_by
            )
            step["measured"] += 1
        except GoneError:
            step["gone"] += 1
        except SKIPPED as error:
            step["skipped"][f"{name} {identifier}"] = str(error)


KIND = Kind(
    "measurements",
    MeasurementsIn,
    measure_many,
    "Measure stored photographs again, by the current cameras.",
    so_far=counts,
    require=_require_undeclared,
)
