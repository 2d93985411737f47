"""The job `forecasts`: the flux of many heliostats on one receiver."""

from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from sqlalchemy.orm import Session

from model.frames import sun_direction
from model.plant import Receiver
from service import store
from service.base.fields import (
    AnySun,
    Flag,
    Model,
    ModelVersion,
    Name,
    Number,
    Plane,
    Position,
    ReceiverIn,
    Resolution,
    Sun,
)
from service.jobs.common import Heliostats, chosen_names, require_some
from service.jobs.kind import Context, Kind, Result
from service.twin import versions
from service.twin.field_light import Fleet, forecast_fleet
from service.twin.forecast import position_of, receiver_as_json
from service.twin.runtime import Runtime


class FleetIn(Model):
    """Heliostats, the receiver that they light, and where they aim."""

    heliostats: Heliostats = None
    target: Name | None = Field(
        default=None, description="A stored target or receiver; either this, `plane` or `receiver`."
    )
    plane: Plane | None = Field(default=None, description="Any plane; either this, `target` or `receiver`.")
    receiver: ReceiverIn | None = Field(default=None, description="Any cylinder; either this, `target` or `plane`.")
    aim_point: Position | None = Field(
        default=None, description="Where all heliostats aim [m]; by default the receiver's middle."
    )
    aim_points: dict[Name, Position] = Field(
        default_factory=dict, max_length=20_000, description="Where single heliostats aim instead [m], by name."
    )
    neighbours: Flag = Field(
        default=True, description="Whether the mirrors of these heliostats shade and block each other."
    )
    dni_w_m2: Number = Field(default=1000.0, gt=0, le=2000, description="Direct normal irradiance [W/m2].")
    resolution: Resolution = (256, 256)
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(value is not None for value in (self.target, self.plane, self.receiver)) != 1:
            raise ValueError("give either target or plane, or receiver")
        return self

    def on(self, session: Session) -> Receiver:
        """What the light falls on."""
        if self.plane is not None:
            return self.plane.named("plane")
        if self.receiver is not None:
            return self.receiver.named("receiver")
        assert self.target is not None  # the schema wants one of the three
        return store.get_target_or_receiver(session, self.target)

    def fleet(self, runtime: Runtime, sun: Sun, ideal: bool) -> Fleet:
        """The heliostats before a sun, with their current surfaces or ``ideal`` ones."""
        names = chosen_names(runtime, self.heliostats)
        with runtime.database.reading() as session:
            receiver, origin = self.on(session), store.get_plant(session).origin
            model = versions.get_model(session, self.model_version)
        return Fleet(
            names=names,
            receiver=receiver,
            sun=sun_direction(sun.azimuth_deg, sun.elevation_deg),
            optics=replace(model.optics, dni=self.dni_w_m2),
            model=model,
            origin=origin,
            aim=np.array(receiver.center if self.aim_point is None else self.aim_point),
            aims=self.aim_points,
            ideal=ideal,
        )


class FleetForecastIn(FleetIn):
    """Superpose the flux of many heliostats on one receiver: a plane, or a cylinder unrolled.

    It is light in W/m2: effects that the model has of the camera do not act.
    """

    sun: AnySun
    surface: Literal["current", "ideal"] = Field(
        default="current", description="The heliostats' current surfaces, where one has none it is skipped; or ideal."
    )


def forecast_field(context: Context, payload: FleetForecastIn) -> Result:
    """The sum of the heliostats' flux maps [W/m2]."""
    with context.runtime.database.reading() as session:
        sun = position_of(session, payload.sun)
    fleet = payload.fleet(context.runtime, sun, payload.surface == "ideal")
    made = forecast_fleet(context.runtime, fleet, payload.resolution, payload.neighbours, context.report)
    require_some(made.heliostats, made.skipped)
    figures = _figures(made.irradiance, fleet.receiver) | {
        "model_version": fleet.model.version,
        "reflected_w": made.power,
    }
    figures |= {"sun": sun.model_dump(), "dni_w_m2": payload.dni_w_m2}
    counts = {"heliostats": made.heliostats, "skipped": made.skipped}
    return Result(figures | counts, {"flux": made.irradiance.astype(np.float32)})


def _figures(flux: np.ndarray[Any, Any], receiver: Receiver) -> dict[str, Any]:
    pixel_m2 = receiver.width * receiver.height / flux.size
    return {
        "peak_w_m2": float(flux.max()),
        "power_w": float(flux.sum() * pixel_m2),
        "plane": receiver_as_json(receiver),
    }


KIND = Kind("forecasts", FleetForecastIn, forecast_field, "Superpose the flux of many heliostats on one receiver.")
