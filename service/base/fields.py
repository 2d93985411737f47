"""Field types that requests and responses share, with limits and units.

Numbers are finite, unknown keys are rejected, and names fit a pattern that is safe in paths and
URLs.
"""

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import UTC, date, datetime, time, timedelta
from itertools import islice
from typing import Annotated, Any, Literal, Self, TypeVar
from zoneinfo import ZoneInfo

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    ModelWrapValidatorHandler,
    Strict,
    StringConstraints,
    Tag,
    ValidationError,
    model_validator,
)

from model.plant import TargetPlane, require_plane_shape
from service.base.choices import Method as Method  # also used by the command line
from service.base.validation import (
    IDENTIFIER,
    LINE,
    LINES,
    MEASUREMENT,
    NAME,
    NO_TIME,
    not_a_number,
)

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

Text = Annotated[str, StringConstraints(pattern=LINE, max_length=500)]
"""A single line of text. Every string from a caller has this type, `Lines`, or a name type."""

Lines = Annotated[str, StringConstraints(pattern=LINES, max_length=800_000)]
"""Text with several lines."""

Search = Annotated[Text, Field(max_length=32)]
"""A part of a name."""

Reason = Annotated[Text, Field(min_length=1, max_length=200)]
"""Reason for a change."""

Kind = Literal["raw", "cropped", "flux", "flux-centered", "none"]
Source = Literal["measured", "network", "refined", "imported"]
Verdict = Literal["effect", "none", "unexplained"]
Place = Literal["mirror", "angle", "camera", "target", "geometry", "added_light"]
State = Literal["queued", "running", "done", "failed", "cancelled"]


def _is_number(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise ValueError(not_a_number(value))
    return value


# JSON has types, so a string in place of a number is an error. Forms and queries are all text and
# use float and int.
Number = Annotated[float, Strict()]
Whole = Annotated[int, BeforeValidator(_is_number)]
Flag = Annotated[bool, Strict()]

Metres = Annotated[Number, Field(ge=-1e6, le=1e6)]
Position = Annotated[
    tuple[Metres, Metres, Metres], Field(description="East, north, up of the tower base [m].")
]

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

MotorPosition = tuple[
    Annotated[Number, Field(ge=0, le=1e9)], Annotated[Number, Field(ge=0, le=1e9)]
]
"""Positions of both axes [steps]."""

AZIMUTH = Field(ge=0, lt=360, description="Sun azimuth from north over east [deg].")
ELEVATION = Field(gt=0, le=90, description="Sun elevation as seen, with refraction [deg].")
Azimuth = Annotated[Number, AZIMUTH]
Elevation = Annotated[Number, ELEVATION]
Extent = Annotated[Number, Field(ge=0.01, le=1e3)]
Irradiance = Annotated[Number, Field(gt=0, le=2000, description="Direct normal irradiance [W/m2].")]


def parse_moment(moment: datetime) -> datetime:
    """Convert a time to UTC. A time without a zone counts as UTC.

    Raises
    ------
    ValueError
        If the year is implausible.
    """
    utc = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment
    if utc < datetime(1970, 1, 1, tzinfo=UTC):
        raise ValueError("give a year from 1970 on")
    if utc >= datetime(9000, 1, 1, tzinfo=UTC):
        raise ValueError("give a year before 9000")
    return utc.astimezone(UTC)


def _read_moment(value: Any) -> Any:
    """Refuse numbers, which pydantic reads as seconds since 1970: 20260621 is no day of 1970."""
    if isinstance(value, int | float) or _SECONDS.fullmatch(str(value)):
        raise ValueError(NO_TIME)
    with suppress(ValueError):
        return read_time(value) if isinstance(value, str) else value
    return value  # pydantic says what is wrong


_SECONDS = re.compile(r"\s*[-+]?[0-9.]+\s*")
Moment = Annotated[AwareDatetime, BeforeValidator(_read_moment), AfterValidator(parse_moment)]


def read_time(text: str) -> datetime:
    """A time of ISO 8601, also with a blank for T, as ``isoformat`` and REST write it.

    Raises
    ------
    ValueError
        If it is none.
    """
    return datetime.fromisoformat(text.strip())


def unique_keys(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """The members of a JSON object, for ``object_pairs_hook``; ValueError for a key that is there
    twice.
    """
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"{key[:60]!r} is there twice; keep one")
        found[key] = value
    return found


def _read_form_time(text: Any) -> Any:
    if isinstance(text, datetime):
        return text
    try:
        moment = read_time(str(text))
    except ValueError as error:
        raise ValueError(
            "give a date and a time as 2026-06-21 13:00, in the plant's time zone"
        ) from error
    parse_moment(moment)
    return moment


FormMoment = Annotated[datetime, BeforeValidator(_read_form_time)]
"""Times in forms: ``2026-06-21 13:00``, in the plant's time zone unless an offset follows.

Forms do not know the zone; see `Model.in_utc`.
"""


def plant_time_to_utc(moment: datetime, zone: str) -> datetime:
    """A time of a form in UTC. Without an offset it is in ``zone``, which is the plant's."""
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=ZoneInfo(zone))
    return moment.astimezone(UTC)


