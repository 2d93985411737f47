"""The job `plans`: the field's flux on a receiver over a day, by the twin and by ideal mirrors."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Annotated, Any, Self, TypedDict

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StringConstraints, model_validator

from model.ephemeris import sun_positions
from model.fleet import FleetFlux
from model.plant import Cylinder, Receiver
from model.receivers import Cavity, Panels
from model.times import format_minute, format_time
from service import store
from service.base.fields import Metres, Moment, Name, Number, Resolution, Sun, Text, VersionIn
from service.jobs.kind import MAX_PIXELS, Context, Kind, Result, require_some
from service.jobs.kinds.aim_plans import PlannedAims
from service.jobs.kinds.field_forecasts import FleetIn, expected_s
from service.twin.forecasts.field_forecast import (
    Fleet,
    HeliostatGroup,
    forecast_group,
    group_warnings,
)
from service.twin.forecasts.heliostat_forecast import receiver_as_json
from service.twin.forecasts.watts import FieldWatts, field_watts
from service.twin.runtime import Runtime

MAX_TIMES = 100
"""Maximum number of times of a plan."""

PlanName = Annotated[Text, StringConstraints(min_length=1, max_length=80, strip_whitespace=True)]


class PlanIn(FleetIn):
    """Forecast the flux on a receiver over a period, by the twin and by ideal mirrors.

    The plan has a name. Times at night are left out.
    """

    name: PlanName = Field(description="Name of the plan.")
    first_at: Moment = Field(description="The first time, with zone.")
    last_at: Moment = Field(description="The last one, with zone.")
    step_minutes: Number = Field(
        default=60.0, ge=1, le=1440, description="From one time to the next [min]."
    )
    allowed_w_m2: Number | None = Field(
        default=None,
        gt=0,
        le=1e8,
        description="Largest flux that the receiver may have [W/m2]; more is reported.",
    )
    aim_offsets_m: dict[Name, tuple[Metres, Metres]] = Field(
        default_factory=dict,
        max_length=20_000,
        description=(
            "Where single heliostats aim instead, by name: right and up of the receiver's middle,"
            " on it [m]."
        ),
    )
    aim_plan: VersionIn | None = Field(
        default=None,
        description=(
            "Number of a job `aim-plans` on the same target, whose aims are used: at each time"
            " those of its nearest step. Its inactive heliostats send no light. `aim_points_m` and"
            " `aim_offsets_m` come first."
        ),
    )
    resolution: Resolution = (64, 64)

    @model_validator(mode="after")
    def _some_times(self) -> Self:
        if self.last_at < self.first_at:
            raise ValueError("last_at: give a time after first_at")
        count, (rows, columns) = self.count(), self.resolution
        if count > MAX_TIMES or count * rows * columns > MAX_PIXELS:
            raise ValueError(
                f"first_at, last_at, step_minutes, resolution: {count} times of {rows} x {columns}"
                f" pixels are too many; a plan has at most {MAX_TIMES} times, and {MAX_PIXELS}"
                " pixels in all of them together"
            )
        return self

    def count(self) -> int:
        """Number of times including those at night, without creating them."""
        return (self.last_at - self.first_at) // timedelta(minutes=self.step_minutes) + 1

    def times(self) -> Iterator[datetime]:
        """Times from ``first_at`` to ``last_at``."""
        return (
            self.first_at + number * timedelta(minutes=self.step_minutes)
            for number in range(self.count())
        )


def aim_on(receiver: Receiver, right: float, up: float) -> tuple[float, float, float]:
    """Convert map coordinates [m] on a receiver to a point (3,) [m] in ENU.

    On a cylinder, ``right`` is along the arc. On panels and in a cavity it is along the panels.
    """
    plane, across = receiver.middle, right
    if isinstance(receiver, Cylinder):
        plane, across = receiver.tangent(right / receiver.radius, 1.0, 1.0), 0.0
    elif isinstance(receiver, Panels | Cavity):
        ends = np.cumsum([panel.width for panel in receiver.panels]) - receiver.width / 2
        number = min(int(np.searchsorted(ends, right)), len(ends) - 1)
        plane = receiver.panels[number]
        across = right - float(ends[number]) + plane.width / 2
    east, north, height = plane.to_enu((across, up)).tolist()
    return east, north, height


def _suns(context: Context, payload: PlanIn) -> list[tuple[datetime, Sun]]:
    """The times with sun above the horizon, and the sun positions."""
    with context.runtime.database.reading() as session:
        origin = store.get_plant(session).origin
    times = list(payload.times())
    angles = zip(times, sun_positions(times, origin).tolist(), strict=True)
    return [
        (at, Sun(azimuth_deg=azimuth, elevation_deg=up)) for at, (azimuth, up) in angles if up > 0
    ]


class ReceiverLoad(TypedDict):
    """Key figures of the flux on a receiver.

    ``intercept`` is the share of the reflected power that hits it, and ``spillage`` the rest.
    ``exceeded_m2`` is the area above the allowed flux. ``field`` is the chain of losses, or None
    without any light.
    """

    peak_w_m2: float
    power_w: float
    reflected_w: float
    intercept: float | None
    spillage: float | None
    exceeded_m2: float | None
    field: FieldWatts | None


def load_of(
    flux: FleetFlux, receiver: Receiver, allowed_w_m2: float | None, dni_w_m2: float
) -> ReceiverLoad:
    """Key figures of a fleet's flux on a receiver."""
    pixel_m2 = receiver.width * receiver.height / flux.irradiance.size
    power = float(flux.irradiance.sum() * pixel_m2)
    field = field_watts(flux, dni_w_m2) if flux.losses else None
    intercept = field["intercept"] if field is not None and flux.power > 0 else None
    return {
        "peak_w_m2": float(flux.irradiance.max()),
        "power_w": power,
        "reflected_w": flux.power,
        "intercept": intercept,
        "spillage": None if intercept is None else 1 - intercept,
        "exceeded_m2": (
            None
            if allowed_w_m2 is None
            else float((flux.irradiance > allowed_w_m2).sum() * pixel_m2)
        ),
        "field": field,
    }


