"""What travels over HTTP: requests are checked here once, units stand in the descriptions.

Numbers are finite, unknown keys are refused, and names fit a pattern that is safe in paths and URLs.
"""

from datetime import UTC, datetime
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    StringConstraints,
    model_validator,
)

from model.plant import Cylinder, TargetPlane
from service.names import IDENTIFIER, NAME

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
    StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,95}$"),
    Field(description="The `id` of a measurement, as the service gave it.", examples=["205363"]),
]
Kind = Literal["raw", "cropped", "flux", "flux-centered"]
Source = Literal["measured", "network", "refined", "imported"]
Method = Literal["network", "refined"]
Verdict = Literal["effect", "none", "unexplained"]
State = Literal["queued", "running", "done", "failed", "cancelled"]

Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Position = Annotated[tuple[Metres, Metres, Metres], Field(description="East, north, up of the tower base [m].")]
Direction = tuple[
    Annotated[float, Field(ge=-1e3, le=1e3)],
    Annotated[float, Field(ge=-1e3, le=1e3)],
    Annotated[float, Field(ge=-1e3, le=1e3)],
]
Wgs84 = tuple[
    Annotated[float, Field(ge=-90, le=90)],
    Annotated[float, Field(ge=-180, le=180)],
    Annotated[float, Field(ge=-1e4, le=1e5)],
]
Azimuth = Annotated[float, Field(ge=-360, le=360, description="Sun azimuth from south, positive to the east [deg].")]
Elevation = Annotated[float, Field(gt=0, le=90, description="Sun elevation above the horizon [deg].")]
Extent = Annotated[float, Field(ge=0.01, le=1e3)]

Moment = Annotated[
    AwareDatetime,
    Field(ge=datetime(1970, 1, 1, tzinfo=UTC), lt=datetime(9000, 1, 1, tzinfo=UTC)),
    AfterValidator(lambda moment: moment.astimezone(UTC)),
]

Version = Annotated[int, Field(ge=1, le=2**31 - 1)]
ModelVersion = Annotated[
    Version | None,
    Field(description="Number of a version of the plant's model, see /v1/models; the current one without it."),
]

Item = TypeVar("Item")


# Nesting that no document of PAINT's reaches, far below Python's recursion limit.
_MAX_DEPTH = 32
# Larger than any of PAINT's numbers, and small enough that the tracer's single precision holds its square.
_MAX_NUMBER = 1e15


def _is_text(value: str) -> bool:
    return not any(character == "\x00" or "\ud800" <= character <= "\udfff" for character in value)


