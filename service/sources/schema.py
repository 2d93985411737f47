"""Schema of PAINT's documents, from files and over HTTP.

Source: the PAINT database of the Solar Tower Juelich, https://paint-database.org.
"""

from datetime import datetime
from typing import Annotated, Any, Self, TypeVar

from pydantic import (
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from model.errors import InvalidInputError
from model.pointing import Weather
from service.base.fields import Direction, Elevation, Extent, Name, Number, Wgs84, parse_moment
from service.base.plant import ReceiverIn, TowerSize
from service.base.validation import FORMS, LINES, format_validation_error, is_text
from service.sources.plant_schema import LocatorDocument, Spindle

WindSpeed = Annotated[Number, Field(ge=0, le=100)]
WindFrom = Annotated[Number, Field(ge=0, le=360)]
Temperature = Annotated[Number, Field(ge=-90, le=60)]
AzimuthFromSouth = Annotated[Number, Field(ge=-360, le=360)]
Vector = Annotated[tuple[Number, Number, Number], Field(description="East, north, up [m].")]
Meters = Annotated[Number, Field(description="Length [m].")]

# Deeper than any document of PAINT, far below Python's recursion limit.
_MAX_DEPTH = 32

# Most values of a document, a hundred times those of PAINT's largest.
_MAX_VALUES = 20_000

# Larger than any number of PAINT, and small enough that its square fits the tracer's single
# precision.
_MAX_NUMBER = 1e15


def _check_json(document: Any) -> Any:
    """Reject valid JSON that floats or databases cannot hold, at any level."""
    pending, count = [(document, "document", 0)], 0
    while pending:
        value, where, depth = pending.pop()
        if depth > _MAX_DEPTH:
            raise ValueError(f"{where}: nested too deeply")
        if isinstance(value, dict | list):
            count += len(value)
            if count > _MAX_VALUES:
                raise ValueError(
                    f"{where}: the document has more than {_MAX_VALUES} values; leave some out"
                )
        if isinstance(value, dict):
            pending.extend((key, where, depth + 1) for key in value)
            pending.extend((entry, f"{where}.{key}", depth + 1) for key, entry in value.items())
        elif isinstance(value, list):
            pending.extend(
                (entry, f"{where}[{index}]", depth + 1) for index, entry in enumerate(value)
            )
        elif isinstance(value, int | float) and not abs(value) < _MAX_NUMBER:
            raise ValueError(f"{where}: must be a finite number of less than {_MAX_NUMBER:g}")
        elif isinstance(value, str) and not is_text(value):
            raise ValueError(
                f"{ascii(where)[1:-1]}: must be {FORMS[LINES]}, and of whole characters"
            )
    return document


STORED = object()
"""Validation context of documents that are checked already, because the store has them."""


class Document(BaseModel):
    """Base of documents in PAINT's format: stored as received, only the fields in
    use are checked.
    """

    model_config = ConfigDict(allow_inf_nan=False, extra="allow")

    _raw: dict[str, Any] = PrivateAttr(default_factory=dict)

    @model_validator(mode="wrap")
    @classmethod
    def _keep(
        cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo
    ) -> Self:
        document = handler(data if info.context is STORED else _check_json(data))
        document._raw = data if isinstance(data, dict) else {}
        return document

    @property
    def raw(self) -> dict[str, Any]:
        """The document as received."""
        return self._raw


class DocumentPart(BaseModel):
    """Base of parts of PAINT's documents; fields that are not in use are not checked."""

    model_config = ConfigDict(allow_inf_nan=False, extra="allow")


Checked = TypeVar("Checked", bound=BaseModel)


def parse(
    schema: type[Checked], document: Any, where: str, context: object | None = None
) -> Checked:
    """Validate a document; InvalidInputError names ``where`` it is and its first wrong field."""
    try:
        return schema.model_validate(document, context=context)
    except ValidationError as error:
        raise InvalidInputError(f"{where}: {format_validation_error(error)}") from None


# --- tower
# --------------------------------------------------------------------------------------------------


class TowerBase(DocumentPart):
    """The tower base in ``power_plant_properties``."""

    coordinates: Wgs84 = Field(
        description="Tower base: latitude [deg], longitude [deg], altitude [m]."
    )


class PowerPlantProperties(TowerBase):
    """PAINT's ``power_plant_properties``."""

    ID: Name = Field(description="Name of the plant.", examples=["WRI1030197"])


class PlanarTarget(DocumentPart):
    """A target of the type ``planar``; its places are in WGS84.

    ``locator`` is heliotwin's: how photographs show where it is.
    """

    coordinates: dict[str, Wgs84]
    locator: LocatorDocument | None = None


class CylindricalReceiver(DocumentPart):
    """A receiver of the type ``convex_cylinder``; radius in [m], opening angle in [deg]."""

    coordinates: dict[str, Wgs84]
    radius: Annotated[Number, Field(gt=0)]
    opening_angle: Number
    normal_vector: Direction


class DeclaredOptics(BaseModel):
    """``optics`` of ``twin.json``; published attenuations have four coefficients."""

    model_config = ConfigDict(allow_inf_nan=False, extra="forbid")

    reflectivity: Annotated[Number, Field(ge=0, le=1)] = 1.0
    attenuation: list[Annotated[Number, Field(ge=-1e6, le=1e6)]] = Field([], max_length=8)


class ReceiversPart(BaseModel):
    """What ``tower-measurements.json`` may have in addition to PAINT."""

    receivers: dict[Name, ReceiverIn] = Field(
        default={}, max_length=64, description="Receivers of every kind by name, as PUT sets them."
    )
    tower_size: TowerSize | None = Field(
        default=None, description="The tower, which casts a shadow; null: as it was."
    )


class TowerMeasurements(Document, ReceiversPart):
    """PAINT's ``tower-measurements.json``: the tower base, and planar targets by WGS84 corners."""

    power_plant_properties: PowerPlantProperties = Field(description="Name and tower base.")
    declared: dict[str, object] | None = Field(
        default=None,
        description=(
            "What twin.json declares of the plant's model: `sun` (Buie's with `chi`, or with `csr`,"
            " the true circumsolar share), `effects`, and `optics` with"
            " `reflectivity` (0 to 1, by default 1) and `attenuation`, the share of light lost"
            " between mirror and target as coefficients of a polynomial in the slant range in"
            " kilometres, the constant first (by default none: clear air)."
        ),
        examples=[
            {"optics": {"reflectivity": 0.92, "attenuation": [0.006739, 0.1046, -0.017, 0.002845]}}
        ],
    )


# --- heliostats
# --------------------------------------------------------------------------------------------------


class LinearAxis(Spindle):
    """A spindle with PAINT's names."""

    model_config = ConfigDict(extra="ignore")

    clockwise: bool = Field(alias="clockwise_axis_movement")


class KinematicsProperties(DocumentPart):
    """PAINT's ``kinematics_properties`` [m]: the mount and its actuators."""

    actuators: list[dict[str, object]] = Field(max_length=2, description="Drives of both axes.")
    joint_translation_e_1: Meters
    joint_translation_n_1: Meters
    joint_translation_u_1: Meters
    joint_translation_e_2: Meters
    joint_translation_n_2: Meters
    joint_translation_u_2: Meters
    concentrator_translation_n: Meters


class FacetDocument(DocumentPart):
    """A facet's position and canting vectors [m]."""

    translation_vector: Vector
    canting_e: Vector
    canting_n: Vector


class FacetProperties(DocumentPart):
    """PAINT's ``facet_properties``."""

    facets: list[FacetDocument] = Field(
        min_length=1, max_length=64, description="Position and canting of each facet [m]."
    )


class HeliostatProperties(Document):
    """PAINT's ``heliostat-properties.json``, stored as received; older files have
    ``kinematic_properties``.
    """

    heliostat_position: Wgs84 = Field(description="Latitude [deg], longitude [deg], altitude [m].")
    width: Extent = Field(description="Width of the mirror [m].")
    height: Extent = Field(description="Height of the mirror [m].")
    kinematics_properties: KinematicsProperties = Field(
        validation_alias=AliasChoices("kinematics_properties", "kinematic_properties"),
        description="The mount and its actuators; older files call it `kinematic_properties`.",
    )
    facet_properties: FacetProperties = Field(
        description="Facets: position [m] and canting vectors [m]."
    )


# --- measurements
# --------------------------------------------------------------------------------------------------


def paint_motors(value: Any) -> Any:
    """Convert PAINT's ``motor_position`` object to a pair; other values stay."""
    if isinstance(value, dict) and set(value) == {"axis_1_motor_position", "axis_2_motor_position"}:
        return value["axis_1_motor_position"], value["axis_2_motor_position"]
    return value


class MotorDocument(DocumentPart):
    """PAINT's ``motor_position`` [steps]."""

    axis_1_motor_position: Number
    axis_2_motor_position: Number


class WeatherFields(BaseModel):
    """Wind and temperature of a measurement; each may be missing."""

    wind_speed_m_s: WindSpeed | None = Field(default=None, description="Of the wind then [m/s].")
    wind_from_deg: WindFrom | None = Field(
        default=None, description="Where it came from, from north, over east [deg]."
    )
    temperature_c: Temperature | None = Field(default=None, description="Of the air then [°C].")

    @property
    def weather(self) -> Weather:
        """As the model has it."""
        return Weather.of(self)


class WeatherDocument(WeatherFields, DocumentPart):
    """The weather of a measurement in PAINT's folder."""


class FocalSpots(DocumentPart):
    """PAINT's ``focal_spot``: the centroid by two methods; UTIS is preferred."""

    UTIS: Wgs84 | None = Field(
        default=None, description="Latitude [deg], longitude [deg], altitude [m]."
    )
    HeliOS: Wgs84 | None = Field(default=None, description="Likewise [deg, deg, m].")


class CalibrationProperties(Document, WeatherDocument):
    """PAINT's ``calibration-properties.json``."""

    target_name: str
    sun_azimuth: AzimuthFromSouth
    sun_elevation: Elevation
    motor_position: MotorDocument | None = None
    focal_spot: FocalSpots | None = None


def parse_time(given: Any) -> Any:
    """A time in UTC, which is also the default zone; None stays."""
    if given is None:
        return None
    try:
        moment = datetime.fromisoformat(given)
    except (TypeError, ValueError):
        raise ValueError(f"must be an ISO 8601 time, got {str(given)[:80]}") from None
    return parse_moment(moment)


class ItemProperties(WeatherDocument):
    """Properties of a STAC item: its time, or a period, and the weather."""

    taken_at: Annotated[datetime | None, BeforeValidator(parse_time)] = Field(alias="datetime")
    start_datetime: Any = None
