"""A heliostat of any type as one JSON document, and in the terms of ``plant.yaml``.

The store and exports keep the document. PAINT's documents describe heliostats of the Solar Tower
Juelich. This one has the axes of any mount and facets of any number, outline and focal length, in
metres of east, north and up. In ``plant.yaml`` a heliostat has a type, and the foot of its pylon.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from model.actuator import Actuator, LinearActuator, RotaryActuator
from model.errors import InvalidInputError
from model.mount import Mount
from model.plant import REFERENCE_SINE, Facet, Heliostat, MirrorOptics
from service.base.fields import Flag, JsonObject, Name, Number, Position
from service.base.plant import AnyReceiver
from service.sources.plant_file import place_heliostat
from service.sources.plant_parts import type_of_entry
from service.sources.plant_schema import (
    MAX_FACETS,
    Angle,
    CantingChoice,
    ErrorMrad,
    FacetsEntry,
    HeliostatEntry,
    HeliostatPlace,
    HeliostatTypeEntry,
    Length,
    Reflectance,
    Spindle,
    Steps,
    TypeChoice,
    nearest,
)
from service.sources.plant_tables import MAX_CORNERS, PlacedHeliostat
from service.sources.schema import parse

FORMAT = "heliotwin heliostat 1"

Short = Annotated[Number, Field(ge=-1e3, le=1e3)]
Point = tuple[Short, Short, Short]
Matrix = tuple[Point, Point, Point]
Corner = Annotated[Number, Field(ge=-1.01, le=1.01)]

# Largest deviation from unit length and right angles.
_ROUNDING = 1e-6


class _Part(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False, extra="forbid")


class RotaryDriveDocument(_Part):
    """`model.actuator.RotaryActuator`."""

    kind: Literal["rotary"] = Field("rotary", description="A drive proportional to the angle.")
    increment: Steps = Field(description="Steps for one radian [1/rad].")
    initial_angle: Angle = Field(description="Axis angle at zero steps [rad].")
    clockwise: Flag = Field(description="Whether the angle decreases as the position increases.")

    def actuator(self) -> RotaryActuator:
        """As the model has it."""
        return RotaryActuator(**self.model_dump(exclude={"kind"}))


DriveDocument = Annotated[Spindle | RotaryDriveDocument, Field(discriminator="kind")]


class MountDocument(_Part):
    """`model.mount.Mount`."""

    first_axis: Point = Field(description="Unit vector at zero angles: east, north, up [1].")
    second_axis: Point = Field(description="Unit vector at zero angles: east, north, up [1].")
    zero_attitude: Matrix = Field(
        description="Rotation of mirror coordinates to east, north, up at zero angles [1]."
    )
    joint_m: Point = Field(description="The pivot of both axes from the pylon's foot [m].")
    mirror_offset_m: Point = Field(
        description="From the pivot to the mirror's middle, in mirror coordinates [m]."
    )
    axis_zero_rad: tuple[Angle, Angle] = Field(
        (0.0, 0.0), description="Axis angles at which the drives' angles are zero [rad]."
    )
    drives: tuple[DriveDocument, DriveDocument] | None = Field(
        None, description="Of the first and the second axis; null: not known."
    )
    jitter_axis: Literal["first", "second"] | None = Field(
        None, description="The less stiff axis; null: the first."
    )

    @model_validator(mode="after")
    def _rotations(self) -> Self:
        for name in ("first_axis", "second_axis"):
            if abs(np.linalg.norm(getattr(self, name)) - 1) > _ROUNDING:
                raise ValueError(f"{name}: must be a vector of length 1; divide by its length")
        attitude = np.array(self.zero_attitude)
        is_near = np.abs(attitude @ attitude.T - np.eye(3)).max() < _ROUNDING
        if not is_near or np.linalg.det(attitude) < 0:
            raise ValueError("zero_attitude: must be a rotation; give orthogonal unit vectors")
        return self


class MirrorFacet(_Part):
    """`model.plant.Facet`."""

    center_m: Point = Field(description="Its middle in mirror coordinates [m].")
    half_width_m: Point = Field(description="From its middle to the right edge's [m].")
    half_height_m: Point = Field(description="From its middle to the upper edge's [m].")
    focal_length_m: Annotated[Number, Field(gt=0, le=1e7)] | None = Field(
        None, description="Of its paraboloid [m]; null: flat."
    )
    outline: tuple[tuple[Corner, Corner], ...] | None = Field(
        None,
        min_length=3,
        max_length=MAX_CORNERS,
        description="Corners in half widths and heights [1]; null: a rectangle.",
    )

    @model_validator(mode="after")
    def _area(self) -> Self:
        x, y = np.array(self.half_width_m), np.array(self.half_height_m)
        if np.linalg.norm(np.cross(x, y)) < 1e-6:
            raise ValueError("half_width_m, half_height_m: span no area; they must not be parallel")
        return self


class OpticsDocument(_Part):
    """`model.plant.MirrorOptics`."""

    reflectance: Reflectance = Field(1.0, description="Of the mirrors [1].")
    slope_error_mrad: ErrorMrad = Field(
        0.0, description="Of the normals, standard deviation per axis [mrad]."
    )
    pointing_error_mrad: ErrorMrad = Field(
        0.0, description="Of the reflected beam, standard deviation per axis [mrad]."
    )


class HeliostatDocument(_Part):
    """A heliostat of any type.

    ``type``, ``receiver`` and ``focal_length_m`` are those of the layout of its ``plant.yaml``.
    """

    format: Literal["heliotwin heliostat 1"] = Field(description="Name and version of this format.")
    type: Annotated[str, StringConstraints(pattern=r"^([A-Za-z0-9][A-Za-z0-9_-]{0,31})?$")] = Field(
        "", description="Its heliostat type in plant.yaml; empty: none."
    )
    position_m: Position = Field(description="The pylon's foot: east, north, up [m].")
    width_m: Annotated[Number, Field(gt=0, le=1e3)] = Field(description="Of the whole mirror [m].")
    height_m: Annotated[Number, Field(gt=0, le=1e3)] = Field(description="Of the whole mirror [m].")
    mount: MountDocument = Field(description="Its axes and drives.")
    facets: list[MirrorFacet] = Field(
        min_length=1, max_length=MAX_FACETS, description="Its facets in order."
    )
    optics: OpticsDocument = Field(OpticsDocument(), description="Reflectance and errors.")
    receiver: Name | None = Field(None, description="What it was canted and focused to.")
    focal_length_m: Length | None = Field(None, description="In place of its slant range [m].")
    reference_sine: Annotated[Number, Field(ge=0, le=1)] | None = Field(
        None, description="Sine of the normal's elevation at which it was canted [1]."
    )

    @property
    def raw(self) -> JsonObject:
        """The document as received."""
        return self.model_dump(mode="json", exclude_unset=True)


def is_heliostat_document(properties: Any) -> bool:
    """Whether properties are in this format, not in PAINT's."""
    return isinstance(properties, dict) and properties.get("format") == FORMAT