def _check_json(value: Any, where: str = "document", depth: int = 0) -> Any:
    """Refuse what JSON's grammar lets through but numbers and databases do not hold, wherever it is nested."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"{where}: nested too deeply")
    if isinstance(value, dict):
        for key, entry in value.items():
            _check_json(key, where, depth + 1)
            _check_json(entry, f"{where}.{key}", depth + 1)
    elif isinstance(value, list):
        for index, entry in enumerate(value):
            _check_json(entry, f"{where}[{index}]", depth + 1)
    elif isinstance(value, int | float) and not abs(value) < _MAX_NUMBER:
        raise ValueError(f"{where}: must be a finite number of less than {_MAX_NUMBER:g}")
    elif isinstance(value, str) and not _is_text(value):
        raise ValueError(f"{where}: must not hold NUL or half characters")
    return value


class Model(BaseModel):
    """Base of the requests: finite numbers, no unknown keys."""

    model_config = ConfigDict(allow_inf_nan=False, extra="forbid", frozen=True)


class Document(BaseModel):
    """Base of documents in PAINT's format: kept as they come, only what is used of them is checked."""

    model_config = ConfigDict(allow_inf_nan=False, extra="allow")

    _raw: dict[str, Any] = PrivateAttr(default_factory=dict)

    @model_validator(mode="wrap")
    @classmethod
    def _keep(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        document = handler(_check_json(data))
        document._raw = data if isinstance(data, dict) else {}
        return document

    @property
    def raw(self) -> dict[str, Any]:
        """The document as it came."""
        return self._raw


class Page(BaseModel, Generic[Item]):
    """A part of a list."""

    items: list[Item]
    next: str | None = Field(description="Pass as `after` for the next page; null on the last.")


# --- plant, heliostats, targets ---------------------------------------------------------------------------------------


class PowerPlantProperties(BaseModel):
    """PAINT's ``power_plant_properties``."""

    model_config = ConfigDict(allow_inf_nan=False, extra="allow")

    ID: Name = Field(description="Name of the plant.", examples=["WRI1030197"])
    coordinates: Wgs84 = Field(description="Tower base: latitude [deg], longitude [deg], altitude [m].")


class TowerMeasurements(Document):
    """PAINT's ``tower-measurements.json``: the tower base, and each planar target by its WGS84 corners."""

    power_plant_properties: PowerPlantProperties


class PlantOut(BaseModel):
    """The plant."""

    name: str
    origin_wgs84: tuple[float, float, float] = Field(
        description="Tower base: latitude [deg], longitude [deg], altitude [m]."
    )
    declared: dict[str, Any] | None = Field(
        description="What is declared of its model, as in twin.json; null: Buie's sun with a ratio of 0.02, no effects."
    )


class KinematicsProperties(BaseModel):
    """PAINT's ``kinematics_properties``, as far as its shape matters."""

    model_config = ConfigDict(extra="allow")

    actuators: list[dict[str, Any]] = Field(max_length=2)


class FacetProperties(BaseModel):
    """PAINT's ``facet_properties``, as far as its shape matters."""

    model_config = ConfigDict(extra="allow")

    facets: list[dict[str, Any]] = Field(min_length=1, max_length=64)


class HeliostatProperties(Document):
    """PAINT's ``heliostat-properties.json``, kept as it comes; older files say ``kinematic_properties``."""

    heliostat_position: Wgs84 = Field(description="Latitude [deg], longitude [deg], altitude [m].")
    width: Extent = Field(description="Width of the mirror [m].")
    height: Extent = Field(description="Height of the mirror [m].")
    kinematics_properties: KinematicsProperties | None = Field(default=None, description="The mount and its actuators.")
    kinematic_properties: KinematicsProperties | None = Field(default=None, description="The same in older files.")
    facet_properties: FacetProperties = Field(description="Facets: position [m] and canting vectors [m].")


class HeliostatIn(Model):
    """A heliostat to be stored."""

    name: Name
    properties: HeliostatProperties


class HeliostatSummary(BaseModel):
    """A heliostat in a list."""

    name: str
    position_m: tuple[float, float, float] = Field(description="East, north, up of the tower base [m].")


class HeliostatOut(HeliostatSummary):
    """A heliostat with its properties."""

    properties: dict[str, Any] = Field(description="PAINT properties as they were sent.")
    updated_at: datetime


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
    radius: Annotated[float, Field(ge=0.01, lt=1e3)] = Field(description="[m]")
    height: Extent = Field(description="Along the axis [m].")
    opening_deg: float = Field(
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


class ReceiverOut(BaseModel):
    """A cylindrical receiver."""

    name: str
    center: tuple[float, float, float] = Field(description="The middle of the lit surface [m].")
    normal: tuple[float, float, float] = Field(description="Unit normal there, away from the axis.")
    up: tuple[float, float, float] = Field(description="Unit vector along the axis.")
    radius: float = Field(description="[m]")
    height: float = Field(description="[m]")
    opening_deg: float = Field(description="Angle of the lit surface [deg].")


class Corners(Model):
    """A target by its corners as seen from the field, in WGS84 (latitude [deg], longitude [deg], altitude [m])."""

    upper_left: Wgs84 = Field(description="[deg, deg, m]")
    upper_right: Wgs84 = Field(description="[deg, deg, m]")
    lower_left: Wgs84 = Field(description="[deg, deg, m]")
    lower_right: Wgs84 = Field(description="[deg, deg, m]")


class TargetIn(Model):
    """A target plane, either by its rectangle in east-north-up metres or by its four corners in WGS84."""

    plane: Plane | None = None
    corners: Corners | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.plane is None) == (self.corners is None):
            raise ValueError("give either plane or corners")
        return self


class TargetOut(BaseModel):
    """A target plane."""

    name: str
    center: tuple[float, float, float] = Field(description="East, north, up of the tower base [m].")
    normal: tuple[float, float, float] = Field(description="Unit normal of the lit side.")
    up: tuple[float, float, float] = Field(description="Unit vector up the image.")
    width: float = Field(description="[m]")
    height: float = Field(description="[m]")
    corners: dict[str, Any] | None = Field(description="The WGS84 corners that it was made from, if it was.")


# --- measurements -----------------------------------------------------------------------------------------------------


def _paint_motors(value: Any) -> Any:
    """A pair out of PAINT's ``motor_position`` object."""
    if isinstance(value, dict) and set(value) == {"axis_1_motor_position", "axis_2_motor_position"}:
        return value["axis_1_motor_position"], value["axis_2_motor_position"]
    return value


def _paint_spot(value: Any) -> Any:
    """One position out of PAINT's ``focal_spot`` object: UTIS, else HeliOS."""
    if isinstance(value, dict) and value and set(value) <= {"UTIS", "HeliOS"}:
        return value.get("UTIS") or value.get("HeliOS")
    return value


Motors = Annotated[
    tuple[Annotated[float, Field(ge=-1e9, le=1e9)], Annotated[float, Field(ge=-1e9, le=1e9)]],
    BeforeValidator(_paint_motors),
]
Pixel = tuple[Annotated[float, Field(ge=-1e5, le=1e5)], Annotated[float, Field(ge=-1e5, le=1e5)]]


class MeasurementIn(Model):
    """What is known of a photograph; PAINT's ``calibration-properties.json`` with ``kind`` (and ``id``) added fits."""

    target_name: Name = Field(description="The target that the heliostat was aimed at.")
    sun_azimuth: Azimuth
    sun_elevation: Elevation
    kind: Kind = Field(
        description="raw: a camera frame; cropped: the rectified target; flux: the separated spot on the whole "
        "target; flux-centered: the spot about its centre of mass, already separated."
    )
    id: Identifier | None = Field(default=None, description="The caller's own number of the measurement.")
    taken_at: Moment | None = Field(default=None, description="When it was taken, with time zone.")
    motor_position: Motors | None = Field(
        default=None, description="Motor positions of both axes [steps], as a pair or as PAINT's object."
    )
    focal_spot: Annotated[Wgs84, BeforeValidator(_paint_spot)] | None = Field(
        default=None,
        description="Known centre of mass: latitude [deg], longitude [deg], altitude [m], or PAINT's object (UTIS is "
        "preferred).",
    )
    corners: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        default=None,
        description="Positions (x, y) [px] of the target's upper left, upper right, lower left and lower right "
        "corners in a raw frame; without them they are searched.",
    )


