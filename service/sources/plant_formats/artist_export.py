"""Write a plant as a scenario of ARTIST (HDF5).

Source: ARTIST 2.0, ``docs/scenario.rst``, ``artist.io.h5_scenario_parser`` and
``artist.raytracing.geometry``.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from model.actuator import LinearActuator
from model.errors import InvalidInputError
from model.plant import Cylinder, Heliostat, TargetPlane
from model.sunshape import Gaussian, SunShape
from model.surface import COLUMNS, DEGREE, ROWS, control_points
from service.sources.files import file_name
from service.sources.folder import MeasuredSurface, read_surface
from service.sources.plant_file import PlantDescription
from service.sources.plant_formats.artist_heliostats import deviations_of, rigid_body

Array = NDArray[np.float64]

VERSION = 1.0
_RAYS = 10
_MOUNTS = ("pitch_roll", "juelich", "azimuth_elevation")
_LEVEL = 1e-6
# Limits [rad] of ideal drives within which ARTIST finds all angles.
_ANY_ANGLE = (-np.pi, np.pi)

_Members = Mapping[str, object]


def write_artist(described: PlantDescription, out: Path, surfaces: Path | None) -> list[str]:
    """Write the scenario; return notes of what ARTIST cannot say.

    ``surfaces`` is a folder of measured surfaces, ``H/Deflectometry``; heliostats without one have
    their nominal mirror.

    Raises
    ------
    InvalidInputError
        It names the heliostat, receiver or sun that ARTIST cannot have; or the file cannot be
        written.
    """
    writer = _ScenarioWriter(described, surfaces)
    members = writer.scenario()
    try:
        with h5py.File(out, "w") as file:
            file.attrs["version"] = VERSION
            _write(file, members)
    except OSError as error:
        raise InvalidInputError(f"{file_name(out)}: cannot be written ({error})") from None
    types = {described.type_of[name] for name in described.type_of if writer.has_steps(name)}
    return [f"not written: {text}" for text in _left_out(described, types)]


def _write(group: h5py.Group, members: _Members) -> None:
    for name, value in members.items():
        if isinstance(value, Mapping):
            _write(group.create_group(name), value)
        else:
            group[name] = value


class _ScenarioWriter:
    """Groups and datasets of a scenario."""

    def __init__(self, described: PlantDescription, surfaces: Path | None) -> None:
        self.described = described
        self.heliostats = described.plant.heliostats
        self.surfaces = self._surfaces(surfaces)

    def scenario(self) -> _Members:
        """The whole file."""
        self._require_equal_mirrors()
        heliostats = {name: self._heliostat(one) for name, one in self.heliostats.items()}
        prototype = next(iter(heliostats.values()))
        parts = ("surface", "kinematics", "actuator")
        drives = {self.has_steps(name) for name in self.heliostats}
        return {
            "power_plant": {"position": np.array(self.described.plant.site.origin)},
            **_target_areas(self.described),
            "lightsources": {"sun_1": _sun(self.described.optics.sun_shape)},
            "prototypes": {part: prototype[part] for part in parts},
            "number_of_heliostat_groups": len(drives),
            "heliostats": {
                name: {"id": number, **one}
                for number, (name, one) in enumerate(heliostats.items(), start=1)
            },
        }

    # --- heliostats

    def _surfaces(self, folder: Path | None) -> dict[str, MeasuredSurface]:
        """Measured surfaces, and nominal ones on a grid of the same size."""
        found = {}
        if folder is not None:
            for name, one in self.heliostats.items():
                surface = read_surface(folder, one)
                if surface is not None:
                    found[name] = surface
        kinds = {(one.points.shape[1:3], one.degree) for one in found.values()}
        if len(kinds) > 1:
            raise InvalidInputError(
                "surfaces: have different numbers of control points, or degrees; ARTIST needs the"
                " same of all heliostats"
            )
        shape, degree = kinds.pop() if kinds else ((ROWS, COLUMNS), DEGREE)
        if len(found) < len(self.heliostats) and degree != DEGREE:
            raise InvalidInputError(
                f"surfaces: are of degree {degree}, nominal mirrors of {DEGREE}; give all"
                " heliostats a surface"
            )
        for name, one in self.heliostats.items():
            if name not in found:
                zeros = np.zeros((len(one.facets), *shape))
                found[name] = MeasuredSurface(control_points(one, zeros), DEGREE)
        return found

    def _require_equal_mirrors(self) -> None:
        """ARTIST stacks the mirrors of a group: their facets must have one number."""
        counts = {len(one.facets): name for name, one in self.heliostats.items()}
        if len(counts) > 1:
            listed = ", ".join(f"{name} {count}" for count, name in sorted(counts.items()))
            raise InvalidInputError(
                f"heliostats have different numbers of facets ({listed}); ARTIST needs the same of"
                " all: export them apart"
            )

    def _heliostat(self, heliostat: Heliostat) -> dict[str, object]:
        design = self.described.types[self.described.type_of[heliostat.name]].mount
        if design.kind not in _MOUNTS:
            raise InvalidInputError(
                f"heliostat {heliostat.name}: ARTIST has no mount of kind {design.kind}; it has"
                f" {', '.join(_MOUNTS)}"
            )
        deviations = deviations_of(design.kind, design.pivot_height, design.mirror_offset)
        drives = self._drives(heliostat.name)
        return {
            "position": np.append(heliostat.position, 1.0),
            "surface": {"facets": dict(self._facets(heliostat, rigid_body(deviations).mirror))},
            "kinematics": {
                "type": "rigid_body",
                "initial_orientation": np.array([0.0, 0.0, 1.0, 0.0]),
                "deviations": deviations,
            },
            "actuator": {f"actuator_{number}": one for number, one in enumerate(drives, start=1)},
        }

    def _facets(self, heliostat: Heliostat, turn: Array) -> Iterator[tuple[str, _Members]]:
        centers, axes, half_sizes = heliostat.facet_frames
        surface = self.surfaces[heliostat.name]
        points = surface.points @ turn.T
        # ARTIST moves and cants a mirror of which all heights are zero, and no other.
        is_moved = not np.abs(points[..., 2]).max() > 0
        digits = len(str(len(centers)))
        for number, center in enumerate(centers):
            if heliostat.facets[number].outline is not None:
                raise InvalidInputError(
                    f"heliostat {heliostat.name}: ARTIST has no facets with an outline; give"
                    " width_m and height_m"
                )
            sides = (axes[number, :2] * half_sizes[number][:, None]) @ turn.T
            sides = np.stack([sides[1], -sides[0]]) if turn[0, 0] == 0 else sides
            own = points[number] - (center @ turn.T if is_moved else 0.0)
            yield (
                f"facet_{number + 1:0{digits}d}",
                {
                    "control_points": own,
                    "degrees": np.full(2, surface.degree),
                    "position": np.append(center @ turn.T, 0.0),
                    "canting": np.pad(sides, ((0, 0), (0, 1))),
                },
            )

    def has_steps(self, name: str) -> bool:
        """Whether a heliostat's drives are written as they are."""
        design = self.described.types[self.described.type_of[name]].mount
        return design.kind != "azimuth_elevation" and all(
            isinstance(drive, LinearActuator) for drive in design.drives or (None,)
        )

    def _drives(self, name: str) -> list[_Members]:
        design = self.described.types[self.described.type_of[name]].mount
        if not self.has_steps(name):
            ideal: _Members = {
                "type": "ideal",
                "clockwise_axis_movement": False,
                "min_max_motor_positions": np.array(_ANY_ANGLE),
            }
            return [ideal, ideal]
        # ARTIST's first angle is zero if the mirror lies flat, that of a mount of Juelich if it is
        # upright.
        upright = np.pi / 2 if design.kind == "juelich" else 0.0
        linear = [drive for drive in design.drives or () if isinstance(drive, LinearActuator)]
        return [_linear(drive, zero) for drive, zero in zip(linear, (upright, 0.0), strict=True)]