def _read_form_day(text: Any) -> Any:
    if type(text) is date:
        return text
    try:
        day = date.fromisoformat(str(text).strip())
    except ValueError as error:
        raise ValueError("give a day as 2026-06-21, in the plant's time zone") from error
    parse_moment(datetime.combine(day, time()))
    return day


FormDay = Annotated[date, BeforeValidator(_read_form_day)]
"""Days in forms: ``2026-06-21``, in the plant's time zone; see `start_of_day`."""


def start_of_day(day: date | None, zone: str, later: int = 0) -> datetime | None:
    """The start in UTC of a day of a form, or of the day ``later`` days after it."""
    if day is None:
        return None
    return plant_time_to_utc(datetime.combine(day + timedelta(days=later), time()), zone)


# Fields of responses.
Id = Annotated[int, Field(description="Number of the entry, from 1; paths name it by this.")]
HeliostatOf = Annotated[str, Field(description="Name of the heliostat.")]
TargetOf = Annotated[str, Field(description="Name of the target or receiver.")]
CreatedAt = Annotated[datetime, Field(description="When it was stored.")]
Author = Annotated[str, Field(description="Name of the key that did it; `local` without keys.")]
Why = Annotated[str, Field(description="The reason, as it was given or determined.")]
SurfaceVersion = Annotated[int, Field(description="Version of the heliostat's surface, from 1.")]
SurfaceSource = Annotated[
    Source,
    Field(description="How the surface was obtained: measured, predicted, refined or imported."),
]
UpTo = Annotated[datetime, Field(description="When it ended.")]
From = Annotated[datetime, Field(description="When it began.")]

Version = Annotated[int, Field(ge=1, le=2**31 - 1)]
"""For paths and queries."""
ReadVersion = Annotated[int, Field(ge=0, le=2**31 - 1)] | None
"""For forms: the hidden version of what the page showed."""
VersionIn = Annotated[Whole, Field(ge=1, le=2**31 - 1)]
"""For bodies."""

ModelVersion = Annotated[
    VersionIn | None,
    Field(
        description=(
            "Number of a version of the plant's model, see /v1/models; the current one without it."
        )
    ),
]


def _number_of(version: Any) -> Any:
    return int(version.partition(":")[0]) if isinstance(version, str) else version


ModelNumber = Annotated[int, BeforeValidator(_number_of)]
"""A version of the plant's model, also from the text of number and effects in the store."""


def drop_empty_fields(given: Any) -> Any:
    """Remove empty fields from a submitted form. For validators in mode "before"."""
    return (
        {name: value for name, value in given.items() if value != ""}
        if isinstance(given, dict)
        else given
    )


# Limit of listed errors. A list of 100,000 errors takes a second.
_MAX_FAULTS = 100

# Entries per list and object that are validated again if a document has more errors.
_FIRST = 10


def _shortened(value: Any, fields: Iterable[str] = ()) -> Any:
    """The first entries of all nested lists and objects, and all ``fields`` keys."""
    if isinstance(value, dict):
        names = dict.fromkeys([*(name for name in fields if name in value), *islice(value, _FIRST)])
        return {name: _shortened(value[name]) for name in names}
    return [_shortened(entry) for entry in value[:_FIRST]] if isinstance(value, list) else value


Schema = TypeVar("Schema", bound=BaseModel)


