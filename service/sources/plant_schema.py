"""Schema of ``plant.yaml``, the file that describes any solar tower plant.

Unknown keys are refused, a kind that is not understood too: nothing is read as something else.
"""

from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    ModelWrapValidatorHandler,
    StringConstraints,
    Tag,
    ValidationError,
    model_validator,
)

from model.actuator import LinearActuator
from model.plant import require_cylinder_shape
from service.base.fields import Extent, Flag, Metres, Model, Name, Number, Plane, Position, Whole
from service.base.plant import NAMES_WITH_UNITS, PlaneReceiverIn, TowerSize
from service.base.validation import LINE, NAME

MAX_HELIOSTATS = 50_000
"""Most heliostats of a plant."""

MAX_FACETS = 256
"""Most facets of a heliostat."""

UP = (0.0, 0.0, 1.0)


class PlantPart(Model):
    """Base of all parts: suggests the nearest key for one that is unknown."""

    @model_validator(mode="wrap")
    @classmethod
    def _known_keys(cls, data: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """Name unknown and empty keys beside the mistakes of all others."""
        known = [field.alias or name for name, field in cls.model_fields.items()]
        wrong = list(_wrong_keys(data, known)) if isinstance(data, dict) else []
        if not wrong:
            return validate(data)
        keys = {mistake.key for mistake in wrong}
        found: list[Any] = [
            {"type": "value_error", "input": data, "ctx": {"error": mistake}} for mistake in wrong
        ]
        try:
            validate({key: value for key, value in data.items() if key not in keys})
        except ValidationError as error:
            meant = {mistake.meant for mistake in wrong}
            found += [
                {key: entry.get(key, {}) for key in ("type", "loc", "input", "ctx")}
                for entry in error.errors(include_url=False)
                if entry["type"] != "missing" or entry["loc"][0] not in meant
            ]
        raise ValidationError.from_exception_data(cls.__name__, found)

    def require_one(self, *keys: str) -> None:
        """Refuse the part unless exactly one of ``keys`` is given."""
        given = [key for key in keys if getattr(self, key) is not None]
        if len(given) != 1:
            problem = "are given" if given else "are all missing"
            listed = " and ".join(given) if given else ", ".join(keys)
            raise ValueError(f"{listed} {problem}; give one of {', '.join(keys)}")


class KeyMistakeError(ValueError):
    """A mistake of one ``key`` of a part, and the key that is ``meant``."""

    def __init__(self, key: str, message: str, meant: str = "") -> None:
        super().__init__(f"{key}: {message}")
        self.key, self.message, self.meant = key, message, meant


def _wrong_keys(data: Mapping[str, Any], known: Sequence[str]) -> Iterator[KeyMistakeError]:
    for key, value in data.items():
        if key not in known:
            meant = next((name for name in known if f" {name}?" in nearest(key, known)), "")
            yield KeyMistakeError(key, f"is not known here; {nearest(key, known)}", meant)
        elif value is None:
            yield KeyMistakeError(key, "has no value; write one, or leave the key out", key)


def nearest(word: str, known: Sequence[str]) -> str:
    """What to write in place of a word that is not one of ``known``."""
    close = get_close_matches(word[:80], known, 1, 0.6)
    return f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"


def _as_name(value: Any) -> Any:
    """The text of a whole number: heliostats are often numbered."""
    if isinstance(value, float):
        raise ValueError("must be text; put it in quotes")
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _form(value: Any) -> str:
    return "(object)" if isinstance(value, dict | BaseModel) else "(word)"


def _facet_source(value: Any) -> str:
    is_file = "file" in value if isinstance(value, dict) else isinstance(value, FacetFileEntry)
    return "(file)" if is_file else "(grid)"


NumberedName = Annotated[Name, BeforeValidator(_as_name, json_schema_input_type=Name | int)]
FileName = Annotated[
    str,
    StringConstraints(pattern=LINE, min_length=1, max_length=200),
    Field(description="Path relative to the folder of plant.yaml, inside of it."),
]
Length = Annotated[Number, Field(gt=0, le=1e5)]
Share = Annotated[Number, Field(ge=0, le=1)]
Reflectance = Annotated[Number, Field(gt=0, le=1)]
ErrorMrad = Annotated[Number, Field(ge=0, lt=100)]
FacetCount = Annotated[Whole, Field(ge=1, le=MAX_FACETS)]
Steps = Annotated[Number, Field(gt=0, le=1e12)]
Arm = Annotated[Number, Field(gt=0, le=100)]
Angle = Annotated[Number, Field(ge=-10, le=10)]
Azimuth360 = Annotated[Number, Field(ge=-360, le=360, description="From north over east [deg].")]


class PlantHeader(PlantPart):
    """Name and location of the plant; the tower base is the origin of all positions."""

    name: NumberedName
    latitude_deg: Annotated[Number, Field(ge=-90, le=90)]
    longitude_deg: Annotated[Number, Field(ge=-180, le=180)]
    altitude_m: Annotated[Number, Field(ge=-1000, le=9000)] = 0.0
    time_zone: Annotated[str, StringConstraints(pattern=LINE, max_length=64)] = Field(
        "UTC", description="Name in the IANA time zone database, such as America/Los_Angeles."
    )


# --- heliostat types
# --------------------------------------------------------------------------------------------------


class Spindle(BaseModel):
    """`model.actuator.LinearActuator`."""

    model_config = ConfigDict(allow_inf_nan=False, extra="forbid")

    kind: Literal["linear"] = Field("linear", description="A spindle.")
    increment: Steps = Field(description="Steps for one metre of stroke [1/m].")
    initial_stroke_length: Annotated[Number, Field(ge=0, le=100)] = Field(
        description="At zero steps [m]."
    )
    offset: Arm = Field(description="From the axis to the spindle's fixed end [m].")
    pivot_radius: Arm = Field(description="From the axis to the spindle's moving end [m].")
    initial_angle: Angle = Field(description="Axis angle at zero steps [rad].")
    clockwise: Flag = Field(description="Whether the angle decreases as the stroke increases.")
    max_increment: Steps = Field(description="The end of travel [steps].")

    def actuator(self) -> LinearActuator:
        """As the model has it."""
        return LinearActuator(**self.model_dump(exclude={"kind"}, by_alias=False))


_SPINDLE_KEYS = {
    "increment": "increment_steps_per_m",
    "initial_angle": "initial_angle_rad",
    "max_increment": "max_increment_steps",
    **{name: f"{name}_m" for name in ("initial_stroke_length", "offset", "pivot_radius")},
}


class LinearDrive(PlantPart, Spindle):
    """A spindle that turns an axis, as of `model.actuator.LinearActuator`."""

    model_config = ConfigDict(
        alias_generator=lambda name: _SPINDLE_KEYS.get(name, name), serialize_by_alias=True
    )

    kind: Literal["linear"] = Field(description="A spindle.")


class RotaryDrive(PlantPart):
    """A drive whose motor position is proportional to the axis angle."""

    kind: Literal["rotary"] = Field(description="A drive proportional to the angle.")
    steps_per_rad: Steps | None = Field(None, description="Steps for one radian [1/rad].")
    gear: Annotated[Number, Field(gt=0, le=1e9)] | None = Field(
        None, description="In place of them: motor turns for one turn of the axis [1]."
    )
    initial_angle_rad: Angle = Field(0.0, description="Axis angle at zero steps [rad].")
    clockwise: Flag = Field(
        False, description="Whether the angle decreases as the position increases."
    )

    @model_validator(mode="after")
    def _one_ratio(self) -> Self:
        self.require_one("steps_per_rad", "gear")
        return self


class IdealDrive(PlantPart):
    """A drive that reaches every angle; its motor position is the axis angle in radians."""

    kind: Literal["ideal"] = Field(description="A drive without limits.")


Drive = Annotated[LinearDrive | RotaryDrive | IdealDrive, Field(discriminator="kind")]


class MountEntry(PlantPart):
    """The mount: its two axes, and where they are."""

    kind: Literal["azimuth_elevation", "juelich", "pitch_roll", "target_aligned"] = Field(
        description="How its two axes are arranged."
    )
    pivot_height_m: Annotated[Number, Field(ge=-100, le=100)] = Field(
        0.0, description="Of both axes above the foot of the pylon [m]."
    )
    mirror_offset_m: Annotated[Number, Field(ge=-10, le=10)] = Field(
        0.0, description="From the pivot to the mirror's middle along its normal [m]."
    )
    drives: Annotated[list[Drive], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Drives of the first and the second axis; ideal ones without it."
    )
    jitter_axis: Literal["first", "second"] = Field(
        "first", description="The less stiff axis, about which the mirror oscillates in wind."
    )


class FacetGridEntry(PlantPart):
    """Equal facets in rows and columns."""

    rows: FacetCount = Field(description="Facets above each other.")
    columns: FacetCount = Field(description="Facets side by side.")
    width_m: Extent = Field(description="Of one facet [m].")
    height_m: Extent = Field(description="Of one facet [m].")
    gap_m: Annotated[Number, Field(ge=0, le=10)] = Field(0.0, description="Between two facets [m].")

    @model_validator(mode="after")
    def _few(self) -> Self:
        if self.rows * self.columns > MAX_FACETS:
            raise ValueError(
                f"has {self.rows * self.columns} facets; at most {MAX_FACETS} are read"
            )
        return self


class FacetFileEntry(PlantPart):
    """Facets by a CSV file, one a line."""

    file: FileName


class FocusEntry(PlantPart):
    """A focal length that all facets of a type have."""

    focal_length_m: Length = Field(description="Of each facet's paraboloid [m].")


class SunDirection(PlantPart):
    """A sun as seen: azimuth from north over east, elevation."""

    azimuth_deg: Azimuth360
    elevation_deg: Annotated[Number, Field(gt=0, le=90, description="Above the horizon [deg].")]


class CantingEntry(PlantPart):
    """Canting to a focal length, or for one position of the sun."""

    focal_length_m: Length | None = Field(None, description="On axis, to this focal length [m].")
    off_axis: SunDirection | None = Field(
        None, description="In place of it: for the sun in this direction."
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        self.require_one("focal_length_m", "off_axis")
        return self


FacetsEntry = Annotated[
    Annotated[FacetGridEntry, Tag("(grid)")] | Annotated[FacetFileEntry, Tag("(file)")],
    Discriminator(_facet_source),
]
CantingChoice = Annotated[
    Annotated[Literal["on_axis", "flat", "individual"], Tag("(word)")]
    | Annotated[CantingEntry, Tag("(object)")],
    Discriminator(_form),
]


class HeliostatTypeEntry(PlantPart):
    """What the heliostats of one type have in common."""

    mount: MountEntry = Field(description="Its axes and drives.")
    facets: FacetsEntry = Field(description="A grid of equal ones, or a CSV file with one a line.")
    facet_shape: Annotated[
        Annotated[Literal["flat", "slant_range"], Tag("(word)")]
        | Annotated[FocusEntry, Tag("(object)")],
        Discriminator(_form),
    ] = Field("flat", description="Each facet is a paraboloid of this focal length, or flat.")
    canting: CantingChoice | None = Field(
        None, description="on_axis without it, or individual if the facets' file has their normals."
    )
    reflectance: Reflectance = Field(1.0, description="Of the mirrors [1].")
    slope_error_mrad: ErrorMrad = Field(
        0.0, description="Of the normals, standard deviation per axis [mrad]."
    )
    pointing_error_mrad: ErrorMrad = Field(
        0.0, description="Of the reflected beam, standard deviation per axis [mrad]."
    )
    reference_elevation_deg: Annotated[Number, Field(ge=0, le=90)] = Field(
        30.0,
        description="Elevation of the mirror's normal at which its facets were canted [deg]. At"
        " others the mirror sags by the effect gravity_bending.",
    )


# --- layout
# --------------------------------------------------------------------------------------------------


class HeliostatPlace(PlantPart):
    """The foot of a heliostat's pylon, and what it is made for."""

    east_m: Metres = Field(description="Of the pylon's foot from the tower base [m].")
    north_m: Metres = Field(description="Of the pylon's foot from the tower base [m].")
    up_m: Metres = Field(description="Of the pylon's foot above the tower base [m].")
    receiver: NumberedName | None = Field(
        None, description="The receiver or target that it is canted to; without it the first."
    )
    focal_length_m: Length | None = Field(None, description="In place of its slant range [m].")


class HeliostatEntry(HeliostatPlace):
    """A heliostat: its type, and the foot of its pylon."""

    name: NumberedName
    type: NumberedName


TypeChoice = Annotated[
    Annotated[NumberedName, Tag("(word)")] | Annotated[HeliostatTypeEntry, Tag("(object)")],
    Discriminator(_form),
]


class LayoutEntry(PlantPart):
    """The heliostats, by a CSV file or as a list."""

    file: FileName | None = None
    heliostats: (
        Annotated[list[HeliostatEntry], Field(min_length=1, max_length=MAX_HELIOSTATS)] | None
    ) = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        self.require_one("file", "heliostats")
        return self


# --- receivers and targets
# --------------------------------------------------------------------------------------------------


class SurfacePart(PlantPart):
    """Base of receivers and targets: fields as of `service.base.plant`, keys with units."""

    model_config = ConfigDict(alias_generator=lambda name: NAMES_WITH_UNITS.get(name, name))


class PanelEntry(SurfacePart, Plane):
    """A rectangle; its normal is on the lit side."""


class PlaneReceiver(SurfacePart, PlaneReceiverIn):
    """A flat receiver."""


class CylinderReceiver(SurfacePart):
    """An upright cylinder or a part of one, lit from outside."""

    kind: Literal["cylinder"]
    center: Position = Field(description="On the axis, at mid height.")
    radius: Annotated[Number, Field(ge=0.01, lt=1e3)]
    height: Extent
    facing_azimuth_deg: Azimuth360 = Field(
        0.0, description="Where the middle column of its map faces, from north over east."
    )
    opening_deg: Annotated[Number, Field(gt=0, le=360)] = Field(
        360.0, description="Angle of the lit surface, half of it to each side of the middle."
    )
    absorptance: Reflectance = 1.0

    @model_validator(mode="after")
    def _near_square(self) -> Self:
        require_cylinder_shape(self.radius, self.height, self.opening_deg)
        return self


Panelled = Annotated[list[PanelEntry], Field(min_length=1, max_length=64)]


class PanelsReceiver(SurfacePart):
    """Planes of one height side by side, lit from outside, from left to right."""

    kind: Literal["panels"]
    panels: Panelled
    absorptance: Reflectance = 1.0


class CavityReceiver(SurfacePart):
    """Panels behind an opening."""

    kind: Literal["cavity"]
    aperture: Annotated[list[Position], Field(min_length=3, max_length=64)] = Field(
        description="Corners of the opening, in one plane, counter-clockwise seen from outside."
    )
    panels: Panelled
    absorptance: Reflectance = 1.0


ReceiverEntry = Annotated[
    PlaneReceiver | CylinderReceiver | PanelsReceiver | CavityReceiver, Field(discriminator="kind")
]


Coordinate = Annotated[Number, Field(ge=-1e9, le=1e9)]
PixelPair = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
Pixels = Annotated[Whole, Field(ge=16, le=100_000)]
MatrixRow = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Matrix3 = Annotated[list[MatrixRow], Field(min_length=3, max_length=3)]


class PoseEntry(PlantPart):
    """Where a camera is, where it looks, and its lens."""

    position_m: Position = Field(description="Its place: east, north, up of the tower base [m].")
    look_at_m: Position | None = Field(
        None, description="The point [m] that its optical axis leads to; the camera is upright."
    )
    rotation: Matrix3 | None = Field(
        None,
        description="In place of look_at_m: its image's right, its image's down and its direction,"
        " each as a row of east, north, up [1].",
    )
    focal_length_px: Annotated[Number, Field(ge=1, le=1e7)] | None = Field(
        None, description="Focal length divided by the size of a pixel [px]."
    )
    field_of_view_deg: Annotated[Number, Field(gt=0, lt=179)] | None = Field(
        None, description="In place of the focal length: from the left to the right edge [deg]."
    )
    principal_point_px: PixelPair | None = Field(
        None, description="Column and row [px] of the optical axis; the image's middle without it."
    )
    distortion: Annotated[list[Coordinate], Field(min_length=1, max_length=5)] | None = Field(
        None, description="k1, k2, p1, p2, k3 [1] of Brown's lens, as of OpenCV; none without it."
    )

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        self.require_one("look_at_m", "rotation")
        self.require_one("focal_length_px", "field_of_view_deg")
        return self


class CameraEntry(PlantPart):
    """The camera that looks at a target.

    Pixels are (column, row); (0, 0) is the middle of the upper left one.
    """

    homography: Matrix3 | None = Field(
        None,
        description="3 x 3: from its pixels (column, row, 1) to places right and up of the"
        " target's centre [m].",
    )
    corners_px: Annotated[list[PixelPair], Field(min_length=4, max_length=4)] | None = Field(
        None,
        description="The target's upper left, upper right, lower left and lower right corner [px].",
    )
    pose: PoseEntry | None = Field(None, description="Its place, direction and lens.")
    image_size_px: Annotated[list[Pixels], Field(min_length=2, max_length=2)] | None = Field(
        None,
        description="Columns and rows [px] of its photographs; others are refused if it is given.",
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        self.require_one("homography", "corners_px", "pose")
        return self


Marks = Literal["none", "l_brackets"]


class LocatorDocument(PlantPart):
    """How a target is located in photographs, in exports."""

    marks: Marks
    camera: CameraEntry | None = Field(
        None, description="A camera that does not move; for targets without marks."
    )

    @property
    def locator_document(self) -> dict[str, object]:
        """What it declares of a target's place in photographs, as of `model.locating`."""
        return self.model_dump(include={"marks", "camera"}, exclude_none=True)


class TargetEntry(PanelEntry, LocatorDocument):
    """A calibration target."""

    kind: Literal["plane"]
    marks: Marks = Field(
        "none",
        description="Marks at its corners that locate it in photographs. Without marks and camera"
        " its edges do, of a white rectangle against darker surroundings.",
    )


class TowerEntry(PlantPart, TowerSize):
    """The tower, an upright cylinder that casts a shadow."""


# --- sun and air
# --------------------------------------------------------------------------------------------------


class PillboxSun(PlantPart):
    """A disc of even radiance."""

    shape: Literal["pillbox"]
    half_angle_mrad: Annotated[Number, Field(ge=0.001, le=100)] = 4.65


class GaussianSun(PlantPart):
    """A Gaussian."""

    shape: Literal["gaussian"]
    sigma_mrad: Annotated[Number, Field(ge=0.001, le=100)] = Field(
        description="Standard deviation per axis."
    )


class BuieSun(PlantPart):
    """Buie's disc with aureole."""

    shape: Literal["buie"]
    chi: Annotated[Number, Field(ge=0, le=0.5)] | None = Field(
        None, description="Of Buie's formula."
    )
    csr: Share | None = Field(None, description="True share of the light from the aureole.")

    @model_validator(mode="after")
    def _one_ratio(self) -> Self:
        self.require_one("chi", "csr")
        return self


SunEntry = Annotated[PillboxSun | GaussianSun | BuieSun, Field(discriminator="shape")]


class AtmosphereEntry(PlantPart):
    """The light that is lost between mirror and receiver."""

    attenuation: (
        Annotated[
            list[Annotated[Number, Field(ge=-1e6, le=1e6)]], Field(min_length=1, max_length=8)
        ]
        | None
    ) = Field(None, description="Lost share, a polynomial in the slant range [km], constant first.")
    visibility_km: Annotated[Number, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        self.require_one("attenuation", "visibility_km")
        return self


NamedParts = Annotated[str, StringConstraints(pattern=NAME)]


class PlantDocument(PlantPart):
    """A plant in one file. SI units; a key's name has its unit if it is not SI or not evident.

    Positions are east, north and up [m] of the tower base, azimuths from north over east.
    """

    plant: PlantHeader
    heliostat_types: Annotated[
        dict[NamedParts, HeliostatTypeEntry], Field(min_length=1, max_length=64)
    ]
    layout: LayoutEntry
    receivers: Annotated[dict[NamedParts, ReceiverEntry], Field(max_length=64)] = Field({})
    targets: Annotated[dict[NamedParts, TargetEntry], Field(max_length=64)] = Field({})
    tower: TowerEntry | None = None
    sun: SunEntry = BuieSun(shape="buie", chi=0.02)
    atmosphere: AtmosphereEntry | None = None


def json_schema() -> dict[str, object]:
    """The JSON schema of ``plant.yaml``."""
    schema = PlantDocument.model_json_schema()
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **_without_null(schema), "title": "plant.yaml"}


def _without_null(schema: Any) -> Any:
    """A schema in which a key is left out instead of being null."""
    if isinstance(schema, list):
        return [_without_null(entry) for entry in schema if entry != {"type": "null"}]
    if not isinstance(schema, dict):
        return schema
    kept = {key: _without_null(entry) for key, entry in schema.items() if key != "title"}
    if kept.get("default", "") is None:
        del kept["default"]
    if len(kept.get("anyOf", ())) == 1:
        kept = {**kept.pop("anyOf")[0], **kept}
    return kept


def assumed(part: BaseModel, path: str = "") -> Iterator[str]:
    """Yield what a document leaves to its defaults, as lines ``key.path: value``."""
    for name, field in type(part).model_fields.items():
        value, where = getattr(part, name), f"{path}{field.alias or name}"
        if name not in part.model_fields_set:
            if value is None:
                yield from [f"{where}: {_ABSENT[name]}"] if name in _ABSENT else []
            elif value != {}:
                yield f"{where}: {_brief(value)}"
        else:
            yield from _assumed_below(value, where)


_ABSENT = {
    "tower": "none, and no shadow of one",
    "atmosphere": "clear, no light is lost",
    "canting": "on_axis, or individual if the facets' file has normals",
}
"""What is assumed if a part is absent that has no default."""


def _assumed_below(value: Any, where: str) -> Iterator[str]:
    if isinstance(value, BaseModel):
        yield from assumed(value, f"{where}.")
    elif isinstance(value, Mapping):
        for key, entry in value.items():
            yield from _assumed_below(entry, f"{where}.{key}")


def _brief(value: object) -> str:
    if isinstance(value, BaseModel):
        given = ", ".join(
            f"{key}: {entry}" for key, entry in value.model_dump(exclude_none=True).items()
        )
        return f"{{{given}}}"
    return f"{value:g}" if isinstance(value, float) else str(value)