class MeasurementOut(BaseModel):
    """A stored measurement."""

    id: str = Field(description="Names it in this service's paths.")
    heliostat: str
    external_id: str | None = Field(description="The caller's own number.")
    kind: Kind
    target_name: str
    sun_azimuth: float = Field(description="From south, positive to the east [deg].")
    sun_elevation: float = Field(description="[deg]")
    motor_position: tuple[float, float] | None = Field(description="[steps]")
    taken_at: datetime | None
    focal_spot: tuple[float, float, float] | None = Field(
        description="As given: latitude [deg], longitude [deg], altitude [m]."
    )
    accepted: bool = Field(description="Whether the image can be used; a refused one is kept with its reason.")
    reason: str | None = Field(description="Why it was refused.")
    quality: dict[str, Any] = Field(description="The quality record of the image.")
    center_of_mass: tuple[float, float] | None = Field(description="Right and up of the target's centre [m].")
    image_sha256: str
    image_media_type: str
    created_at: datetime


# --- surfaces ---------------------------------------------------------------------------------------------------------


class SurfaceIn(Model):
    """How to predict a surface; without ``measurements`` the newest accepted ones are chosen."""

    method: Method = Field(default="network", description="network: at once; refined: fitted through the ray tracer.")
    measurements: list[MeasurementName] | None = Field(
        default=None, min_length=1, max_length=8, description="Ids of 1 to 8 accepted measurements."
    )
    images: int = Field(
        default=8,
        ge=1,
        le=8,
        description="How many of the newest accepted ones to take, spread over the sun's positions.",
    )
    model_version: ModelVersion = None


