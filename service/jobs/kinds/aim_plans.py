"""The job `aim-plans`: aim points of the most power under the flux that a receiver can take."""

import math
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Discriminator, Field, Tag, field_validator
from sqlalchemy import select

from model.aiming.kernels import aim_in_front
from model.aiming.plan import plan_aims
from model.plant import square_pixels
from service.base.fields import Name, Number, Position, Resolution
from service.jobs.common import require_some
from service.jobs.kind import Context, Kind, Result
from service.jobs.kinds.field_forecasts import FleetForecastIn, expected_s
from service.sources.limits import Limit
from service.store.tables import HeliostatRow
from service.twin.forecasts.aims import ROWS, aim_figures, begin_at
from service.twin.forecasts.field_forecast import (
    HeliostatGroup,
    forecast_group,
    group_warnings,
    trace_kernels,
)
from service.twin.forecasts.heliostat_forecast import position_of, receiver_as_json
from service.twin.runtime.runtime import Runtime

FluxLimit = Annotated[Number, Field(gt=0, le=6e7)]

LimitRow = Annotated[list[FluxLimit], Field(min_length=1, max_length=1024)]


def _way_to_give(value: Any) -> str:
    return "(map)" if isinstance(value, list) else "(number)"


LimitOfMap = Annotated[
    Annotated[FluxLimit, Tag("(number)")] | Annotated[list[LimitRow], Tag("(map)")],
    Discriminator(_way_to_give),
]


class AimPlanIn(FleetForecastIn):
    """Find the aim points of the most power on a receiver under the flux that it can take.

    In 95 % of draws of the pointing errors the whole map is within the limit. Heliostats are left
    inactive only where no aims keep it.
    """

    limit_w_m2: LimitOfMap = Field(
        description=(
            "Flux that the receiver can take [W/m2]: one number, or rows of numbers over the"
            " unrolled map, from its upper left."
        )
    )
    aim_points_m: dict[Name, Position] = Field(
        default_factory=dict,
        max_length=20_000,
        description="Aims to begin with [m], such as those of a plan a moment before, by name.",
    )
    resolution: Resolution | None = Field(  # type: ignore[assignment]
        default=None,
        description="Rows and columns of the map; 32 rows of square pixels if not given.",
    )

    @field_validator("limit_w_m2")
    @classmethod
    def _is_a_map(cls, limit: float | list[list[float]]) -> float | list[list[float]]:
        if isinstance(limit, list) and len({len(row) for row in limit}) != 1:
            raise ValueError("must have rows of the same length")
        return limit

    def limit(self) -> Limit:
        """The limit over the map."""
        rows = self.limit_w_m2 if isinstance(self.limit_w_m2, list) else [[self.limit_w_m2]]
        return Limit(np.array(rows, dtype=np.float64))


def plan_field(context: Context, payload: AimPlanIn) -> Result:
    """Trace an image of each heliostat, and move the aims; a restarted job begins again."""
    runtime = context.runtime
    with runtime.database.reading() as session:
        sun = position_of(session, payload.sun)
    fleet = payload.fleet(runtime, sun, payload.surface == "ideal")
    receiver = fleet.receiver
    resolution = payload.resolution or square_pixels(receiver, ROWS)
    start = fleet.aims
    group = _in_front(runtime, fleet)
    kernels = trace_kernels(runtime, group, resolution, payload.neighbours, context.report)
    limit = torch.tensor(payload.limit().on_map(*resolution), dtype=torch.float32).flatten()
    begin = begin_at(kernels, limit, start) if start else None
    context.report(0.55, "aims", phase="aims")
    plan = plan_aims(kernels, limit, begin, context.check)
    context.report(0.85, "what the plan is worth", phase="aims")
    single = forecast_group(
        runtime, replace(fleet, aims={}), resolution, payload.neighbours, _unreported(context)
    )
    require_some(single.heliostats, single.skipped)
    power = (
        sum(one.area * one.intercepted for one in single.losses.values()) * fleet.model.optics.dni
    )
    ideal = sorted(group.without_surface - set(group.skipped))
    figures: dict[str, object] = {
        **aim_figures(plan, receiver, power),
        "warnings": group_warnings(len(ideal), len(kernels)),
        "sun": sun.model_dump(),
        "dni_w_m2": fleet.model.optics.dni,
        "model_version": fleet.model.number,
        "heliostats": len(kernels),
        "skipped": group.skipped,
        "ideal_surfaces": ideal,
        "plane": receiver_as_json(receiver),
    }
    points = zip(kernels.names, plan.points.round(4).tolist(), strict=True)
    with runtime.database.writing() as session:
        context.replace(session, _AIMS, {"aim_points_m": dict(points)})
    maps = {"flux": plan.flux, "limit": limit}
    arrays = {name: one.numpy().reshape(resolution) for name, one in maps.items()}
    return Result(figures, arrays | {"single_aim_flux": single.irradiance.astype(np.float32)})


# Step with the aims, which may be many.
_AIMS = "aims"


def _unreported(context: Context) -> Any:
    """Progress of a part that is too short to be counted."""
    return lambda *_, **__: context.check()


def _in_front(runtime: Runtime, fleet: HeliostatGroup) -> HeliostatGroup:
    """The group from near to far, aimed at the surface toward each heliostat.

    Images of heliostats that are traced together have one size.
    """
    row = HeliostatRow
    with runtime.database.reading() as session:
        found = session.execute(select(row.name, row.east_m, row.north_m, row.up_m)).all()
    places = {name: np.array([east, north, up]) for name, east, north, up in found}
    known = [name for name in fleet.names if name in places]
    known.sort(key=lambda name: math.dist(places[name], fleet.receiver.aim))
    aims = {name: aim_in_front(fleet.receiver, places[name]).tolist() for name in known}
    unknown = [name for name in fleet.names if name not in places]
    return replace(fleet, names=[*known, *unknown], aims=aims)


def expected_plan_s(payload: AimPlanIn, stored: int) -> float:
    """Estimated duration [s]: images, aims, and what they are compared with."""
    return 4 * expected_s(payload.model_copy(update={"resolution": (ROWS, 2 * ROWS)}), stored)


KIND = Kind(
    "aim-plans",
    AimPlanIn,
    plan_field,
    "Find the aim points of the most power under a limit of flux.",
    details=_AIMS,
    expected_s=expected_plan_s,
)
