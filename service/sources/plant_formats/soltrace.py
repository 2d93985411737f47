"""Read SolTrace's ``.stinput``: a stage of heliostats, and one of receivers.

Elements have their origin, a point on their z axis, and a rotation about it. Slope and specularity
errors are standard deviations per axis [mrad], as those of plant.yaml.

Source: NREL, SolTrace, input files of version 2012.7.6; Wendelin, *SolTRACE: a new optical modeling
tool for concentrating solar optics*, ISEC 2003, doi:10.1115/ISEC2003-44090.
"""

import codecs
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.frames import sun_angles
from service.base.validation import NAME, counted
from service.sources.files import file_name, read_text, require_regular
from service.sources.plant_formats.imported import (
    FacetedMirror,
    ImportedPlant,
    MirrorDesign,
    design_of,
    placed,
    site,
)
from service.sources.plant_formats.soltrace_mirrors import (
    NAMED_STAGE,
    SOLTRACE_TOLERANCE,
    TURNED,
    Element,
    Pose,
    heliostat_groups,
    like_known,
    posed_mirror,
)
from service.sources.plant_schema import MAX_HELIOSTATS, HeliostatEntry
from service.sources.text_lines import MAX_BYTES, ForeignLine, split_lines

Array = NDArray[np.float64]

_MAX_TYPES = 64


@dataclass(frozen=True)
class OpticalPair:
    """Reflectivity and errors [mrad] of an element's front."""

    line: ForeignLine = field(compare=False)
    reflectivity: float
    slope: float
    specularity: float
    has_table: bool = False


@dataclass(frozen=True, eq=False)
class SolTraceInput:
    """An input file: unit vector to the sun (3,), its shape, optics by name, elements by stage,
    and whether comments are names of heliostats.
    """

    sun: Array
    sun_shape: str
    sun_size: float
    sun_table: Array
    optics: Mapping[str, OpticalPair]
    stages: Sequence[Sequence[Element]] = field(default_factory=tuple)
    has_names: bool = False


def euler_axes(direction: Array, z_rotation_deg: float) -> Array:
    """Unit vectors (3, 3) along x, y, z of an element, as rows.

    ``direction`` (3,) is along its z. At no rotation its x axis is in the plane of the stage's x
    and z.
    """
    z = direction / np.linalg.norm(direction)
    alpha, beta = np.arctan2(z[0], z[2]), np.arcsin(z[1])
    gamma = np.radians(z_rotation_deg)
    x = np.array([np.cos(alpha), 0.0, -np.sin(alpha)])
    y = np.array([-np.sin(alpha) * np.sin(beta), np.cos(beta), -np.cos(alpha) * np.sin(beta)])
    return np.stack(
        [np.cos(gamma) * x - np.sin(gamma) * y, np.sin(gamma) * x + np.cos(gamma) * y, z]
    )


# --- the file
# --------------------------------------------------------------------------------------------------


def is_soltrace(path: Path) -> bool:
    """Whether a file begins as an input of SolTrace does; SolarPILOT may name it ``.txt``."""
    with require_regular(path).open("rb") as file:
        start = file.read(16).removeprefix(codecs.BOM_UTF8)
    return start.startswith((b"# SOLTRACE", b"SUN\tPTSRC"))


