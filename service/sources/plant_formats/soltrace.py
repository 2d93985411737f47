"""Read SolTrace's ``.stinput``: a stage of heliostats, and one of receivers.

Elements have their origin, a point on their z axis, and a rotation about it. Slope and specularity
errors are standard deviations per axis [mrad], as those of plant.yaml.

Source: NREL, SolTrace, input files of version 2012.7.6; Wendelin, *SolTRACE: a new optical modeling
tool for concentrating solar optics*, ISEC 2003, doi:10.1115/ISEC2003-44090.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.frames import sun_angles
from service.sources.files import file_name
from service.sources.plant_formats.imported import ImportedPlant, placed, site
from service.sources.plant_formats.text import ForeignLine, read_lines
from service.sources.plant_schema import MAX_HELIOSTATS, HeliostatEntry

Array = NDArray[np.float64]

# Largest deviation of an element's x axis from the horizontal [rad].
_ROLL = 1e-4


@dataclass(frozen=True)
class OpticalPair:
    """Reflectivity and errors [mrad] of an element's front."""

    reflectivity: float
    slope: float
    specularity: float


@dataclass(frozen=True, eq=False)
class Element:
    """A surface of a stage.

    Attributes
    ----------
    line : ForeignLine
    origin : (3,) [m]
    axes : (3, 3)
        Unit vectors along its x, y and z, as rows.
    aperture, surface : str
        Letters of their kinds.
    size, shape : sequence of float
        Parameters of aperture and surface.
    optics : str
        Name of its optical pair.
    """

    line: ForeignLine
    origin: Array
    axes: Array
    aperture: str
    size: Sequence[float]
    surface: str
    shape: Sequence[float]
    optics: str


@dataclass(frozen=True, eq=False)
class SolTraceInput:
    """An input file: unit vector to the sun (3,), its shape, optics by name, elements by stage."""

    sun: Array
    sun_shape: str
    sun_size: float
    sun_table: Array
    optics: Mapping[str, OpticalPair]
    stages: Sequence[Sequence[Element]] = field(default_factory=tuple)


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


def parse_soltrace(path: Path) -> SolTraceInput:
    """Parse an input file.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    lines = iter(read_lines(path, "\t"))
    try:
        return _parse(lines)
    except (StopIteration, IndexError):
        raise InvalidInputError(f"{file_name(path)}: ends too early") from None


def _parse(lines: Iterator[ForeignLine]) -> SolTraceInput:
    head = next(lines)
    if not head.cells[0].startswith("# SOLTRACE"):
        raise head.refuse("must begin with # SOLTRACE; it is no input file of SolTrace")
    sun, position, table = next(lines), next(lines), next(lines)
    if sun.cells[:2] != ["SUN", "PTSRC"] or position.cells[0] != "XYZ":
        raise sun.refuse("must be the sun, SUN PTSRC, and its position below")
    if position.cells[4:6] != ["USELDH", "0"]:
        raise position.refuse("a sun by latitude, day and hour is not read; give its position")
    points = [next(lines).numbers(0, 2) for _ in range(int(table.number(1, 0, 1e4)))]
    shape = sun.cells[4] if len(sun.cells) > 4 else ""
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
        _optics(lines),
        _stages(lines),
    )


def _count(line: ForeignLine, title: str) -> int:
    if line.cells[0].strip() != title:
        raise line.refuse(f"must be {title}")
    return int(line.number(1, 0, 1e6))


def _optics(lines: Iterator[ForeignLine]) -> dict[str, OpticalPair]:
    pairs = {}
    for _ in range(_count(next(lines), "OPTICS LIST COUNT")):
        name, front, _back = next(lines), next(lines), next(lines)
        if name.cells[0] != "OPTICAL PAIR" or front.cells[0] != "OPTICAL" or len(name.cells) < 2:
            raise name.refuse("must be an OPTICAL PAIR with its front and back")
        if front.cells[1] != "g":
            raise front.refuse("errors that are not Gaussian, g, are not read")
        pairs[name.cells[1]] = OpticalPair(
            front.number(5, 0, 1), front.number(7, 0, 1e4), front.number(8, 0, 1e4)
        )
    return pairs


def _stages(lines: Iterator[ForeignLine]) -> list[list[Element]]:
    stages = []
    for _ in range(_count(next(lines), "STAGE LIST COUNT")):
        head = next(lines)
        here = [*head.cells[1:5], *head.cells[5:9], *head.cells[9:11]]
        if head.cells[0] != "STAGE" or "ELEMENTS" not in head.cells:
            raise head.refuse("must be a STAGE with its number of ELEMENTS")
        if here != ["XYZ", "0", "0", "0", "AIM", "0", "0", "1", "ZROT", "0"]:
            raise head.refuse(
                "a stage with an origin or a direction of its coordinates is not read"
            )
        next(lines)  # its name
        count = int(head.number(head.cells.index("ELEMENTS") + 1, 0, 1e6))
        elements = [_element(next(lines)) for _ in range(count)]
        stages.append([element for element in elements if element is not None])
    return stages


def _element(line: ForeignLine) -> Element | None:
    """The element of a line; None if it is switched off."""
    if line.number(0, 0, 1) == 0:
        return None
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
    )


# --- the plant
# --------------------------------------------------------------------------------------------------


def read_soltrace(path: Path) -> ImportedPlant:
    """Read the plant of an input file: heliostats of one facet, and the receiver.

    Aim points are where the file's sun is reflected to.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    given = parse_soltrace(path)
    if len(given.stages) != 2 or not given.stages[0] or len(given.stages[1]) != 1:
        raise InvalidInputError(
            f"{file_name(path)}: must have a stage of heliostats and one of a single receiver"
        )
    mirrors, (receiver,) = given.stages
    if len(mirrors) > MAX_HELIOSTATS:
        raise mirrors[-1].line.refuse(f"at most {MAX_HELIOSTATS} heliostats are read")
    kinds: dict[tuple[object, ...], str] = {}
    heliostats: list[HeliostatEntry] = []
    for number, mirror in enumerate(mirrors, start=1):
        kind = kinds.setdefault(_kind(mirror), f"type-{len(kinds) + 1}")
        heliostats.append(placed(f"H{number}", kind, mirror.origin.tolist(), _focal_length(mirror)))
    entry = _receiver(receiver, given.optics)
    azimuth, elevation = (float(angle) for angle in sun_angles(given.sun))
    return ImportedPlant(
        parts={
            "plant": site("soltrace", (0.0, 0.0, 0.0), "UTC"),
            "heliostat_types": {name: _type(kind, given.optics) for kind, name in kinds.items()},
            "receivers": {"main": entry},
            "sun": _sun(given),
        },
        heliostats=heliostats,
        aims={
            heliostat.name: aim
            for heliostat, aim in zip(heliostats, _aims(mirrors, receiver, given.sun), strict=True)
        },
        notes=(
            f"The file's sun: azimuth {azimuth:.4f}, elevation {elevation:.4f} degrees. Aim points"
            " are where it is reflected to.",
            "plant: the file has no site; change it to yours.",
            "pointing_error_mrad is SolTrace's specularity error: both spread the beam alike.",
            *(
                ("sun: a pillbox of the same spread replaces the file's table.",)
                * (given.sun_shape == "d")
            ),
        ),
    )


