"""Types of the fields that requests and answers share, with their bounds and units.

Numbers are finite, unknown keys are refused, and names fit a pattern that is safe in paths and URLs.
"""

from datetime import UTC, datetime
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    StringConstraints,
    Tag,
)

from model.plant import Cylinder, TargetPlane
from service.base.choices import Method as Method  # one of these types, and a choice of the command line
from service.base.names import IDENTIFIER, MEASUREMENT, NAME

Name = Annotated[
    str,
    StringConstraints(pattern=NAME),
    Field(description="1 to 32 letters, digits, underscores and hyphens.", examples=["AA39"]),
]

Identifier = Annotated[
    str,
    StringConstraints(pattern=IDENTIFIER),
    Field(description="1 to 64 letters, digits, underscores and hyphens.", examples=["205363"]),
]

MeasurementName = Annotated[
    str,
    StringConstraints(pattern=MEASUREMENT),
    Field(description="The `id` of a measurement, as the service gave it.", examples=["205363"]),
]

Kind = Literal["raw", "cropped", "flux", "flux-centered"]
Source = Literal["measured", "network", "refined", "imported"]
Verdict = Literal["effect", "none", "unexplained"]
State = Literal["queued", "running", "done", "failed", "cancelled"]


def _is_number(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise ValueError("must be a number, and neither text nor a truth value")
    return value


# JSON has types: what only stands for a number there is a mistake. Forms and queries, which are all text, have float
# and int themselves.
Number = Annotated[float, BeforeValidator(_is_number)]
Whole = Annotated[int, BeforeValidator(_is_number)]
Flag = Annotated[bool, Strict()]

Metres = Annotated[Number, Field(ge=-1e6, le=1e6)]
Position = Annotated[tuple[Metres, Metres, Metres], Field(description="East, north, up of the tower base [m].")]

Direction = tuple[
    Annotated[Number, Field(ge=-1e3, le=1e3)],
    Annotated[Number, Field(ge=-1e3, le=1e3)],
    Annotated[Number, Field(ge=-1e3, le=1e3)],
]

Wgs84 = tuple[
    Annotated[Number, Field(ge=-90, le=90)],
    Annotated[Number, Field(ge=-180, le=180)],
    Annotated[Number, Field(ge=-1e4, le=1e5)],
]

MotorPosition = tuple[Annotated[Number, Field(ge=0, le=1e9)], Annotated[Number, Field(ge=0, le=1e9)]]
"""Of both axes [steps]."""

AZIMUTH = Field(ge=-360, le=360, description="Sun azimuth from south, positive to the east [deg].")
ELEVATION = Field(gt=0, le=90, description="Sun elevation above the horizon [deg].")
Azimuth = Annotated[Number, AZIMUTH]
Elevation = Annotated[Number, ELEVATION]
Extent = Annotated[Number, Field(ge=0.01, le=1e3)]


def moment_of(told: datetime) -> datetime:
    """A moment in UTC, which one without a zone means; ValueError where its year is a slip of the finger."""
    moment = told.replace(tzinfo=UTC) if told.tzinfo is None else told
    if moment < datetime(1970, 1, 1, tzinfo=UTC):
        raise ValueError("give a year from 1970 on")
    if moment >= datetime(9000, 1, 1, tzinfo=UTC):
        raise ValueError("give a year before 9000")
    return moment.astimezone(UTC)


Moment = Annotated[AwareDatetime, AfterValidator(moment_of)]

FormMoment = Annotated[datetime, AfterValidator(moment_of)]
"""In forms: what a browser's field for a moment gives bears no zone; the pages say that it means UTC."""

Version = Annotated[int, Field(ge=1, le=2**31 - 1)]
"""In paths and queries."""
VersionIn = Annotated[Whole, Field(ge=1, le=2**31 - 1)]
"""In bodies."""

ModelVersion = Annotated[
    VersionIn | None,
    Field(description="Number of a version of the plant's model, see /v1/models; the current one without it."),
]


def filled(given: Any) -> Any:
    """What a form was sent with but for what nobody filled in; for validators before a model."""
    return {name: value for name, value in given.items() if value != ""} if isinstance(given, dict) else given


class Model(BaseModel):
    """Base of the requests: finite numbers, no unknown keys."""

    model_config = ConfigDict(allow_inf_nan=False, extra="forbid", frozen=True)


class Plane(Model):
    """A rectangle in space, seen from its lit side."""

    center: Position
    normal: Direction = Field(description="Normal of the lit side, east-north-up; need not be of unit length.")
    up: Direction = Field(
        default=(0.0, 0.0, 1.0), description="Upward direction of the image, not parallel to the normal."
    )
    width: Extent = Field(description="[m]")
    height: Extent = Field(description="[m]")

    def named(self, name: str) -> TargetPlane:
        """The model's plane of this name."""
        return TargetPlane(
            name=name,
            center=np.array(self.center),
            normal=np.array(self.normal),
            up=np.array(self.up),
            width=self.width,
            height=self.height,
        )


class ReceiverIn(Model):
    """A receiver that is a part of a cylinder, or all of it, lit from outside."""

    center: Position = Field(description="The middle of the lit surface: east, north, up of the tower base [m].")
    normal: Direction = Field(description="Normal there, away from the axis, east-north-up; of any length.")
    up: Direction = Field(default=(0.0, 0.0, 1.0), description="Along the axis, upwards in the map.")
    radius: Annotated[Number, Field(ge=0.01, lt=1e3)] = Field(description="[m]")
    height: Extent = Field(description="Along the axis [m].")
    opening_deg: Number = Field(
        default=360.0, gt=0, le=360, description="Angle of the lit surface, half of it to each side of its middle."
    )

    def named(self, name: str) -> Cylinder:
        """The model's receiver of this name."""
        return Cylinder(
            name=name,
            center=np.array(self.center),
            normal=np.array(self.normal),
            up=np.array(self.up),
            radius=self.radius,
            height=self.height,
            opening_deg=self.opening_deg,
        )


class Sun(Model):
    """Where the sun stands."""

    azimuth_deg: Azimuth
    elevation_deg: Elevation


class SunAt(Model):
    """Where the sun stands over the plant at a time."""

    at: Moment = Field(description="Time with zone; by day.")


def _way_to_say(sun: Any) -> str:
    """Which of the two ways somebody says where the sun stands by."""
    by_time = "at" in sun if isinstance(sun, dict) else isinstance(sun, SunAt)
    return "(time)" if by_time else "(position)"


AnySun = Annotated[
    Annotated[Sun, Tag("(position)")] | Annotated[SunAt, Tag("(time)")],
    Discriminator(_way_to_say),
    Field(description='Where the sun stands: its position, or the time, `{"at": ..}`.'),
]


def _square(value: Any) -> Any:
    return (value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Side = Annotated[Whole, Field(ge=8, le=1024)]

Resolution = Annotated[
    tuple[Side, Side],
    BeforeValidator(_square),
    Field(description="Rows and columns of the map, or one number for both."),
]


Rows = list[list[float]]
"""A map as JSON: rows from the top."""


class AccuracyOut(BaseModel):
    """How well held-out photographs are forecast."""

    accuracy_mean: float = Field(description="[1]")
    accuracy_median: float = Field(description="[1]")
    per_image: dict[str, float] = Field(description="By heliostat and measurement, `H/ID` [1].")
    position_error_mrad: float | None = Field(
        default=None,
        description="Median angle from where motors sent the light to where it lies [mrad]; null: not known.",
    )


class StudyReport(BaseModel):
    """What a study found; the report of `heliotwin study` is one, too."""

    model_config = ConfigDict(extra="allow")

    verdict: Verdict = Field(description="effect: it is found; none: nothing is missing; unexplained: something is.")
    conclusion: str = ""
    images: dict[str, int] = Field(description="How many were fitted and how many judged the fit.")
    before: AccuracyOut = Field(description="By the model that the study was made with.")
    after: AccuracyOut = Field(description="With the effects that were found.")
    noise_floor: float = Field(description="Error that the photographs' noise alone makes [1].")
    unexplained_share: float = Field(description="Share of the error beyond the noise that is left [1].")
    effects: list[dict[str, Any]] = Field(
        description="What was found: parameters with 95 % intervals, scope (when, and whose where "
        "it names `heliostats`), gain."
    )
    candidates: list[dict[str, Any]] = Field(description="Every effect tried by itself, the best first.")
    skipped: dict[str, str] = Field(default={}, description="What was left out, with the reasons.")
