"""A heliostat of any type as one JSON document, as the store and exports keep it.

PAINT's documents describe heliostats of the Solar Tower Juelich. This one has the axes of any mount
and facets of any number, outline and focal length, in metres of east, north and up.
"""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from model.actuator import Actuator, LinearActuator, RotaryActuator
from model.mount import Mount
from model.plant import REFERENCE_SINE, Facet, Heliostat, MirrorOptics
from service.base.fields import Number
from service.sources.plant_schema import HeliostatEntry
from service.sources.schema import parse

FORMAT = "heliotwin heliostat 1"

Point = tuple[Number, Number, Number]
Matrix = tuple[Point, Point, Point]


class _Part(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False, extra="forbid")


class LinearDriveDocument(_Part):
    """`model.actuator.LinearActuator`."""

    kind: Literal["linear"] = "linear"
    increment: Number
    initial_stroke_length: Number
    offset: Number
    pivot_radius: Number
    initial_angle: Number
    clockwise: bool
    max_increment: Number


class RotaryDriveDocument(_Part):
    """`model.actuator.RotaryActuator`."""

    kind: Literal["rotary"] = "rotary"
    increment: Number
    initial_angle: Number
    clockwise: bool


DriveDocument = Annotated[LinearDriveDocument | RotaryDriveDocument, Field(discriminator="kind")]


class MountDocument(_Part):
    """`model.mount.Mount`."""

    first_axis: Point
    second_axis: Point
    zero_attitude: Matrix
    joint_m: Point
    mirror_offset_m: Point
    axis_zero_rad: tuple[Number, Number] = (0.0, 0.0)
    drives: tuple[DriveDocument, DriveDocument] | None = None
    jitter_axis: Literal["first", "second"] | None = None


class MirrorFacet(_Part):
    """`model.plant.Facet`."""

    center_m: Point
    half_width_m: Point
    half_height_m: Point
    focal_length_m: Number | None = None
    outline: tuple[tuple[Number, Number], ...] | None = None


class OpticsDocument(_Part):
    """`model.plant.MirrorOptics`."""

    reflectance: Number = 1.0
    slope_error_mrad: Number = 0.0
    pointing_error_mrad: Number = 0.0


class HeliostatDocument(_Part):
    """A heliostat of any type.

    ``type``, ``receiver`` and ``focal_length_m`` are those of the layout of its ``plant.yaml``.
    """

    format: Literal["heliotwin heliostat 1"]
    type: str = ""
    position_m: Point
    width_m: Number = Field(gt=0)
    height_m: Number = Field(gt=0)
    mount: MountDocument
    facets: tuple[MirrorFacet, ...] = Field(min_length=1, max_length=256)
    optics: OpticsDocument = OpticsDocument()
    receiver: str | None = None
    focal_length_m: Number | None = None
    reference_sine: Annotated[Number, Field(ge=0, le=1)] | None = None


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
        facets=tuple(map(_facet_part, heliostat.facets)),
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


def _drive_document(drive: Actuator) -> LinearDriveDocument | RotaryDriveDocument:
    if isinstance(drive, LinearActuator):
        return LinearDriveDocument(**vars(drive))
    return RotaryDriveDocument(**vars(drive))


def _actuator(drive: LinearDriveDocument | RotaryDriveDocument) -> Actuator:
    made = LinearActuator if isinstance(drive, LinearDriveDocument) else RotaryActuator
    return made(**drive.model_dump(exclude={"kind"}))


def heliostat_from_json(name: str, properties: Any) -> Heliostat:
    """The heliostat of a document; `InvalidInputError` names a wrong field."""
    document = parse(HeliostatDocument, properties, f"properties of {name}")
    mount, optics = document.mount, document.optics
    drives = mount.drives and (_actuator(mount.drives[0]), _actuator(mount.drives[1]))
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