def _kind(mirror: Element) -> tuple[object, ...]:
    """What mirrors of one type have in common: width, height, surface, optics."""
    if mirror.aperture != "r":
        raise mirror.line.refuse(
            f"aperture {mirror.aperture[:20]!r} of a heliostat is not read; r, a rectangle, is"
        )
    if abs(mirror.axes[0, 2]) > _ROLL:
        raise mirror.line.refuse(
            "is rolled about its normal; only mirrors on an azimuth-elevation mount are read"
        )
    _focal_length(mirror)
    return (mirror.size[0], mirror.size[1], mirror.surface, mirror.optics)


def _focal_length(mirror: Element) -> float | None:
    """The focal length [m] of a paraboloid; None for a flat mirror."""
    if mirror.surface == "f":
        return None
    c_x, c_y = mirror.shape[:2]
    if mirror.surface != "p" or c_x != c_y or not 1e-5 < c_x < 1:
        raise mirror.line.refuse(
            f"surface {mirror.surface[:20]!r} of a heliostat is not read; f, flat, and p, a"
            " paraboloid of revolution, are"
        )
    return 1 / (2 * c_x)


def _type(kind: tuple[object, ...], optics: Mapping[str, OpticalPair]) -> dict[str, object]:
    width, height, surface, name = kind
    pair = _pair(str(name), optics)
    return {
        "mount": {"kind": "azimuth_elevation"},
        "facets": {"rows": 1, "columns": 1, "width_m": width, "height_m": height},
        "facet_shape": "flat" if surface == "f" else "slant_range",
        "reflectance": pair.reflectivity,
        "slope_error_mrad": pair.slope,
        "pointing_error_mrad": pair.specularity,
    }


def _pair(name: str, optics: Mapping[str, OpticalPair]) -> OpticalPair:
    if name not in optics:
        raise InvalidInputError(f"optical pair {name[:60]!r} is not in the file")
    return optics[name]


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


def _aims(mirrors: Sequence[Element], receiver: Element, sun: Array) -> Array:
    """Points (n, 3) [m] of the receiver to which the sun is reflected.

    On a cylinder it is the nearer of two, and the nearest to its axis if the light misses it.
    """
    origins = np.array([mirror.origin for mirror in mirrors])
    normals = np.array([mirror.axes[2] for mirror in mirrors])
    rays = 2 * (normals @ sun)[:, None] * normals - sun
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
