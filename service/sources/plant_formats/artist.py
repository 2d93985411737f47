"""Scenarios of ARTIST (HDF5): site, target areas, sun, and heliostats with their surfaces.

Prototypes replace the surface, kinematics or actuators that a heliostat has not.
What plant.yaml cannot say is named in the notes, or refused.

Source: ARTIST 2.0, ``docs/scenario.rst`` and ``artist.io.h5_scenario_parser``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from service.base.validation import NAME, counted, require_name
from service.sources.folder import MeasuredSurface
from service.sources.hdf5 import Hdf5Group, open_hdf5
from service.sources.plant_formats.artist_heliostats import (
    TILTS,
    TRANSLATIONS,
    ArtistMirror,
    RigidBody,
    rigid_body,
)
from service.sources.plant_formats.imported import (
    ImportedPlant,
    MirrorDesign,
    design_of,
    placed,
    plant_name,
    site,
)
from service.sources.plant_schema import MAX_FACETS, MAX_HELIOSTATS, HeliostatEntry

Array = NDArray[np.float64]

_SUN, _RIGID_BODY = "sun", "rigid_body"
_MAX_CONTROL_POINTS = 128
_MAX_TYPES = 64
_LEVEL = 1e-4


def read_artist(path: Path, parameters_are_positions: bool = False) -> ImportedPlant:
    """Read a scenario of ARTIST.

    ``parameters_are_positions`` is that of `model.surface.heights`.

    Raises
    ------
    InvalidInputError
        It names the file, the place in it, and what is not understood.
    """
    with open_hdf5(path) as data:
        if "DataSofastCalculation" in data:
            raise data.refuse(
                "is a measurement of SOFAST, no plant; put it into H/Deflectometry beside"
                " plant.yaml, with H the heliostat's name"
            )
        if "heliostats" not in data or "prototypes" not in data:
            raise data.refuse("is no scenario of ARTIST: 'heliostats' or 'prototypes' is missing")
        return _Scenario(data, path.stem, parameters_are_positions).plant()


class _Kinematics(NamedTuple):
    """Mount of a heliostat, and its entry in plant.yaml without its pivot's height."""

    body: RigidBody
    drives: tuple[tuple[tuple[str, object], ...], ...] | None


class _TypeKey(NamedTuple):
    """What the heliostats of one type have in common."""

    kind: str
    pivot_height: float
    mirror_offset: float
    drives: tuple[tuple[tuple[str, object], ...], ...] | None
    design: MirrorDesign


