"""The job `plans`: a day of the field's light on a receiver, by the twin and by ideal mirrors."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StringConstraints, model_validator

from model.ephemeris import sun_angles_at
from model.fleet import FleetFlux
from model.plant import Cylinder, Receiver
from service import store
from service.base.fields import Metres, Moment, Name, Number, Resolution, Sun
from service.jobs.common import require_some
from service.jobs.kind import Context, Kind, Result
from service.jobs.kinds.field_forecasts import FleetIn
from service.twin import versions
from service.twin.field_light import Fleet, forecast_fleet
from service.twin.forecast import receiver_as_json

MOST_TIMES = 100
"""Times of a plan."""


class PlanIn(FleetIn):
    """Forecast the light on a receiver at steps between two times, by the twin and by ideal mirrors, under a name.

    Times of the night are left out.
    """

    name: Annotated[str, StringConstraints(min_length=1, max_length=80, strip_whitespace=True)]
    begin: Moment = Field(description="The first time, with zone.")
    end: Moment = Field(description="The last one, with zone.")
    step_minutes: Number = Field(default=60.0, ge=1, le=1440, description="From one time to the next [min].")
    allowed_w_m2: Number | None = Field(
        default=None, gt=0, le=1e8, description="Flux that the receiver stands [W/m2]; where it is exceeded is told."
    )
    aim_offsets: dict[Name, tuple[Metres, Metres]] = Field(
        default_factory=dict,
        max_length=20_000,
        description="Where single heliostats aim instead, by name: right and up of the receiver's middle, on it [m].",
    )
    resolution: Resolution = (64, 64)

    @model_validator(mode="after")
    def _some_times(self) -> Self:
        if self.end < self.begin:
            raise ValueError("end: give a time after begin")
        if len(list(self.times())) > MOST_TIMES:
            raise ValueError(f"step_minutes: these are more than {MOST_TIMES} times; make the steps longer")
        return self

    def times(self) -> Iterator[datetime]:
        """From ``begin`` to ``end``."""
        at = self.begin
        while at <= self.end:
            yield at
            at += timedelta(minutes=self.step_minutes)


def aim_on(receiver: Receiver, right: float, up: float) -> tuple[float, float, float]:
    """A place on a receiver (3,) [m] by its coordinates on the map [m]: along the arc on a cylinder."""
    plane, across = receiver.middle, right
    if isinstance(receiver, Cylinder):
        plane, across = receiver.tangent(right / receiver.radius, 1.0, 1.0), 0.0
    east, north, height = plane.to_enu((across, up)).tolist()
    return east, north, height


def _suns(context: Context, payload: PlanIn) -> list[tuple[datetime, Sun]]:
    """The times of the day, and where the sun stands then."""
    with context.runtime.database.reading() as session:
        latitude, longitude, _ = store.get_plant(session).origin
    angles = [(at, *sun_angles_at(at, latitude, longitude)) for at in payload.times()]
    return [(at, Sun(azimuth_deg=azimuth, elevation_deg=up)) for at, azimuth, up in angles if up > 0]


def load_of(made: FleetFlux, receiver: Receiver, allowed_w_m2: float | None) -> dict[str, Any]:
    """What light does to a receiver.

    ``intercept`` is the share of what the mirrors reflect that lands on it, ``spillage`` the rest; ``exceeded_m2`` the
    area that gets more than is allowed.
    """
    pixel_m2 = receiver.width * receiver.height / made.irradiance.size
    power = float(made.irradiance.sum() * pixel_m2)
    intercept = min(power / made.power, 1.0) if made.power > 0 else None
    return {
        "peak_w_m2": float(made.irradiance.max()),
        "power_w": power,
        "reflected_w": made.power,
        "intercept": intercept,
        "spillage": None if intercept is None else 1 - intercept,
        "exceeded_m2": None if allowed_w_m2 is None else float((made.irradiance > allowed_w_m2).sum() * pixel_m2),
    }


def plan_day(context: Context, payload: PlanIn) -> Result:
    """The light at each time, by the twin and by ideal mirrors of the same heliostats."""
    with context.runtime.database.reading() as session:
        receiver = payload.on(session)
        model = versions.get_model(session, payload.model_version)
    aims = {name: aim_on(receiver, *offset) for name, offset in payload.aim_offsets.items()}
    asked = payload.model_copy(update={"model_version": model.number, "aim_points": payload.aim_points | aims})
    suns, steps, maps = _suns(context, payload), [], []
    require_some(len(suns), {"the sun": "it is night from begin to end"})
    skipped: dict[str, str] = {}
    heliostats = 0

    def light(fleet: Fleet, index: int, begun: float) -> FleetFlux:
        def report(done: float, what: str) -> None:
            context.report((index + begun + done / 2) / len(suns), f"{suns[index][0]:%H:%M} UTC, {what}")

        return forecast_fleet(context.runtime, fleet, payload.resolution, payload.neighbours, report)

    for index, (at, sun) in enumerate(suns):
        twin = light(asked.fleet(context.runtime, sun, ideal=False), index, 0.0)
        require_some(twin.heliostats, twin.skipped)
        skipped |= twin.skipped
        heliostats = max(heliostats, twin.heliostats)
        fleet = asked.fleet(context.runtime, sun, ideal=True)
        same = [name for name in fleet.names if name not in twin.skipped]
        ideal = light(replace(fleet, names=same), index, 0.5)
        loads = {
            name: load_of(made, receiver, payload.allowed_w_m2) for name, made in (("twin", twin), ("ideal", ideal))
        }
        steps.append({"at": at.isoformat(), "sun": sun.model_dump(), "heliostats": twin.heliostats, **loads})
        maps.append((twin.irradiance, ideal.irradiance))
    stacked: NDArray[np.float32] = np.array(maps, dtype=np.float32)
    peak = stacked[:, 0].max(axis=0)
    figures = {
        "name": payload.name,
        "peak_w_m2": float(peak.max()),
        "heliostats": heliostats,
        "times": len(suns),
        "left_out": len(list(payload.times())) - len(suns),
        "model_version": model.version,
        "plane": receiver_as_json(receiver),
        "steps": steps,
        "skipped": skipped,
    }
    return Result(figures, {"flux": peak, "twin": stacked[:, 0], "ideal": stacked[:, 1]})


KIND = Kind("plans", PlanIn, plan_day, "Forecast a day of the field's light on a receiver, against ideal mirrors.")