class SurfaceSummary(BaseModel):
    """A version of a surface."""

    heliostat: str
    version: int
    source: Source
    model: str | None = Field(description="Name and hash of the network's weights.")
    model_version: str | None = Field(
        description="Version of the plant's model that it was predicted by; null: it was measured."
    )
    created_at: datetime
    valid_from: datetime = Field(description="The mirror is taken to have this surface from then on.")
    measurements: list[str] = Field(description="Ids of the measurements that it was made from.")
    misfit: float | None = Field(description="What the refinement left unexplained of the flux.")


class SurfaceOut(SurfaceSummary):
    """A surface with its arrays."""

    z: list[Any] = Field(
        description="Control heights (4, 8, 8) [m]: facet, along x, along y; deviation from the ideally canted facet."
    )
    z_std: list[Any] = Field(description="Their standard deviations (4, 8, 8) [m].")
    control_points: list[Any] = Field(description="(4, 8, 8, 3) [m] in heliostat coordinates.")


# --- forecasts --------------------------------------------------------------------------------------------------------


class Sun(Model):
    """Where the sun stands."""

    azimuth_deg: Azimuth
    elevation_deg: Elevation


def _square(value: Any) -> Any:
    return (value, value) if isinstance(value, int) and not isinstance(value, bool) else value


Side = Annotated[int, Field(ge=8, le=1024)]
Resolution = Annotated[
    tuple[Side, Side],
    BeforeValidator(_square),
    Field(description="Rows and columns of the map, or one number for both."),
]


class ForecastIn(Model):
    """A flux map to compute."""

    heliostat: Name
    target: Name | None = Field(default=None, description="A stored target; either this or `plane`.")
    plane: Plane | None = Field(default=None, description="Any plane; either this or `target`.")
    sun: Sun
    aim_point: Position | None = Field(
        default=None, description="Where the heliostat aims [m]; by default the plane's centre."
    )
    surface: Literal["current", "ideal"] | Version = Field(
        default="current", description="The heliostat's current surface, the ideal one, or a version."
    )
    dni_w_m2: float = Field(default=1000.0, gt=0, le=2000, description="Direct normal irradiance [W/m2].")
    resolution: Resolution = (256, 256)
    window: float | None = Field(
        default=None,
        ge=0.01,
        le=1e3,
        description="Side of a square about the centre of mass to map [m]; else the plane.",
    )
    normalised: bool = Field(default=False, description="Scale the map to a sum of 100 instead of W/m2.")
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.target is None) == (self.plane is None):
            raise ValueError("give either target or plane")
        return self


class ForecastSummary(BaseModel):
    """A computed flux map without its pixels."""

    id: int
    heliostat: str
    surface_version: int | None = Field(description="null: the ideal surface.")
    target: str | None
    plane: Plane = Field(description="The plane that the light falls on [m].")
    sun: Sun
    aim_point: tuple[float, float, float] | None = Field(description="[m], as given.")
    dni_w_m2: float = Field(description="[W/m2]")
    window: float | None = Field(description="Side of the mapped square about the centre of mass [m]; null: the plane.")
    resolution: tuple[int, int] = Field(description="Rows, columns.")
    normalised: bool
    unit: str = Field(description="Unit of the map: W/m2, or 1 where it is normalised to a sum of 100.")
    peak_w_m2: float = Field(description="Largest irradiance [W/m2].")
    power_w: float = Field(description="Power on the mapped area [W].")
    center_of_mass: tuple[float, float] | None = Field(description="Right and up of the plane's centre [m].")
    model_version: str = Field(description="Version of the plant's model: its number and effects.")
    created_at: datetime


class ForecastOut(ForecastSummary):
    """A computed flux map."""

    flux: list[Any] = Field(description="Rows from the top, columns from the left as seen from the lit side.")


# --- studies and models -----------------------------------------------------------------------------------------------


class AccuracyOut(BaseModel):
    """How well held-out photographs are forecast."""

    accuracy_mean: float = Field(description="[1]")
    accuracy_median: float = Field(description="[1]")
    per_image: dict[str, float] = Field(description="By heliostat and measurement, `H/ID` [1].")


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
    effects: list[dict[str, Any]] = Field(description="What was found: parameters with 95 % intervals, gain.")
    candidates: list[dict[str, Any]] = Field(description="Every effect tried by itself, the best first.")
    skipped: dict[str, str] = Field(default={}, description="What was left out, with the reasons.")