def heliostat_to_json(
    heliostat: Heliostat, placed: HeliostatEntry | None = None
) -> dict[str, object]:
    """The document of a heliostat, and of its place in the layout of a plant."""
    mount = heliostat.mount
    first, second = mount.actuators or (None, None)
    drives = first and second and (_drive_document(first), _drive_document(second))
    document = HeliostatDocument(
        format=FORMAT,
        type="" if placed is None else placed.type,
        receiver=None if placed is None else placed.receiver,
        focal_length_m=None if placed is None else placed.focal_length_m,
        position_m=_point(heliostat.position),
        width_m=heliostat.width,
        height_m=heliostat.height,
        mount=MountDocument(
            first_axis=_point(mount.first_axis),
            second_axis=_point(mount.second_axis),
            zero_attitude=(
                _point(mount.zero_attitude[0]),
                _point(mount.zero_attitude[1]),
                _point(mount.zero_attitude[2]),
            ),
            joint_m=_point(mount.joint),
            mirror_offset_m=_point(mount.mirror_offset),
            axis_zero_rad=mount.axis_zero,
            drives=drives,
            jitter_axis=mount.jitter_axis,
        ),
        facets=list(map(_facet_part, heliostat.facets)),
        optics=OpticsDocument(
            reflectance=heliostat.optics.reflectance,
            slope_error_mrad=heliostat.optics.slope_error * 1e3,
            pointing_error_mrad=heliostat.optics.pointing_error * 1e3,
        ),
        reference_sine=heliostat.reference_sine,
    )
    content = document.model_dump(mode="json")
    # Documents of types with the defaults are as they were before these keys existed.
    if heliostat.reference_sine == REFERENCE_SINE:
        del content["reference_sine"]
    if mount.jitter_axis == "first":
        del content["mount"]["jitter_axis"]
    return content


