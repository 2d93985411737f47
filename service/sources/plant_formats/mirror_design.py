"""Mirrors of other programs as designs of plant.yaml: canted, focused, or each facet by itself."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FACET_COLUMNS = ("x_m", "y_m", "z_m", "width_m", "height_m")
NORMAL_COLUMNS = ("normal_x", "normal_y", "normal_z")
FOCUS_COLUMN = "focal_length_m"
MAX_FOCUS = 1e5
"""Focal length [m] beyond which a facet is flat."""


class Tolerance(NamedTuple):
    """Differences of slopes, and relative ones of powers, within which facets are as designed."""

    slope: float = 2e-6
    power: float = 1e-3


@dataclass(frozen=True, eq=False)
class FacetedMirror:
    """A mirror in our mirror coordinates.

    Attributes
    ----------
    centers : (F, 3) [m]
    sides : (F, 2, 3) [m]
        Half width and half height as vectors.
    powers : (F,) [1/m]
        One over the focal lengths of the paraboloids that the facets are; 0 if they are flat.
    """

    centers: Array
    sides: Array
    powers: Array

    @property
    def normals(self) -> Array:
        """Unit normals (F, 3)."""
        return facet_axes(self.sides)[:, 2]

    @property
    def turned(self) -> float:
        """The largest angle [rad] of a facet's side x in the mirror's plane."""
        sides = self.sides[:, 0]
        return float(np.abs(np.arctan2(sides[:, 1], sides[:, 0])).max())


def facet_axes(sides: Array) -> Array:
    """Axes (F, 3 axes, 3) of facets with half sides (F, 2, 3)."""
    x = sides[:, 0] / np.linalg.norm(sides[:, 0], axis=-1, keepdims=True)
    z = np.cross(sides[:, 0], sides[:, 1])
    z = z / np.maximum(np.linalg.norm(z, axis=-1, keepdims=True), 1e-300)
    return np.stack([x, np.cross(z, x), z], axis=1)


class MirrorDesign(NamedTuple):
    """The mirror of a type: lines of its facets' file, and focus and canting as of plant.yaml.

    ``focus`` is a focal length [m], ``flat`` or ``slant_range``.
    """

    lines: tuple[tuple[str, ...], ...]
    focus: float | str
    canting: str

    @property
    def entries(self) -> dict[str, object]:
        """``facet_shape`` and ``canting`` of plant.yaml."""
        is_word = isinstance(self.focus, str)
        shape = self.focus if is_word else {"focal_length_m": self.focus}
        return {"facet_shape": shape, "canting": self.canting}


class PlacedDesign(NamedTuple):
    """A design, and the heliostat's focal length [m] if it needs one."""

    design: MirrorDesign
    focal_length: float | None


def design_of(mirror: FacetedMirror, same: Tolerance = Tolerance()) -> PlacedDesign:
    """The simplest design of a mirror; heliostats that differ in their focal length share one."""
    powers = mirror.powers
    focus, canted = float(powers.mean()), _canting_power(mirror, same)
    if canted is None or np.ptp(powers) > same.power * max(focus, 1e-3):
        return PlacedDesign(_individual(mirror), None)
    canting = "on_axis" if canted else "flat"
    if focus == 0:
        shape: float | str = "flat"
    elif canted == 0 or abs(canted / focus - 1) < same.power:
        shape = "slant_range"
    else:
        shape = _rounded(1 / focus)
    length = canted or focus
    design = MirrorDesign(_lines(mirror, FACET_COLUMNS), shape, canting)
    return PlacedDesign(design, _rounded(1 / length) if length else None)


def _canting_power(mirror: FacetedMirror, same: Tolerance) -> float | None:
    """One over the focal length [m] of on-axis canting; 0 for none, None for another canting."""
    normals, (x, y, z) = mirror.normals, mirror.centers.T
    slopes = np.hypot(normals[:, 0], normals[:, 1]) / normals[:, 2]
    if slopes.max() < same.slope:
        return 0.0
    outer = int(np.hypot(x, y).argmax())
    reach = float(np.hypot(x, y)[outer])
    focus = z[outer] + reach / np.tan(2 * np.arctan(slopes[outer])) if slopes[outer] else np.inf
    if not 0.01 < focus < MAX_FOCUS:
        return None
    ways = np.array([0.0, 0.0, focus]) - mirror.centers
    halves = ways / np.linalg.norm(ways, axis=1, keepdims=True) + [0.0, 0.0, 1.0]
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    return float(1 / focus) if np.abs(halves - normals).max() < same.slope else None


def _individual(mirror: FacetedMirror) -> MirrorDesign:
    focus = (FOCUS_COLUMN,) if mirror.powers.any() else ()
    columns = (*FACET_COLUMNS, *NORMAL_COLUMNS, *focus)
    return MirrorDesign(_lines(mirror, columns), "flat", "individual")


def _lines(mirror: FacetedMirror, columns: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Lines of a facets' file, its column names first; to a micrometre."""
    sizes = 2 * np.linalg.norm(mirror.sides, axis=-1)
    numbers = np.concatenate([mirror.centers, sizes], axis=1)
    lines = [[f"{round(value, 6) + 0.0:.9g}" for value in row] for row in numbers]
    for line, normal, power in zip(lines, mirror.normals, mirror.powers, strict=True):
        if NORMAL_COLUMNS[0] in columns:
            line += [f"{value:.9g}" for value in normal]
        if FOCUS_COLUMN in columns:
            line.append(f"{_rounded(1 / power)}" if power else "")
    return (columns, *map(tuple, lines))


def _rounded(length: float) -> float:
    return float(f"{length:.9g}")