def parse_soltrace(path: Path) -> SolTraceInput:
    """Parse an input file.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    # SolTrace writes names in the encoding of its machine, and a stage's name may be empty.
    lines = iter(split_lines(file_name(path), read_text(path, MAX_BYTES, "latin-1"), "\t"))
    try:
        return _parse(lines)
    except (StopIteration, IndexError):
        raise InvalidInputError(f"{file_name(path)}: ends too early") from None


def _parse(lines: Iterator[ForeignLine]) -> SolTraceInput:
    sun = next(lines)
    if sun.cells[0].startswith("# SOLTRACE"):
        sun = next(lines)
    elif sun.cells[0] != "SUN":
        raise sun.refuse("must begin with # SOLTRACE or SUN; it is no input file of SolTrace")
    position = next(lines)
    if sun.cells[:2] != ["SUN", "PTSRC"] or position.cells[0] != "XYZ":
        raise sun.refuse("must be the sun, SUN PTSRC, and its position below")
    if sun.number(2, 0, 1) != 0:
        raise sun.refuse("a point source, PTSRC 1, is no sun; write PTSRC 0 and the sun's position")
    if position.cells[4:6] != ["USELDH", "0"]:
        raise position.refuse("a sun by latitude, day and hour is not read; give its position")
    table = next(lines)
    points: list[list[float]] = []
    if table.cells[0] == "USER SHAPE DATA":  # SolarPILOT writes it for sun shape d only
        points = [next(lines).numbers(0, 2) for _ in range(int(table.number(1, 0, 1e4)))]
        table = next(lines)
    shape = sun.cells[4].lower() if len(sun.cells) > 4 else ""
    if shape not in ("p", "g", "d"):
        raise sun.refuse(f"sun shape {shape[:20]!r} is none of p, g, d")
    size = sun.number(6 if shape == "g" else 8, 0, 100)
    direction = np.array(position.numbers(1, 3))
    if not np.linalg.norm(direction) > 0:
        raise position.refuse("the sun's position must not vanish")
    return SolTraceInput(
        direction / np.linalg.norm(direction),
        shape,
        size,
        np.array(points).reshape(-1, 2),
        _optics(table, lines),
        *_stages(lines),
    )


def _count(line: ForeignLine, title: str) -> int:
    if line.cells[0].strip() != title:
        raise line.refuse(f"must be {title}")
    return int(line.number(1, 0, 1e6))


def _optics(head: ForeignLine, lines: Iterator[ForeignLine]) -> dict[str, OpticalPair]:
    pairs = {}
    for _ in range(_count(head, "OPTICS LIST COUNT")):
        name = next(lines)
        if name.cells[0] != "OPTICAL PAIR" or len(name.cells) < 2:
            raise name.refuse("must be an OPTICAL PAIR with its front and back")
        pairs[name.cells[1]] = _surface_optics(lines)
        _surface_optics(lines)
    return pairs


def _surface_optics(lines: Iterator[ForeignLine]) -> OpticalPair:
    """The optics of a side; tables of the program's OPTICAL.v2 follow it."""
    side = next(lines)
    if side.cells[0] not in ("OPTICAL", "OPTICAL.v2"):
        raise side.refuse("must be OPTICAL or OPTICAL.v2, a side of an OPTICAL PAIR")
    if side.cells[1] != "g":
        raise side.refuse("errors that are not Gaussian, g, are not read")
    tables = [
        int(side.number(index + 1, 0, 1e6)) * side.number(index, 0, 1)
        for index in (15, 17)
        if index + 1 < len(side.cells)
    ]
    for _ in range(int(sum(tables))):
        next(lines)
    return OpticalPair(
        side,
        side.number(5, 0, 1),
        side.number(7, 0, 1e4),
        side.number(8, 0, 1e4),
        bool(tables and tables[0]),
    )


class _Stages(NamedTuple):
    """Elements by stage, and whether the first stage's comments are names of heliostats."""

    elements: list[list[Element]]
    has_names: bool


def _stages(lines: Iterator[ForeignLine]) -> _Stages:
    stages, titles = [], []
    for _ in range(_count(next(lines), "STAGE LIST COUNT")):
        head = next(lines)
        if head.cells[0] != "STAGE" or "ELEMENTS" not in head.cells:
            raise head.refuse("must be a STAGE with its number of ELEMENTS")
        if not _is_at_origin(head):
            raise head.refuse(
                "a stage with an origin or a direction of its coordinates is not read"
            )
        title = next(lines).cells[0]
        count = int(head.number(head.cells.index("ELEMENTS") + 1, 0, 1e6))
        elements = [_element(next(lines)) for _ in range(count)]
        if head.cells[11:13] != ["VIRTUAL", "1"]:
            stages.append(elements)
            titles.append(title)
    return _Stages(stages, titles[:1] == [NAMED_STAGE])


def _is_at_origin(stage: ForeignLine) -> bool:
    """Whether a stage has the coordinates of the whole; other programs write 0.000000 for 0."""
    if (stage.cells[1], stage.cells[5], stage.cells[9]) != ("XYZ", "AIM", "ZROT"):
        return False
    *others, up, turn = *stage.numbers(2, 3), *stage.numbers(6, 3), stage.number(10)
    return not any(others) and up > 0 and turn == 0


def _element(line: ForeignLine) -> Element:
    if len(line.cells) < 29:
        raise line.refuse(f"an element has 29 cells or more, not {len(line.cells)}")
    origin, point = (np.array(line.numbers(first, 3)) for first in (1, 4))
    if not np.linalg.norm(point - origin) > 0:
        raise line.refuse("its aim must differ from its origin")
    return Element(
        line,
        origin,
        euler_axes(point - origin, line.number(7)),
        line.cells[8],
        line.numbers(9, 8),
        line.cells[17],
        line.numbers(18, 8),
        line.cells[27],
        line.cells[29].strip() if len(line.cells) > 29 else "",
        line.number(0, 0, 1) == 1,
    )


# --- the plant
# --------------------------------------------------------------------------------------------------