# --- sun and target areas
# --------------------------------------------------------------------------------------------------


def _sun(shape: SunShape) -> _Members:
    if not isinstance(shape, Gaussian):
        raise InvalidInputError(
            "sun: ARTIST's sun is a normal distribution; write sun: {shape: gaussian,"
            " sigma_mrad: ..} into plant.yaml"
        )
    return {
        "type": "sun",
        "number_of_rays": _RAYS,
        "distribution_parameters": {
            "distribution_type": "normal",
            "mean": 0.0,
            "covariance": float(shape.sigma) ** 2,
        },
    }


def _target_areas(described: PlantDescription) -> _Members:
    planes: dict[str, _Members] = {}
    cylinders: dict[str, _Members] = {}
    for name, area in {**described.receivers, **described.plant.targets}.items():
        if isinstance(area, TargetPlane):
            planes[name] = _plane(area)
        elif isinstance(area, Cylinder):
            cylinders[name] = _cylinder(area)
        else:
            raise InvalidInputError(
                f"receiver {name}: ARTIST has planes and cylinders only; write it as one"
            )
    return {"target_areas_planar": planes, "target_areas_cylindrical": cylinders}


def _plane(area: TargetPlane) -> _Members:
    """An upright plane that faces north or south, along which ARTIST's maps have rows."""
    if abs(abs(area.normal[1]) - 1) > _LEVEL or abs(area.up[2] - 1) > _LEVEL:
        raise InvalidInputError(
            f"receivers.{area.name}: ARTIST's planes are upright and face north or south; give"
            " normal [0, 1, 0] and up [0, 0, 1]"
        )
    return {
        "position_center": np.append(area.center, 1.0),
        "normal_vector": np.append(area.normal, 0.0),
        "plane_e": area.width,
        "plane_u": area.height,
    }