_FLEET = "fleet"


def map_name(index: int) -> str:
    """Name of the job step with a plan's maps at one time.

    The maps are `twin` and `ideal`, (rows, columns) [W/m2].
    """
    return f"{index:03d}"


def plan_day(context: Context, payload: PlanIn) -> Result:
    """Compute the flux at each time, by the twin and by ideal mirrors.

    Both use the same heliostats. Each time is a step of the job.
    """
    with context.runtime.database.reading() as session:
        planned = None if payload.aim_plan is None else PlannedAims.read(session, payload.aim_plan)
    stored = payload.fleet(context.runtime)
    receiver = stored.receiver
    offsets = payload.aim_offsets_m.items()
    aims = payload.aim_points_m | {name: aim_on(receiver, *offset) for name, offset in offsets}
    stored = replace(stored, aims=aims)
    suns, done = _suns(context, payload), context.steps()
    require_some(len(suns), {"the sun": "it is night from first_at to last_at"})
    for index, (at, sun) in enumerate(suns):
        if map_name(index) not in done:
            _plan_time(_Time(context, payload, stored, planned, index, len(suns), at, sun))
    steps = context.steps()
    fleet = steps.pop(_FLEET)
    peak = _peak(context, len(suns))
    heliostats = max(step["heliostats"] for step in steps.values())
    figures: dict[str, object] = {
        "warnings": group_warnings(len(fleet["ideal_surfaces"]), heliostats),
        "name": payload.name,
        "peak_w_m2": float(peak.max()),
        "heliostats": heliostats,
        "times": len(suns),
        "left_out": payload.count() - len(suns),
        "model_version": stored.model.number,
        "aim_plan": payload.aim_plan,
        "plane": receiver_as_json(receiver),
        "steps": [steps[map_name(index)] for index in range(len(suns))],
        **fleet,
    }
    return Result(figures, {"flux": peak})


@dataclass(frozen=True, eq=False)
class _Time:
    """Time ``index`` of ``total`` of a plan."""

    context: Context
    asked: PlanIn
    stored: Fleet
    planned: PlannedAims | None
    index: int
    total: int
    at: datetime
    sun: Sun

    def fleet(self, ideal: bool) -> HeliostatGroup:
        """The heliostats at this time, with the aims of the aim plan if there is one."""
        fleet = self.stored.under(self.sun, ideal)
        return fleet if self.planned is None else self.planned.aimed(fleet, self.at)

    def light(self, fleet: HeliostatGroup, begun: float) -> FleetFlux:
        """Compute a fleet's flux, half of the work at this time, from share ``begun`` on."""

        def report(share: float, message: str, **_counts: Any) -> None:
            whole = (self.index + begun + share / 2) / self.total
            what = f"{format_minute(self.at)}, {message}"
            self.context.report(
                whole, what, phase="times of the plan", n_done=self.index, n_total=self.total
            )

        return forecast_group(
            self.context.runtime, fleet, self.asked.resolution, self.asked.neighbours, report
        )


def _plan_time(time: _Time) -> None:
    """Compute and store the flux maps of the twin and of ideal mirrors at one time."""
    context, request = time.context, time.asked
    fleet = time.fleet(ideal=False)
    twin = time.light(fleet, 0.0)
    require_some(twin.heliostats, twin.skipped)
    without, sources = fleet.without_surface - set(twin.skipped), fleet.sources(twin.skipped)
    fleet = time.fleet(ideal=True)
    ideal = time.light(
        replace(fleet, names=[name for name in fleet.names if name not in twin.skipped]), 0.5
    )
    fluxes = {"twin": twin, "ideal": ideal}
    dni = fleet.model.optics.dni
    loads = {
        name: load_of(flux, time.stored.receiver, request.allowed_w_m2, dni)
        for name, flux in fluxes.items()
    }
    step = {
        "at": format_time(time.at),
        "sun": time.sun.model_dump(),
        "dni_w_m2": dni,
        "heliostats": twin.heliostats,
        "aims_of_step": None if time.planned is None else time.planned.nearest(time.at),
        **loads,
    }
    maps = {name: flux.irradiance.astype(np.float32) for name, flux in fluxes.items()}
    known = context.steps().get(_FLEET, {"skipped": {}, "ideal_surfaces": []})
    about = {
        "skipped": known["skipped"] | twin.skipped,
        "ideal_surfaces": sorted(without.union(known["ideal_surfaces"])),
        "sources": sources,
    }
    with context.runtime.database.writing() as session:
        context.keep(session, map_name(time.index), step, maps)
        context.replace(session, _FLEET, about)


def _peak(context: Context, times: int) -> NDArray[np.float32]:
    """Maximum of the twin's flux at each pixel over all times. One map is in memory at a time."""
    peak: NDArray[np.float32] | None = None
    for index in range(times):
        maps = context.kept_arrays(map_name(index))
        assert maps is not None  # stored in the transaction of its step
        peak = maps["twin"] if peak is None else np.maximum(peak, maps["twin"])
    assert peak is not None
    return peak


def expected_plan_s(payload: PlanIn, runtime: Runtime) -> float:
    """Estimated duration of a plan [s]."""
    return 2 * payload.count() * expected_s(payload, runtime)


KIND = Kind(
    "plans",
    PlanIn,
    plan_day,
    "Forecast a day of the field's flux on a receiver.",
    expected_s=expected_plan_s,
)
