"""The form of PAINT's documents, as far as it is checked when they come in over HTTP."""

from typing import Annotated, Any, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    Tag,
    model_validator,
)

from service.base.fields import Extent, Model, Name, Wgs84

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


class PowerPlantProperties(BaseModel):
    """PAINT's ``power_plant_properties``."""

    model_config = ConfigDict(allow_inf_nan=False, extra="allow")

    ID: Name = Field(description="Name of the plant.", examples=["WRI1030197"])
    coordinates: Wgs84 = Field(description="Tower base: latitude [deg], longitude [deg], altitude [m].")


class TowerMeasurements(Document):
    """PAINT's ``tower-measurements.json``: the tower base, and each planar target by its WGS84 corners."""

    power_plant_properties: PowerPlantProperties
    declared: dict[str, Any] | None = Field(
        default=None,
        description="What twin.json declares of the plant's model: `sun`, `effects`, and `optics` with `reflectivity` "
        "(0 to 1, by default 1) and `attenuation`, the share of light lost between mirror and target as coefficients "
        "of a polynomial in the slant range in kilometres, the constant first (by default none: clear air).",
        examples=[{"optics": {"reflectivity": 0.92, "attenuation": [0.006739, 0.1046, -0.017, 0.002845]}}],
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


def paint_motors(value: Any) -> Any:
    """A pair out of PAINT's ``motor_position`` object."""
    if isinstance(value, dict) and set(value) == {"axis_1_motor_position", "axis_2_motor_position"}:
        return value["axis_1_motor_position"], value["axis_2_motor_position"]
    return value


class FocalSpots(Model):
    """PAINT's ``focal_spot``: where two methods found the centre of mass; UTIS is preferred."""

    UTIS: Wgs84 | None = Field(default=None, description="Latitude [deg], longitude [deg], altitude [m].")
    HeliOS: Wgs84 | None = Field(default=None, description="Likewise [deg, deg, m].")

    @model_validator(mode="after")
    def _some(self) -> Self:
        if self.UTIS is None and self.HeliOS is None:
            raise ValueError("give UTIS, HeliOS, or both; else leave it out")
        return self


def _spot_by(told: Any) -> str:
    """Whether a spot is given as a position, or as PAINT has it."""
    return "(methods)" if isinstance(told, dict | FocalSpots) else "(position)"


FocalSpot = Annotated[
    Annotated[Wgs84, Tag("(position)")] | Annotated[FocalSpots, Tag("(methods)")], Discriminator(_spot_by)
]