def _cylinder(area: Cylinder) -> _Members:
    return {
        "cylinder_center": np.append(area.axis, 1.0),
        "cylinder_axis": np.append(area.up, 0.0),
        "cylinder_normal": np.append(area.normal, 0.0),
        "cylinder_radius": area.radius,
        "cylinder_height": area.height,
        "cylinder_opening_angle": float(np.radians(area.opening_deg)),
    }


def _linear(drive: LinearActuator, zero: float) -> _Members:
    return {
        "type": "linear",
        "clockwise_axis_movement": drive.clockwise,
        "min_max_motor_positions": np.array([0.0, drive.max_increment or 0.0]),
        "parameters": {
            "increment": drive.increment,
            "initial_stroke_length": drive.initial_stroke_length,
            "offset": drive.offset,
            "pivot_radius": drive.pivot_radius,
            "initial_angle": drive.initial_angle + zero,
        },
    }


# --- notes
# --------------------------------------------------------------------------------------------------


def _left_out(described: PlantDescription, with_steps: set[str]) -> Iterator[str]:
    """What a plant has and a scenario has not; drives of types in ``with_steps`` are written."""
    for name, kind in described.types.items():
        optics, where = kind.optics, f"heliostat_types.{name}"
        if optics.reflectance < 1:
            yield f"{where}.reflectance {optics.reflectance:g}; give it to ARTIST's tracer"
        if optics.slope_error:
            yield f"{where}.slope_error_mrad {1e3 * optics.slope_error:g}"
        if optics.pointing_error:
            yield f"{where}.pointing_error_mrad {1e3 * optics.pointing_error:g}"
        if kind.mount.drives is not None and name not in with_steps:
            yield f"{where}.mount.drives; ideal ones are in their place"
    for name, receiver in described.receivers.items():
        if receiver.absorptance < 1:
            yield f"receivers.{name}.absorptance {receiver.absorptance:g}"
    if described.tower is not None:
        yield "tower, and its shadow"
    if any(described.optics.attenuation):
        yield "atmosphere"
    if any(target.locator is not None for target in described.plant.targets.values()):
        yield "marks and cameras of targets"
    yield "time zone, names of types, which areas are receivers, and where heliostats aim"
