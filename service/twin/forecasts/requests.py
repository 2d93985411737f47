"""What is asked of a forecast: the one type from REST, pages and command line to the tracer."""

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator
from sqlalchemy.orm import Session

from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError
from model.plant import Receiver
from model.times import format_minute
from service import store
from service.base.fields import (
    AnySun,
    Flag,
    Model,
    ModelVersion,
    MotorPosition,
    Name,
    Number,
    Plane,
    Position,
    Resolution,
    Sun,
    SunAt,
    VersionIn,
)
from service.base.plant import PlaneReceiverIn, ReceiverIn
from service.twin.forecasts.watts import Sunlight


def _surface_by(value: Any) -> str:
    """Whether a surface is named by a word or by its version."""
    return "(word)" if isinstance(value, str) else "(version)"


Surface = Annotated[
    Annotated[Literal["current", "ideal"], Tag("(word)")] | Annotated[VersionIn, Tag("(version)")],
    Discriminator(_surface_by),
]


class ForecastBase(Model):
    """What requests for one heliostat and for many have in common.

    The light falls on a stored target or receiver, or on another plane or receiver.
    """

    target: Name | None = Field(
        default=None, description="A stored target or receiver; either this, `plane` or `receiver`."
    )
    plane: Plane | None = Field(
        default=None, description="Any plane; either this, `target` or `receiver`."
    )
    receiver: ReceiverIn | None = Field(
        default=None,
        description=(
            "Any receiver; either this, `target` or `plane`. The map of a cylinder is unrolled."
        ),
    )
    aim_point_m: Position | None = Field(
        default=None,
        description=(
            "Where heliostats aim [m]; by default the receiver's middle, which is the middle of a"
            " cavity's opening, and on a cylinder the point that faces each heliostat."
        ),
    )
    measured_states: Flag = Field(
        default=True,
        description=(
            "Whether mirrors are as photographs measured them: dimmed, and with their pointing"
            " errors. Otherwise, and with ideal surfaces, they are as declared."
        ),
    )
    dni_w_m2: Sunlight = 1000.0
    resolution: Resolution = (256, 256)
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(value is not None for value in (self.target, self.plane, self.receiver)) != 1:
            raise ValueError("give either target or plane, or receiver")
        return self

    def on(self, session: Session) -> Receiver:
        """The receiver or target plane."""
        if self.plane is not None:
            return self.plane.named("plane")
        if self.receiver is not None:
            return self.receiver.named("receiver")
        assert self.target is not None  # the schema requires one of the three
        return store.get_target_or_receiver(session, self.target)


class ForecastIn(ForecastBase):
    """A flux map to compute."""

    heliostat: Name
    sun: AnySun
    motor_position: MotorPosition | None = Field(
        default=None,
        description=(
            "In place of an aim: positions of both motors [steps]. The calibrated mount, as it was"
            " at the time in `sun`, else the newest, says where they send the light, or the"
            " heliostat's properties where it was never calibrated."
        ),
    )
    surface: Surface = Field(
        default="current",
        description=(
            "The heliostat's current surface, the ideal one, or a version. A heliostat without a"
            " surface is forecast by its ideal mirror; the first of `warnings` says so."
        ),
    )
    window_m: Number | None = Field(
        default=None,
        ge=0.01,
        le=1e3,
        description=(
            "Side of a square about the centre of mass to map [m]; else the plane. Planes only."
        ),
    )
    normalised: Flag = Field(
        default=False, description="Scale the map to a sum of 100 instead of W/m2."
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        is_whole = not isinstance(self.receiver, PlaneReceiverIn | None)
        if self.window_m is not None and is_whole:
            raise ValueError("window_m: the map of such a receiver is all of it; leave it out")
        if self.aim_point_m is not None and self.motor_position is not None:
            raise ValueError("give either aim_point_m or motor_position")
        return self

    @property
    def at(self) -> datetime | None:
        """The time that was asked for, if any."""
        return self.sun.at if isinstance(self.sun, SunAt) else None


def position_of(session: Session, sun: Sun | SunAt) -> Sun:
    """The sun's position over the plant.

    Raises
    ------
    InvalidInputError
        If it is night at that time.
    """
    if isinstance(sun, Sun):
        return sun
    azimuth, elevation = sun_angles_at(sun.at, store.get_plant(session).origin)
    if elevation <= 0:
        raise InvalidInputError(
            f"at: the sun is {-elevation:.1f}° below the horizon at {format_minute(sun.at)};"
            " choose a time of the day"
        )
    return Sun(azimuth_deg=azimuth, elevation_deg=elevation)
