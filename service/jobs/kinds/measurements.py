"""The job `measurements`: stored photographs measured anew, by today's cameras and as this version measures."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from pydantic import Field

from service import store
from service.base.faults import SKIPPED, GoneError
from service.base.fields import Model
from service.jobs.common import Heliostats, chosen_names, require_some
from service.jobs.kind import Context, Kind, Result
from service.twin.correcting import measure_anew


class MeasurementsIn(Model):
    """Measure the stored photographs of many heliostats anew: a camera was declared since, or heliotwin is newer.

    What changes is kept in each photograph's history. Surfaces that were made from them stay, until they are predicted
    anew.
    """

    heliostats: Heliostats = None
    reason: str = Field(
        default="measured anew", min_length=1, max_length=500, description="Why; kept in the history of each."
    )


def measure_many(context: Context, payload: MeasurementsIn) -> Result:
    """Every photograph whose image is kept, heliostat by heliostat; begun again it goes on with what is left."""
    names, done = chosen_names(context.runtime, payload.heliostats), context.steps()
    for index, name in enumerate(names):
        context.report(index / len(names), name)
        if name not in done:
            step: dict[str, Any] = {"measured": 0, "changed": 0, "gone": 0, "skipped": {}}
            with context.keeping(name, partial(dict, step)):
                _measure_step(context, name, payload.reason, index / len(names), step)
            with context.runtime.database.writing() as session:
                context.keep(session, name, step)
    made = counts(context.steps())
    require_some(made["measured"] + made["gone"], made["skipped"])
    return Result(made)


def counts(steps: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """How many photographs were measured, changed, or have no image any more; what was skipped, and why."""
    total = {kind: sum(step[kind] for step in steps.values()) for kind in ("measured", "changed", "gone")}
    return total | {"skipped": {name: why for step in steps.values() for name, why in step["skipped"].items()}}


def _measure_step(context: Context, name: str, reason: str, progress: float, step: dict[str, Any]) -> None:
    """Measure a heliostat's photographs; what came of each is counted in ``step``."""
    try:
        with context.runtime.database.reading() as session:
            identifiers = store.list_identifiers(session, store.get_heliostat(session, name))
    except SKIPPED as error:
        step["skipped"][name] = str(error)
        return
    for identifier in identifiers:
        context.report(progress, f"{name} {identifier}")
        try:
            step["changed"] += measure_anew(context.runtime, name, identifier, reason, context.created_by)
            step["measured"] += 1
        except GoneError:
            step["gone"] += 1
        except SKIPPED as error:
            step["skipped"][f"{name} {identifier}"] = str(error)


KIND = Kind(
    "measurements",
    MeasurementsIn,
    measure_many,
    "Measure stored photographs anew, by today's cameras.",
    so_far=counts,
)
