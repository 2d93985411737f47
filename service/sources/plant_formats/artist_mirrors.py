"""Mirrors of ARTIST as designs of plant.yaml: canted, focused, or measured.

ARTIST's facets have a place, half sides and control points. If all heights of a mirror are zero,
ARTIST moves and cants the facets. Otherwise the control points are in mirror coordinates.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.mount import Mount
from model.plant import Facet, Heliostat
from model.surface import control_points, evaluate, heights, nominal_heights
from service.sources.plant_formats.imported import MeasuredSurface

Array = NDArray[np.float64]

FACET_COLUMNS = ("x_m", "y_m", "z_m", "width_m", "height_m")
NORMAL_COLUMNS = ("normal_x", "normal_y", "normal_z")
FOCUS_COLUMN = "focal_length_m"

# Differences within which a mirror is as designed; ARTIST's files are in single precision.
_SAME_HEIGHT = 2e-6  # [m], of deviations from a plane or a paraboloid
_SAME_PLACE = 1e-4  # [m], of points
_SAME_SLOPE = 2e-6
_SAME_POWER = 1e-3  # relative
_MAX_FOCUS = 1e5  # [m]; beyond it a facet is flat
_TURNED = 1e-3  # slope of a facet's horizontal side within the mirror


@dataclass(frozen=True, eq=False)
class ArtistMirror:
    """A mirror in our mirror coordinates.

    Attributes
    ----------
    centers : (F, 3) [m]
    sides : (F, 2, 3) [m]
        Half width and half height as vectors.
    points : (F, I, J, 3) [m]
        Control points; I along x, J along y.
    degree : int
    powers : (F,) [1/m]
        One over the focal lengths of the paraboloids that the facets are; 0 if they are flat.
    is_measured : bool
        Whether the facets are neither flat nor paraboloids.
    """

    centers: Array
    sides: Array
    points: Array
    degree: int
    powers: Array
    is_measured: bool

    @classmethod
    def of(
        cls, centers: Array, sides: Array, points: Array, degree: int, turn: Array
    ) -> "ArtistMirror":
        """The mirror of ARTIST's numbers; ``turn`` (3, 3) leads from our coordinates to ARTIST's.

        Raises
        ------
        InvalidInputError
            If sides span nothing, or a facet is turned in the mirror's plane.
        """
        lengths = np.linalg.norm(sides, axis=-1)
        if not ((lengths > 0.005) & (lengths < 50)).all():
            raise InvalidInputError("'canting' must be half sides of 0.005 to 50 m")
        if not np.abs(points[..., 2]).max() > 0:
            axes = _axes(sides)
            points = centers[:, None, None] + np.einsum("fijc,fcd->fijd", points, axes)
        if turn[0, 0] == 0:
            sides = np.stack([-sides[:, 1], sides[:, 0]], axis=1)
        centers, sides, points = centers @ turn, sides @ turn, _ordered(points @ turn)
        across = np.abs(sides[:, 0, 1]) / lengths.max()
        if across.max() > _TURNED or (sides[:, [0, 1], [0, 1]] <= 0).any():
            raise InvalidInputError(
                "'canting' has a facet that is turned in the mirror's plane; plant.yaml's have"
                " their sides along x and y"
            )
        return cls(centers, sides, points, degree, *_focus(centers, sides, points, degree))

    @property
    def surface(self) -> MeasuredSurface:
        """Control points and degree."""
        return MeasuredSurface(self.points, self.degree)

    @property
    def normals(self) -> Array:
        """Unit normals (F, 3)."""
        return _axes(self.sides)[:, 2]


def _axes(sides: Array) -> Array:
    """Axes (F, 3 axes, 3) of facets."""
    x = sides[:, 0] / np.linalg.norm(sides[:, 0], axis=-1, keepdims=True)
    z = np.cross(sides[:, 0], sides[:, 1])
    z = z / np.maximum(np.linalg.norm(z, axis=-1, keepdims=True), 1e-300)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _ordered(points: Array) -> Array:
    """Control points (F, I, J, 3) with I along x and J along y."""
    along = (points[:, -1] - points[:, 0]).mean(axis=(0, 1))
    if abs(along[1]) > abs(along[0]):
        points = points.swapaxes(1, 2)
    if (points[:, -1] - points[:, 0])[..., 0].mean() < 0:
        points = points[:, ::-1]
    if (points[:, :, -1] - points[:, :, 0])[..., 1].mean() < 0:
        points = points[:, :, ::-1]
    return points


class _Focus(NamedTuple):
    """Powers (F,) [1/m] of the paraboloids that facets are, or whether there are none."""

    powers: Array
    is_measured: bool


def _focus(centers: Array, sides: Array, points: Array, degree: int) -> _Focus:
    facets = tuple(Facet(c, s[0], s[1]) for c, s in zip(centers, sides, strict=True))
    flat = Heliostat("mirror", np.zeros(3), Mount.azimuth_elevation(), facets)
    z = heights(flat, points, degree)
    # Heights of paraboloids of focal length one.
    unit = _focused(flat, 1.0)
    powers = (unit * z).sum(axis=(1, 2)) / (unit**2).sum(axis=(1, 2))
    powers[np.abs(powers) < 1 / _MAX_FOCUS] = 0.0
    fitted = powers[:, None, None] * unit
    edges = np.linspace(0, 1, 9)
    nominal = evaluate(control_points(flat, fitted), edges, edges).points
    apart = nominal - evaluate(points, edges, edges, degree).points
    is_measured = bool(
        np.abs(z - fitted).max() > _SAME_HEIGHT
        or np.abs(apart).max() > _SAME_PLACE
        or (powers < 0).any()
    )
    return _Focus(np.zeros(len(powers)) if is_measured else powers, is_measured)


def _focused(mirror: Heliostat, focal_length: float) -> Array:
    """Heights (F, 8, 8) [m] of a mirror whose facets have a focal length [m]."""
    facets = tuple(replace(facet, focal_length=focal_length) for facet in mirror.facets)
    return nominal_heights(replace(mirror, facets=facets))


# --- designs
# --------------------------------------------------------------------------------------------------


class MirrorDesign(NamedTuple):
    """The mirror of a type: lines of its facets' file, and focus and canting as of plant.yaml.

    ``focus`` is a focal length [m], ``flat`` or ``slant_range``.
    """

    lines: tuple[tuple[str, ...], ...]
    focus: float | str
    canting: str


class PlacedDesign(NamedTuple):
    """A design, and the heliostat's focal length [m] if it needs one."""

    design: MirrorDesign
    focal_length: float | None