def read_soltrace(path: Path) -> ImportedPlant:
    """Read the plant of an input file: heliostats of facets, and receivers.

    Aim points are where the file's sun is reflected to.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    given = parse_soltrace(path)
    stages = [[element for element in stage if element.is_enabled] for stage in given.stages]
    if len(stages) != 2 or not all(stages):
        raise InvalidInputError(
            f"{file_name(path)}: must have a stage of heliostats and one of receivers"
        )
    groups = heliostat_groups(stages[0], given.has_names)
    if len(groups) > MAX_HELIOSTATS:
        raise stages[0][-1].line.refuse(f"at most {MAX_HELIOSTATS} heliostats are read")
    receivers = _receivers(stages[1], given.optics)
    types: dict[tuple[MirrorDesign, str], str] = {}
    heliostats: list[HeliostatEntry] = []
    poses: list[Pose] = []
    known: list[FacetedMirror] = []
    turned = 0.0
    for name, facets in groups.items():
        pose, own = posed_mirror(facets)
        turned = max(turned, own.turned)
        mirror = like_known(own, known)
        design, focal_length = design_of(mirror, SOLTRACE_TOLERANCE)
        optics = {facet.optics for facet in facets}
        if len(optics) > 1:
            raise facets[0].line.refuse("facets of one heliostat have several optical pairs")
        kind = types.setdefault((design, optics.pop()), f"type-{len(types) + 1}")
        if len(types) > _MAX_TYPES:
            raise facets[0].line.refuse(
                f"the file has more than {_MAX_TYPES} kinds of heliostats; write each facet's"
                " heliostat into its comment"
            )
        heliostats.append(placed(name, kind, pose.middle.tolist(), focal_length))
        poses.append(pose)
    azimuth, elevation = (float(angle) for angle in sun_angles(given.sun))
    n_off = sum(map(len, given.stages)) - sum(map(len, stages))
    goals = _aims(poses, stages[1], given.sun)
    entries = {kind: _type(key, kind, given.optics) for key, kind in types.items()}
    if len(receivers) > 1:
        heliostats = [
            entry.model_copy(update={"receiver": _receiver_name(stages[1][goal.receiver])})
            for entry, goal in zip(heliostats, goals, strict=True)
        ]
    return ImportedPlant(
        parts={
            "plant": site("soltrace", (0.0, 0.0, 0.0), "UTC"),
            "heliostat_types": entries,
            "receivers": receivers,
            "sun": _sun(given),
        },
        heliostats=heliostats,
        aims={
            heliostat.name: goal.point for heliostat, goal in zip(heliostats, goals, strict=True)
        },
        facets={_facets_file(kind): key[0].lines for key, kind in types.items()},
        notes=(
            f"The file's sun: azimuth {azimuth:.4f}, elevation {elevation:.4f} degrees. Aim points"
            " are where it is reflected to.",
            "plant: the file has no site; change it to yours.",
            "heliostats: they turn about azimuth and elevation, and the pivot is the mirror's"
            " middle; change their mounts to yours.",
            "pointing_error_mrad is SolTrace's specularity error: both spread the beam alike.",
            *(
                [f"heliostats: {len(stages[0])} facets are {counted(len(groups), 'heliostat')}."]
                if len(groups) < len(stages[0])
                else []
            ),
            *_turn_notes(turned),
            *([f"left out, as switched off: {counted(n_off, 'element')}."] if n_off else []),
            *(
                ("sun: a pillbox of the same spread replaces the file's table.",)
                * (given.sun_shape == "d")
            ),
        ),
    )


def _turn_notes(turned: float) -> list[str]:
    if turned < TURNED:
        return []
    return [
        f"facets: turns of up to {1e3 * turned:.3g} mrad in the mirror's plane are left out; they"
        " come from the facets' canting."
    ]


def _facets_file(kind: str) -> str:
    return f"facets-{kind}.csv"


def _type(
    key: tuple[MirrorDesign, str], kind: str, optics: Mapping[str, OpticalPair]
) -> dict[str, object]:
    design, name = key
    pair = _pair(name, optics)
    return {
        "mount": {"kind": "azimuth_elevation"},
        "facets": {"file": _facets_file(kind)},
        **design.entries,
        "reflectance": pair.reflectivity,
        "slope_error_mrad": pair.slope,
        "pointing_error_mrad": pair.specularity,
    }


def _pair(name: str, optics: Mapping[str, OpticalPair]) -> OpticalPair:
    if name not in optics:
        raise InvalidInputError(f"optical pair {name[:60]!r} is not in the file")
    if optics[name].has_table:
        raise optics[name].line.refuse(
            "a table of reflectivity over the angle is not read; give one number, and 0 for it"
        )
    return optics[name]


def _receiver_name(element: Element) -> str:
    """The name of an element's receiver: our exports name its optics ``receiver NAME``."""
    prefix, _, name = element.optics.rpartition(" ")
    return name if prefix == "receiver" and re.fullmatch(NAME, name) else "main"