@dataclass
class _Scenario:
    """Reads the parts of a scenario; collects ``notes`` on the way."""

    data: Hdf5Group
    name: str
    parameters_are_positions: bool = False
    notes: list[str] = field(default_factory=list)
    left_out: dict[str, float] = field(default_factory=dict)

    def plant(self) -> ImportedPlant:
        """The plant with its heliostats and their surfaces."""
        areas = _TargetAreas(self.data, self.notes)
        sun = _sun(self.data)
        types: dict[_TypeKey, str] = {}
        heliostats: list[HeliostatEntry] = []
        surfaces: dict[str, MeasuredSurface] = {}
        members = self.data.group("heliostats").groups()
        if not 0 < len(members) <= MAX_HELIOSTATS:
            raise self.data.refuse(f"has {len(members)} heliostats; 1 to {MAX_HELIOSTATS} are read")
        prototypes = self.data.group("prototypes")
        for name, one in members.items():
            require_name(NAME, name, f"{one.place}: heliostat")
            kinematics = self._kinematics(one, prototypes)
            mirror = _mirror(
                _part("surface", one, prototypes), kinematics.body, self.parameters_are_positions
            )
            design, focal_length = design_of(mirror.facets)
            if mirror.surface is not None:
                surfaces[name] = mirror.surface
            foot = _vector(one, "position") + kinematics.body.joint * [1.0, 1.0, 0.0]
            height, offset = kinematics.body.joint[2], kinematics.body.mirror_offset
            key = _TypeKey(
                kinematics.body.kind,
                round(float(height), 9),
                round(float(offset), 9),
                kinematics.drives,
                design,
            )
            kind = types.setdefault(key, f"type-{len(types) + 1}")
            heliostats.append(placed(name, kind, foot.tolist(), focal_length))
        if len(types) > _MAX_TYPES:
            raise self.data.refuse(
                f"has {len(types)} heliostats that differ in mirror, mount or drives; a plant has"
                f" at most {_MAX_TYPES} types. Take a scenario of fewer heliostats"
            )
        return self._imported(areas, sun, types, heliostats, surfaces)

    def _imported(
        self,
        areas: "_TargetAreas",
        sun: dict[str, object],
        types: Mapping[_TypeKey, str],
        heliostats: Sequence[HeliostatEntry],
        surfaces: Mapping[str, MeasuredSurface],
    ) -> ImportedPlant:
        position = self.data.group("power_plant").numbers("position", (3,), 3)
        parts: dict[str, object] = {
            "plant": site(plant_name(self.name, "artist"), tuple(position.tolist()), "UTC"),
            "heliostat_types": {name: _entry(key, name) for key, name in types.items()},
        }
        if areas.receivers:
            parts["receivers"] = areas.receivers
        if areas.targets:
            parts["targets"] = areas.targets
        parts["sun"] = sun
        tables = {_facets_file(name): key.design.lines for key, name in types.items()}
        self._note_rest(surfaces)
        return ImportedPlant(parts, heliostats, notes=self.notes, facets=tables, surfaces=surfaces)

    def _note_rest(self, surfaces: Mapping[str, object]) -> None:
        for name, value in self.left_out.items():
            unit, size = ("mrad", 1e3 * value) if name in TILTS else ("m", value)
            self.notes.append(
                f"kinematics: {name} is left out, {size:.4g} {unit} at most; plant.yaml's mounts"
                " have none. Mirrors are aimed without it."
            )
        if surfaces:
            self.notes.append(
                f"surfaces: measured ones of {counted(len(surfaces), 'heliostat')}, in"
                " H/Deflectometry; heliotwin field takes them with --surfaces and this folder."
            )
            self.notes.append(
                "surfaces: read as fits of deflectometry, a parameter is a position; without"
                " --parameters-are-positions a spline is its geometry."
                if self.parameters_are_positions
                else "surfaces: a spline is its geometry, as ARTIST traces it;"
                " --parameters-are-positions reads them as fits of deflectometry."
            )
        self.notes += [
            "sun: the number of rays is left out; light is convolved here.",
            "heliostat_types: reflectance 1 and no errors, which a scenario has not. The"
            " reflectivity of ARTIST's tracer is 0.935 by default.",
            "plant: time zone UTC; change it to yours.",
            "receivers and targets: a scenario does not say which are which. Cylinders, and planes"
            " named receiver, are receivers; heliostats aim at the first.",
        ]

    def _kinematics(self, one: Hdf5Group, prototypes: Hdf5Group) -> _Kinematics:
        body = _part("kinematics", one, prototypes)
        kind = body.text("type")
        if kind != _RIGID_BODY:
            raise body.refuse(f"'type' {kind!r} is not read; {_RIGID_BODY} is")
        names = (*TRANSLATIONS, *TILTS)
        given = body.group("deviations") if "deviations" in body else None
        if given is not None:
            for name in given.names:
                if name not in names:
                    raise given.refuse(f"'{name}' is not known; known are {', '.join(names)}")
        values = {
            name: given.number(name) if given is not None and name in given else 0.0
            for name in names
        }
        found = rigid_body(values)
        for name, value in found.left_out.items():
            self.left_out[name] = max(self.left_out.get(name, 0.0), abs(value))
        return _Kinematics(found, self._drives(_part("actuator", one, prototypes), found.kind))

    def _drives(
        self, actuators: Hdf5Group, mount: str
    ) -> tuple[tuple[tuple[str, object], ...], ...] | None:
        """Drives as entries of plant.yaml; None for ideal ones."""
        drives = actuators.groups().values()
        kinds = {drive.text("type") for drive in drives}
        if len(drives) != 2 or len(kinds) != 1 or not kinds <= {"ideal", "linear"}:
            raise actuators.refuse(
                f"has {len(drives)} actuators of {', '.join(sorted(kinds))}; two ideal or two"
                " linear ones are read"
            )
        if kinds == {"ideal"}:
            limits = [drive.numbers("min_max_motor_positions", (2,), 2) for drive in drives]
            if any(low > -np.pi or high < np.pi for low, high in limits):
                self._note(
                    "actuators: ideal ones have no limits here; those of the file are left out."
                )
            return None
        if mount == "azimuth_elevation":
            self._note("actuators: linear ones of an upright first axis are left out.")
            return None
        for drive in drives:
            if drive.numbers("min_max_motor_positions", (2,), 2)[0] != 0:
                self._note("actuators: motor positions begin at 0; a smallest one is left out.")
        return tuple(tuple(_linear(drive).items()) for drive in drives)

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def _linear(drive: Hdf5Group) -> dict[str, object]:
    """The entry of a linear drive."""
    parameters = drive.group("parameters")
    entry: dict[str, object] = {"kind": "linear"}
    for name, key in _LINEAR.items():
        entry[key] = _exact(parameters.number(name))
    entry["clockwise"] = drive.truth("clockwise_axis_movement")
    most = drive.numbers("min_max_motor_positions", (2,), 2)[1]
    return {**entry, "max_increment_steps": _exact(most)}