class Model(BaseModel):
    """Base class of requests: finite numbers, no unknown keys."""

    model_config = ConfigDict(allow_inf_nan=False, extra="forbid", frozen=True)

    def in_utc(self, zone: str) -> Self:
        """The same form with its times in UTC; see `plant_time_to_utc`."""
        times = {
            name: plant_time_to_utc(value, zone)
            for name, value in self
            if isinstance(value, datetime)
        }
        return self.model_copy(update=times)

    @model_validator(mode="wrap")
    @classmethod
    def _few_faults(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Limit a document's errors to those of its first entries, to bound their cost."""
        try:
            return handler(data)
        except ValidationError as error:
            count = error.error_count()
            if count <= _MAX_FAULTS:
                raise
        try:
            handler(_shortened(data, cls.model_fields))
        except ValidationError as error:
            if error.error_count() <= _MAX_FAULTS:
                raise
        raise ValueError(f"has {count} faults; send fewer entries to see which")


def from_row(schema: type[Schema], row: object, /, **others: object) -> Schema:
    """The schema of a row: ``others``, and for the other fields the attributes of their names."""
    names = schema.model_fields.keys() - others.keys()
    return schema.model_validate({name: getattr(row, name) for name in names} | others)


class Plane(Model):
    """A rectangle in space, seen from its irradiated side."""

    center: Position
    normal: Direction = Field(
        description="Normal of the lit side, east-north-up; need not be of unit length."
    )
    up: Direction = Field(
        default=(0.0, 0.0, 1.0),
        description="Upward direction of the image, not parallel to the normal.",
    )
    width: Extent = Field(description="[m]")
    height: Extent = Field(description="[m]; width and height are at most 20 times each other.")

    @model_validator(mode="after")
    def _shape(self) -> Self:
        require_plane_shape(self.width, self.height)
        return self

    def named(self, name: str) -> TargetPlane:
        """Convert to the model's target plane with this name."""
        return TargetPlane(
            name, **self.model_dump(by_alias=False, exclude={"kind", "marks", "camera"})
        )


class Sun(Model):
    """A sun position."""

    azimuth_deg: Azimuth
    elevation_deg: Elevation


class SunAt(Model):
    """The sun position over the plant at a time."""

    at: Moment = Field(description="Time with zone; by day.")


def _way_to_say(sun: Any) -> str:
    """Whether the sun is given by its position or by a time."""
    by_time = "at" in sun if isinstance(sun, dict) else isinstance(sun, SunAt)
    return "(time)" if by_time else "(position)"


SunPosition = Annotated[Sun, Field(description="Sun: azimuth from north and elevation [deg].")]
AnySun = Annotated[
    Annotated[Sun, Tag("(position)")] | Annotated[SunAt, Tag("(time)")],
    Discriminator(_way_to_say),
    Field(description='Where the sun is: its position, or the time, `{"at": ..}`.'),
]


def _square(value: Any) -> Any:
    return (
        (value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value
    )


Side = Annotated[Whole, Field(ge=8, le=1024)]

Resolution = Annotated[
    tuple[Side, Side],
    BeforeValidator(_square, json_schema_input_type=tuple[Side, Side] | Side),
    Field(description="Rows and columns of the map [px], or one number for both."),
]


JsonObject = dict[str, Any]
"""An object of JSON."""

Rows = list[list[float]]
"""A map as JSON: rows from the top."""


class AccuracyOut(BaseModel):
    """Forecast accuracy on held-out photographs."""

    accuracy_mean: float = Field(description="[1]")
    accuracy_median: float = Field(description="[1]")
    per_image: dict[str, float] = Field(description="By heliostat and measurement, `H/ID` [1].")
    position_error_mrad: float | None = Field(
        default=None,
        description=(
            "Median angle from where motors sent the light to where it lies [mrad]; null: not"
            " known."
        ),
    )


class ReportPart(BaseModel):
    """A part of a report, of which pages read the declared fields; others are kept."""

    model_config = ConfigDict(extra="allow")


class EffectScope(ReportPart):
    """When and at which heliostats an effect acts."""

    kind: Literal["set", "since", "day"] = Field(
        default="set", description="set: always; since: from a day on; day: by day."
    )
    since: date | None = Field(
        default=None, description="Day of the first photograph after the change."
    )
    until: date | None = Field(
        default=None, description="Day of the first photograph without it; null: it still acts."
    )
    heliostats: list[str] | None = Field(default=None, description="null: all, or the camera.")


class FittedParameter(ReportPart):
    """A fitted value with its 95 % interval, also by day."""

    value: Any = Field(description="A number, or numbers by heliostat.")
    ci95: Any = Field(default=None, description="Its 95 % interval, or intervals by heliostat.")
    unit: str = Field(default="", description="Unit of value, interval and values by day.")
    by_day: dict[str, float] = Field(default={}, description="Values by day [`unit`].")


class FoundEffect(ReportPart):
    """An effect that a study found."""

    name: str = Field(description="Its name in the catalogue.")
    scope: EffectScope = Field(default=EffectScope(), description="When and where it acts.")
    parameters: dict[str, FittedParameter] = Field(default={}, description="By name.")


class MeanGain(ReportPart):
    """A mean change of accuracy with its 95 % interval."""

    mean: float = Field(description="Mean change of accuracy [1].")
    ci95: tuple[float, float] = Field(description="Its 95 % interval [1].")


class TriedEffect(ReportPart):
    """An effect of the catalogue, fitted alone."""

    name: str = Field(description="Its name in the catalogue.")
    accuracy_after: float | None = Field(default=None, description="With it alone [1].")
    score: float | None = Field(default=None, description="By which candidates are ranked [1].")
    accuracy_gain: MeanGain | None = Field(default=None, description="Its gain in accuracy.")


class ResidualPattern(ReportPart):
    """Whether the residual is a pattern of the target."""

    is_targets: bool = Field(default=False, description="Whether it is one of the target.")


class Residual(ReportPart):
    """The pattern of the remaining error."""

    pattern: ResidualPattern = Field(
        default=ResidualPattern(), description="What all photographs share."
    )


class PerCovariate(ReportPart):
    """What a coefficient is proportional to: a covariate less its center."""

    covariate: str = Field(description="Name of the covariate.")
    unit: str = Field(description="Unit of the covariate.")
    center: float = Field(description="Value at which the coefficient changes nothing [`unit`].")
    limits: tuple[float, float] | None = Field(
        default=None,
        description="What photographs covered; beyond, it counts as the limit [`unit`].",
    )


class DiscrepancyCoefficient(ReportPart):
    """A signed coefficient of a correction, with its 95 % interval."""

    kind: str = Field(description="Kind of the term that it belongs to.")
    name: str = Field(description="Component of that kind.")
    of: str | None = Field(default=None, description="Heliostat or target; null: of all.")
    unit: str = Field(description="Unit of value and interval.")
    value: float = Field(description="[`unit`, and per unit of the covariate]")
    ci95: tuple[float, float] = Field(description="Its 95 % interval [`unit`].")
    per: PerCovariate | None = Field(default=None, description="null: it is constant.")


class TransferOut(ReportPart):
    """Accuracy on photographs of a group that no fit saw."""

    before: float = Field(description="By the declared model [1].")
    after: float = Field(description="By a correction that was fitted to the other groups [1].")


class RivalOut(ReportPart):
    """Another correction that gains nearly as much."""

    in_words: str = Field(description="What it is.")
    gain_share: float = Field(description="Its gain, as a share of the first term's [1].")
    distinguished_by: str = Field(description="Photographs in which the two differ.")


class DiscrepancyOut(ReportPart):
    """A correction of forecasts that no effect of the catalogue describes; it is not a cause."""

    lives_in: Place | None = Field(
        description="Where it acts; null: terms of one place leave too much."
    )
    scaling: str = Field(description="Covariate of its first term; constant: none.")
    owner: Literal["all", "heliostat", "camera", "target"] = Field(
        description="What has separate coefficients in its first term."
    )
    explained_share: float = Field(description="Share of the error beyond noise it removes [1].")
    accuracy_after: float = Field(description="Mean accuracy of held-out photographs [1].")
    per_image: dict[str, float] = Field(default={}, description="Accuracy of each of them [1].")
    accuracy_gain: MeanGain = Field(description="Its gain on them.")
    transfer: dict[str, TransferOut | None] = Field(
        description="By heliostats, days and targets; null where it cannot be tested."
    )
    rival: RivalOut | None = Field(
        default=None, description="null: no other term gains half as much as the first."
    )
    coefficients: list[DiscrepancyCoefficient] = Field(description="Of all terms, in their order.")
    in_words: str = Field(description="All that in sentences.")


class StudyReport(ReportPart):
    """The result of a study, also of `heliotwin study`. Optional parts have defaults."""

    verdict: Verdict = Field(
        description="effect: it is found; none: nothing is missing; unexplained: something is."
    )
    conclusion: str = Field(default="", description="The verdict in one sentence.")
    images: dict[str, int] = Field(description="How many were fitted and how many judged the fit.")
    before: AccuracyOut = Field(description="By the model that the study was made with.")
    after: AccuracyOut = Field(description="With the effects that were found.")
    noise_floor: float = Field(description="Error that the photographs' noise alone makes [1].")
    unexplained_share: float = Field(
        description="Share of the error beyond the noise that is left [1]."
    )
    partly: list[str] = Field(
        default=[],
        description=(
            "Effects that gain, but leave too much to be the cause; they cannot be adopted."
        ),
    )
    discrepancy: DiscrepancyOut | None = Field(
        default=None, description="What has no name: a correction with a place and a scaling."
    )
    skipped: dict[str, str] = Field(default={}, description="What was left out, with the reasons.")
    effects: list[FoundEffect] = Field(
        description=(
            "What was found: parameters with 95 % intervals, scope (when, and whose where "
            "it names `heliostats`), gain."
        )
    )
    candidates: list[TriedEffect] = Field(
        description="Every effect tried by itself, the best first."
    )
    residual: Residual = Field(default=Residual(), description="What is left.")

    @property
    def accuracies(self) -> dict[str, float]:
        """Accuracies of held-out photographs with what would be adopted."""
        return self.after.per_image if self.discrepancy is None else self.discrepancy.per_image


class PredictedErrorOut(BaseModel):
    """Pointing error of photographs that a calibration has not seen."""

    median: float | None = Field(
        description=(
            "Median angle at the mirror between forecast and measured spots [mrad], by measurements"
            " that were left out; null for fewer than 3, or too many outliers."
        )
    )
    ci90: tuple[float, float] | None = Field(description="Interval of 90 % of spots [mrad].")
    measurements: int = Field(description="Number of measurements that were left out in turn.")


class MountReport(BaseModel):
    """The result of a mount calibration, also of `heliotwin calibrate`."""

    sun: list[dict[str, Any]] = Field(
        default=[],
        description="Effects of the plant's model that moved the sun when it was calibrated.",
    )
    measurements: int = Field(description="How many measurements the calibration used.")
    predicted_error_mrad: PredictedErrorOut = Field(
        default=PredictedErrorOut(median=None, ci90=None, measurements=0),
        description="Pointing error that a next photograph will show [mrad].",
    )
    parameters: dict[str, dict[str, Any]] = Field(
        description=(
            "By name: value, std, prior_std, unit, and whether the measurements determine it."
        )
    )
    steps: list[dict[str, Any]] = Field(
        description="Steps of the drives' zeros, each between two measurements."
    )
    drift: dict[str, Any] = Field(
        description="How far the zeros went slowly from the first measurement to the newest."
    )
    outliers: dict[str, dict[str, Any]] = Field(
        description="Measurements that contradict all others, and why."
    )


OfAxes = tuple[float, float]
"""One value per axis."""


class MountStep(BaseModel):
    """A step in the zero positions of a drive."""

    after: str
    before: str
    begin: datetime = Field(alias="from")
    to: datetime
    zeros_mrad: OfAxes
    motor_steps: OfAxes
    detail: str = ""


class MountDrift(BaseModel):
    """A slow drift of the zero positions."""

    zeros_mrad: OfAxes
    is_sure: bool


class MountOutlier(BaseModel):
    """A measurement that contradicts all others."""

    reason: str
    detail: str
    off_mrad: float


class ClockReport(BaseModel):
    """A clock error; see `model.pointing.report.clock_to_json`."""

    minutes: float
    std_minutes: float
    since: date


class MountHistory(BaseModel):
    """The times of the measurements; None where it is unknown."""

    at: list[datetime | None] = Field(min_length=1)


class CheckedMountReport(MountReport):
    """A mount report for pages and jobs, with the open parts of `MountReport` checked."""

    steps: list[MountStep]  # type: ignore[assignment]
    drift: MountDrift  # type: ignore[assignment]
    outliers: dict[str, MountOutlier]  # type: ignore[assignment]
    history: MountHistory
    clock: ClockReport | None = None