def _receivers(
    elements: Sequence[Element], optics: Mapping[str, OpticalPair]
) -> dict[str, dict[str, object]]:
    """Receivers of elements; several planes of the same optics are panels of one."""
    found: dict[str, list[dict[str, object]]] = {}
    for element in elements:
        found.setdefault(_receiver_name(element), []).append(_receiver(element, optics))
    entries = {}
    for name, parts in found.items():
        if len(parts) > 1 and any(part["kind"] != "plane" for part in parts):
            raise elements[0].line.refuse(
                "the stage of receivers has several cylinders of the same optics; give each"
                " receiver an optical pair of its name"
            )
        shared = {"kind": "panels", "absorptance": parts[0]["absorptance"]}
        panels = [{k: v for k, v in part.items() if k not in shared} for part in parts]
        entries[name] = parts[0] if len(parts) == 1 else {**shared, "panels": panels}
    return entries


def _receiver(element: Element, optics: Mapping[str, OpticalPair]) -> dict[str, object]:
    """The receiver of an element: a flat rectangle, or a whole upright cylinder."""
    absorptance = round(1 - _pair(element.optics, optics).reflectivity, 6)
    _, y, z = element.axes
    if element.aperture == "r" and element.surface == "f":
        return {
            "kind": "plane",
            "center_m": element.origin.tolist(),
            "normal": z.tolist(),
            "up": y.tolist(),
            "width_m": element.size[0],
            "height_m": element.size[1],
            "absorptance": absorptance,
        }
    is_whole = element.aperture == "l" and list(element.size[:2]) == [0, 0]
    if not is_whole or element.surface != "t" or not element.shape[0] > 0 or abs(y[2]) < 1 - 1e-6:
        raise element.line.refuse(
            "only receivers that are a flat rectangle or a whole upright cylinder are read"
        )
    radius = 1 / element.shape[0]
    return {
        "kind": "cylinder",
        "center_m": [round(value, 6) for value in (element.origin + radius * z).tolist()],
        "radius_m": round(radius, 4),
        "height_m": element.size[2],
        "absorptance": absorptance,
    }


def _sun(given: SolTraceInput) -> dict[str, object]:
    if given.sun_shape == "g":
        return {"shape": "gaussian", "sigma_mrad": given.sun_size}
    if given.sun_shape == "p":
        return {"shape": "pillbox", "half_angle_mrad": given.sun_size}
    angles, radiance = given.sun_table.T
    if (
        len(angles) < 2
        or (np.diff(angles) <= 0).any()
        or (radiance < 0).any()
        or not radiance[1:].any()
    ):
        raise InvalidInputError("the sun's table must have radiances at increasing angles")
    weights = radiance * angles * np.gradient(angles)
    spread = np.sqrt(2 * (weights @ angles**2) / weights.sum())  # a pillbox has R^2 / 2
    return {"shape": "pillbox", "half_angle_mrad": round(float(spread), 4)}


class _Goal(NamedTuple):
    """The point (3,) [m] that a mirror aims at, and the index of its element."""

    point: Array
    receiver: int


def _aims(poses: Sequence[Pose], receivers: Sequence[Element], sun: Array) -> list[_Goal]:
    """Where mirrors reflect the sun to: on the receiver that the ray passes nearest."""
    origins = np.array([pose.middle for pose in poses])
    normals = np.array([pose.axes[2] for pose in poses])
    rays = 2 * (normals @ sun)[:, None] * normals - sun
    middles = [r.origin + (r.surface != "f") * r.axes[2] / (r.shape[0] or 1) for r in receivers]
    ways = [middle - origins for middle in middles]
    missed = [np.linalg.norm(np.cross(way, rays), axis=1) for way in ways]
    points = [_points_on(receiver, origins, rays) for receiver in receivers]
    return [
        _Goal(points[nearest][index], nearest)
        for index, nearest in enumerate(np.argmin(missed, axis=0).tolist())
    ]


def _points_on(receiver: Element, origins: Array, rays: Array) -> Array:
    """Points (n, 3) [m] of a receiver that rays meet.

    On a cylinder it is the nearer of two, and the nearest to its axis if the light misses it.
    """
    z = receiver.axes[2]
    if receiver.surface == "f":
        ways = ((receiver.origin - origins) @ z) / (rays @ z)
        return np.asarray(origins + ways[:, None] * rays)
    radius = 1 / receiver.shape[0]
    start = (origins - receiver.origin - radius * z)[:, :2]
    a = (rays[:, :2] ** 2).sum(axis=1)
    b = (start * rays[:, :2]).sum(axis=1)
    c = (start**2).sum(axis=1) - radius**2
    ways = (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a
    return np.asarray(origins + ways[:, None] * rays)