_LINEAR = {
    "increment": "increment_steps_per_m",
    "initial_stroke_length": "initial_stroke_length_m",
    "offset": "offset_m",
    "pivot_radius": "pivot_radius_m",
    "initial_angle": "initial_angle_rad",
}


def _exact(value: float) -> float:
    """A number without the digits of its single precision."""
    return float(f"{value:.9g}")


def _part(name: str, one: Hdf5Group, prototypes: Hdf5Group) -> Hdf5Group:
    """A heliostat's part, or the prototype's; ARTIST 1.x has ``kinematic``, without an s."""
    owners = ((owner, known) for known in (name, name.rstrip("s")) for owner in (one, prototypes))
    owner, known = next(((o, k) for o, k in owners if k in o), (prototypes, name))
    return owner.group(known)


def _vector(group: Hdf5Group, name: str) -> Array:
    """The first three of four homogeneous coordinates; ARTIST writes some as a row."""
    found = group.numbers(name, (1, 4), 4) if group.dimensions(name) == 2 else None
    values = group.numbers(name, (4,), 4) if found is None else found[0]
    if not np.isfinite(values).all():
        raise group.refuse(f"'{name}' must be finite")
    return values[:3]


def _facets_file(name: str) -> str:
    return f"facets-{name}.csv"


def _entry(key: _TypeKey, name: str) -> dict[str, object]:
    mount: dict[str, object] = {
        "kind": key.kind,
        "pivot_height_m": key.pivot_height,
        "mirror_offset_m": key.mirror_offset,
    }
    if key.drives is not None:
        mount["drives"] = [dict(drive) for drive in key.drives]
    return {"mount": mount, "facets": {"file": _facets_file(name)}, **key.design.entries}


# --- sun and target areas
# --------------------------------------------------------------------------------------------------


def _sun(data: Hdf5Group) -> dict[str, object]:
    sources = data.group("lightsources").groups()
    if len(sources) != 1:
        raise data.group("lightsources").refuse(f"has {len(sources)} light sources; one is read")
    (source,) = sources.values()
    distribution = source.group("distribution_parameters")
    kind, shape = source.text("type"), distribution.text("distribution_type")
    if (kind, shape) != (_SUN, "normal"):
        raise source.refuse(f"is a {kind} of distribution {shape}; a normal sun is read")
    if "mean" in distribution and distribution.number("mean") != 0:
        raise distribution.refuse("'mean' must be 0: a sun beside its place is not read")
    variance = distribution.number("covariance")
    if not 0 < variance < 1e-2:
        raise distribution.refuse(f"'covariance' must lie in (0, 0.01) rad2, got {variance:g}")
    return {"shape": "gaussian", "sigma_mrad": float(f"{1e3 * np.sqrt(variance):.9g}")}


_AREAS_1 = "target_areas"