def _point(vector: Any) -> Point:
    x, y, z = np.asarray(vector, dtype=np.float64).tolist()
    return x, y, z


def _facet_part(facet: Facet) -> MirrorFacet:
    return MirrorFacet(
        center_m=_point(facet.position),
        half_width_m=_point(facet.canting_x),
        half_height_m=_point(facet.canting_y),
        focal_length_m=facet.focal_length,
        outline=facet.outline,
    )


def _drive_document(drive: Actuator) -> Spindle | RotaryDriveDocument:
    if isinstance(drive, LinearActuator):
        return Spindle(**vars(drive))
    return RotaryDriveDocument(**vars(drive))


def heliostat_from_json(name: str, properties: Any) -> Heliostat:
    """The heliostat of a document; `InvalidInputError` names a wrong field."""
    document = parse(HeliostatDocument, properties, f"properties of {name}")
    mount, optics = document.mount, document.optics
    drives = mount.drives and (mount.drives[0].actuator(), mount.drives[1].actuator())
    return Heliostat(
        name,
        np.array(document.position_m),
        Mount(
            np.array(mount.first_axis),
            np.array(mount.second_axis),
            np.array(mount.zero_attitude),
            np.array(mount.joint_m),
            np.array(mount.mirror_offset_m),
            drives,
            axis_zero=mount.axis_zero_rad,
            jitter_axis=mount.jitter_axis or "first",
        ),
        tuple(
            Facet(
                np.array(facet.center_m),
                np.array(facet.half_width_m),
                np.array(facet.half_height_m),
                facet.focal_length_m,
                facet.outline,
            )
            for facet in document.facets
        ),
        document.width_m,
        document.height_m,
        MirrorOptics(
            optics.reflectance, optics.slope_error_mrad / 1e3, optics.pointing_error_mrad / 1e3
        ),
        REFERENCE_SINE if document.reference_sine is None else document.reference_sine,
    )


class HeliostatOfType(HeliostatPlace):
    """A heliostat of any type, as of ``plant.yaml``."""

    type: TypeChoice = Field(
        description="Name of a heliostat type of the imported plant.yaml, or a type written out."
    )
    facets: FacetsEntry | None = Field(None, description="In place of the type's facets.")
    canting: CantingChoice | None = Field(None, description="In place of the type's canting.")


def document_of(
    name: str, given: HeliostatOfType, stored: JsonObject | None, goals: Mapping[str, AnyReceiver]
) -> JsonObject:
    """The document of a heliostat, as an import of the same ``plant.yaml`` makes it.

    ``stored`` are the plant's heliostat types (`service.base.plant.PlantFacts`). ``goals``
    are its receivers, then its targets.

    Raises
    ------
    InvalidInputError
        It names the field: a type or receiver that is not known, or what the model refuses.
    """
    known = stored or {"types": {}, "files": {}}
    own = {key: getattr(given, key) for key in ("facets", "canting") if getattr(given, key)}
    entry = _entry(given.type, known["types"]).model_copy(update=own)
    label = given.type if isinstance(given.type, str) and not own else ""
    place = {key: getattr(given, key) for key in HeliostatPlace.model_fields}
    # A mirror that differs from its type is of none.
    named = {"name": name, "type": label, "receiver": _goal(given.receiver, goals)}
    placed = HeliostatEntry.model_construct(**place | named)
    heliostat = place_heliostat(
        PlacedHeliostat("east_m, north_m, up_m", placed),
        type_of_entry(label or name, entry, known["files"]),
        goals[str(placed.receiver)],
    )
    return heliostat_to_json(heliostat, placed)


def _entry(chosen: str | HeliostatTypeEntry, types: JsonObject) -> HeliostatTypeEntry:
    if isinstance(chosen, HeliostatTypeEntry):
        return chosen
    if chosen not in types:
        remedy = nearest(chosen, list(types)) if types else "it has none; write the type out"
        raise InvalidInputError(f"type: {chosen!r} is no heliostat type of the plant; {remedy}")
    return HeliostatTypeEntry.model_validate(types[chosen])


def _goal(chosen: str | None, goals: Mapping[str, AnyReceiver]) -> str:
    if not goals:
        raise InvalidInputError(
            "receiver: the plant has neither receivers nor targets; PUT one to /v1/receivers/NAME"
        )
    name = chosen or next(iter(goals))
    if name not in goals:
        raise InvalidInputError(
            f"receiver: {name!r} is no receiver or target; {nearest(name, list(goals))}"
        )
    return name