def design_of(mirror: ArtistMirror) -> PlacedDesign:
    """The simplest design of a mirror; heliostats that differ in their focal length share one."""
    powers = mirror.powers
    focus, canted = float(powers.mean()), _canting_power(mirror)
    if canted is None or np.ptp(powers) > _SAME_POWER * max(focus, 1e-3):
        return PlacedDesign(_individual(mirror), None)
    canting = "on_axis" if canted else "flat"
    if focus == 0:
        shape: float | str = "flat"
    elif canted == 0 or abs(canted / focus - 1) < _SAME_POWER:
        shape = "slant_range"
    else:
        shape = _rounded(1 / focus)
    length = canted or focus
    design = MirrorDesign(_lines(mirror, FACET_COLUMNS), shape, canting)
    return PlacedDesign(design, _rounded(1 / length) if length else None)


def _canting_power(mirror: ArtistMirror) -> float | None:
    """One over the focal length [m] of on-axis canting; 0 for none, None for another canting."""
    normals, (x, y, z) = mirror.normals, mirror.centers.T
    slopes = np.hypot(normals[:, 0], normals[:, 1]) / normals[:, 2]
    if slopes.max() < _SAME_SLOPE:
        return 0.0
    outer = int(np.hypot(x, y).argmax())
    reach = float(np.hypot(x, y)[outer])
    focus = z[outer] + reach / np.tan(2 * np.arctan(slopes[outer])) if slopes[outer] else np.inf
    if not 0.01 < focus < _MAX_FOCUS:
        return None
    ways = np.array([0.0, 0.0, focus]) - mirror.centers
    halves = ways / np.linalg.norm(ways, axis=1, keepdims=True) + [0.0, 0.0, 1.0]
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    return float(1 / focus) if np.abs(halves - normals).max() < _SAME_SLOPE else None


def _individual(mirror: ArtistMirror) -> MirrorDesign:
    focus = (FOCUS_COLUMN,) if mirror.powers.any() else ()
    columns = (*FACET_COLUMNS, *NORMAL_COLUMNS, *focus)
    return MirrorDesign(_lines(mirror, columns), "flat", "individual")


def _lines(mirror: ArtistMirror, columns: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
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