class _TargetAreas:
    """Receivers and targets; those that plant.yaml cannot have are named in the notes."""

    def __init__(self, data: Hdf5Group, notes: list[str]) -> None:
        self.receivers: dict[str, dict[str, object]] = {}
        self.targets: dict[str, dict[str, object]] = {}
        self.notes = notes
        for name, area in self._areas(data, "cylindrical").items():
            found = self._cylinder(area)
            if found is not None:
                self.receivers[name] = found
        for name, area in self._areas(data, "planar").items():
            found = self._plane(area)
            if found is not None:
                (self.receivers if name == "receiver" else self.targets)[name] = found
        if not self.receivers and not self.targets:
            groups = [name for name in data.names if name.startswith(_AREAS_1)]
            raise data.refuse(
                f"has no target area that a plant can have in {' or '.join(groups) or _AREAS_1}:"
                " an upright plane that faces north or south, or an upright cylinder."
                f" {' '.join(self.notes)}".rstrip()
            )

    def _areas(self, data: Hdf5Group, kind: str) -> dict[str, Hdf5Group]:
        group = f"target_areas_{kind}"
        areas = data.group(group).groups() if group in data else {}
        if kind == "planar" and _AREAS_1 in data:
            for name, area in data.group(_AREAS_1).groups().items():
                if area.text("geometry") == kind:
                    areas[name] = area
                else:
                    self._leave_out(area, f"is a {area.text('geometry')} of ARTIST 1.x")
        for name, area in areas.items():
            require_name(NAME, name, f"{area.place}: target area")
            if name in self.receivers or name in self.targets:
                raise area.refuse("is a plane's and a cylinder's name; rename one of them")
        return areas

    def _plane(self, area: Hdf5Group) -> dict[str, object] | None:
        normal = _unit(_vector(area, "normal_vector"))
        if abs(abs(normal[1]) - 1) > _LEVEL:
            self._leave_out(area, "does not face north or south, as ARTIST's maps need it")
            return None
        return {
            "kind": "plane",
            "center_m": _rounded(_vector(area, "position_center")),
            "normal": _rounded(normal),
            "width_m": _exact(area.number("plane_e")),
            "height_m": _exact(area.number("plane_u")),
        }

    def _cylinder(self, area: Hdf5Group) -> dict[str, object] | None:
        axis, normal = (_unit(_vector(area, f"cylinder_{name}")) for name in ("axis", "normal"))
        opening = np.degrees(area.number("cylinder_opening_angle"))
        if abs(axis[2] - 1) > _LEVEL:
            self._leave_out(area, "is inclined; plant.yaml has upright cylinders")
            return None
        if not 0 < opening < 360.001:
            self._leave_out(area, "opens by more than 2 pi rad; ARTIST has it in radians")
            return None
        return {
            "kind": "cylinder",
            "center_m": _rounded(_vector(area, "cylinder_center")),
            "radius_m": _exact(area.number("cylinder_radius")),
            "height_m": _exact(area.number("cylinder_height")),
            "facing_azimuth_deg": _exact(float(np.degrees(np.arctan2(normal[0], normal[1])))),
            "opening_deg": min(_exact(float(opening)), 360.0),
        }

    def _leave_out(self, area: Hdf5Group, why: str) -> None:
        name = str(area.members.name).rsplit("/", 1)[-1]
        self.notes.append(f"target areas: {name} is left out. It {why}.")


def _unit(vector: Array) -> Array:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-300))


def _rounded(vector: Array) -> list[float]:
    return [_exact(value) + 0.0 for value in vector.tolist()]


def _mirror(surface: Hdf5Group, body: RigidBody, parameters_are_positions: bool) -> ArtistMirror:
    """The mirror of a heliostat in our mirror coordinates."""
    facets = list(surface.group("facets").groups().values())
    if not 0 < len(facets) <= MAX_FACETS:
        raise surface.refuse(f"has {len(facets)} facets; 1 to {MAX_FACETS} are read")
    degrees = {tuple(facet.numbers("degrees", (2,), 2).tolist()) for facet in facets}
    (degree, other), *more = degrees
    if more or degree != other or degree != int(degree):
        raise surface.refuse(f"'degrees' {sorted(degrees)} differ; equal ones are read")
    most = 3 * _MAX_CONTROL_POINTS**2
    grids = [facet.numbers("control_points", (None, None, 3), most) for facet in facets]
    if len({grid.shape for grid in grids}) > 1 or min(grids[0].shape[:2]) <= degree:
        raise surface.refuse(
            "'control_points' must have one shape in all facets, and more points than the degree"
        )
    points = np.array(grids)
    if not np.isfinite(points).all():
        raise surface.refuse("'control_points' must be finite")
    centers = np.array([_vector(facet, "position") for facet in facets])
    sides = np.array([facet.numbers("canting", (2, 4), 8)[:, :3] for facet in facets])
    try:
        spline = MeasuredSurface(points, int(degree), parameters_are_positions)
        return ArtistMirror.of(centers, sides, spline, body.mirror)
    except InvalidInputError as error:
        raise surface.refuse(str(error)) from None