class StudySummary(BaseModel):
    """A study without its figures."""

    id: int
    created_at: datetime
    created_by: str = Field(description="Name of the key that asked for it.")
    options: dict[str, Any] = Field(description="What was asked.")
    heliostats: list[str] = Field(description="Those whose photographs were studied.")
    taken_from: datetime | None = Field(description="When the first photograph was taken, where that is known.")
    taken_to: datetime | None = Field(description="When the last one was.")
    model_version: str = Field(description="Version of the plant's model that the photographs were held against.")
    adopted: str | None = Field(description="Version of the model that stands for what was found, unless withdrawn.")
    verdict: Verdict = Field(description="effect: it is found; none: nothing is missing; unexplained: something is.")
    conclusion: str


class StudyOut(StudySummary, StudyReport):
    """A study with its report."""


class AdoptIn(Model):
    """How to adopt what a study found."""

    force: bool = Field(
        default=False,
        description="Also where its verdict is not `effect`, or another version of the model is current by now, which "
        "it then takes the place of.",
    )


class ModelOut(BaseModel):
    """A version of the plant's model."""

    number: int = Field(description="Ask for it as `model_version`.")
    version: str = Field(description="Number and names of its effects.", examples=["2:camera_response"])
    is_current: bool = Field(description="Whether forecasts and predictions are made by it.")
    effects: list[dict[str, Any]] = Field(description="Its effects with their parameters.")
    study: int | None = Field(description="The study that it was adopted from; null: the declared model.")
    adopted_at: datetime | None
    adopted_by: str | None
    withdrawn_at: datetime | None
    withdrawn_by: str | None


# --- jobs -------------------------------------------------------------------------------------------------------------


class JobOut(BaseModel):
    """A job as it stands."""

    id: int
    kind: str
    state: State = Field(description="queued, running, then for good done, failed or cancelled.")
    payload: dict[str, Any] = Field(description="What was asked.")
    progress: float = Field(description="Share that is done, 0 to 1 [1].")
    message: str = Field(description="What is being done.")
    attempts: int = Field(description="How often it was begun.")
    cancel_requested: bool = Field(description="It ends as soon as its worker sees this.")
    reason: str | None = Field(description="Why it failed, or why it is tried again.")
    result: dict[str, Any] | None = Field(description="What a done job gave; by its kind.")
    created_by: str = Field(description="Name of the key that asked for it.")
    created_at: datetime
    not_before: datetime = Field(description="When it is tried next at the earliest.")
    started_at: datetime | None
    finished_at: datetime | None


# --- audit trail ------------------------------------------------------------------------------------------------------


class AuditOut(BaseModel):
    """An entry of the audit trail."""

    id: int
    at: datetime
    actor: str = Field(description="Name of the key; `local` where none is demanded, `cli` and the user elsewhere.")
    action: str = Field(examples=["key.withdrawn"])
    subject: str = Field(examples=["key calibration"])
    detail: dict[str, Any]


# --- health and problems ----------------------------------------------------------------------------------------------


class Health(BaseModel):
    """The state of the service; each check is "ok" or says what is wrong."""

    status: Literal["ok", "unavailable"]
    checks: dict[str, str]


class FieldProblem(BaseModel):
    """What is wrong with one field of the request."""

    field: str = Field(examples=["sun.elevation_deg"])
    message: str = Field(examples=["Input should be less than or equal to 90"])


class Problem(BaseModel):
    """An error, by RFC 9457."""

    type: str = Field(examples=["about:blank"])
    title: str = Field(examples=["Unprocessable Content"])
    status: int = Field(examples=[422])
    detail: str = Field(examples=["sun.elevation_deg: Input should be less than or equal to 90"])
    instance: str = Field(examples=["/v1/forecasts"])
    request_id: str = Field(description="Quote it when reporting a fault; it stands in the service's log.")
    errors: list[FieldProblem] | None = Field(
        default=None, description="Every field at fault, where there are several."
    )
    offered: list[str] | None = Field(default=None, description="Acceptable media types, where none was acceptable.")
