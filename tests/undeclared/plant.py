"""A generated plant: targets on a tower, heliostats before them, and mirrors as smooth or as rough
as real ones.

A mirror is no spline: each facet's deviation from its place in the plans is a sum of tilts,
bending, a roll of the edges, and waves. Sizes follow what deflectometry shows of 47 heliostats of
the Solar Tower Juelich (in the median 0.5 mm rms of height, 0.25 mm without the tilts, and slopes
of 0.75 mrad) and of a rough one, AA39 (1.15 mm, 0.4 mm).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def unit(vectors: Array) -> Array:
    """Vectors (3,) or (3, n) of length one."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=0))


@dataclass(frozen=True, eq=False)
class Target:
    """A white rectangle: its ``center`` (3,) [m], lit side's ``normal`` (3,), upward direction, and
    size [m].
    """

    name: str
    center: Array
    normal: Array
    up: Array
    width: float
    height: float

    @property
    def axes(self) -> Array:
        """Rows right, up and normal (3, 3) of the target as it is seen from the field."""
        normal = unit(self.normal)
        right = unit(np.cross(self.up, normal))
        return np.array([right, np.cross(normal, right), normal])


NORTH, UPWARDS = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])

TARGETS = (
    Target("lower", np.array([0.0, -3.23, 35.88]), NORTH + [0.005, 0, 0.001], UPWARDS, 8.63, 7.22),
    Target("upper", np.array([0.0, -3.24, 43.10]), NORTH + [0.003, 0, 0.0], UPWARDS, 8.63, 7.21),
)
"""The two calibration targets of the Solar Tower Juelich."""

# --- mirrors
# --------------------------------------------------------------------------------------------------

WAVES = np.array([1.5, 2.25, 3.0])
"""Half waves along a facet; shorter ones would be beyond the splines that deflectometry
is kept in.
"""

TILT, BEND, EDGE, WAVE = 0.6e-3, 0.15e-3, 0.05e-3, 0.12e-3
"""Usual sizes: of tilts [rad]; of bending, of the edges' roll and of the longest waves over half a
facet [m].
"""

SPECTRUM = -1.0
"""Power of the waves' amplitude in their number."""

ROUGH_WITHIN = 150.0
"""Nobody keeps a mirror [m] so rough that its light misses the target."""


def shapes(t: Array) -> tuple[Array, Array]:
    """What surfaces are made of and its slopes, each (n, 7), at ``t`` (n,) in [-1, 1]: 1, t, t^2,
    t^6 and waves.
    """
    phase = np.pi / 2 * np.outer(t + 1, WAVES)
    values = np.column_stack([t**0, t, t**2, t**6, np.cos(phase)])
    return values, np.column_stack(
        [0 * t, t**0, 2 * t, 6 * t**5, -np.pi / 2 * WAVES * np.sin(phase)]
    )


@dataclass(frozen=True, eq=False)
class Facet:
    """A facet: its centre (3,) [m], half its width and half its height as vectors (3,), how it is
    bent (7, 7) [m].
    """

    position: Array
    along: Array
    across: Array
    bending: Array

    @property
    def half(self) -> Array:
        """Half its width and height (2,) [m]."""
        return np.array([np.linalg.norm(self.along), np.linalg.norm(self.across)])

    @property
    def frame(self) -> Array:
        """Columns x, y and normal (3, 3), in mirror coordinates."""
        x, z = unit(self.along), unit(np.cross(self.along, self.across))
        return np.column_stack([x, np.cross(z, x), z])

    def surface(self, u: Array, v: Array) -> tuple[Array, Array, Array]:
        """Heights [m] and slopes along x and y, each (n, m), on the grid ``u`` (n,) by ``v`` (m,)
        in [-1, 1].
        """
        (value_u, slope_u), (value_v, slope_v) = shapes(u), shapes(v)
        by_x, by_y = slope_u @ self.bending @ value_v.T, value_u @ self.bending @ slope_v.T
        return value_u @ self.bending @ value_v.T, by_x / self.half[0], by_y / self.half[1]


@dataclass(frozen=True, eq=False)
class Heliostat:
    """A heliostat: position (3,) [m] and four facets.

    Seen from the front, the facets are upper left, upper right, lower left and lower right. The
    first axis points east, the second is perpendicular to it.
    """

    name: str
    position: Array
    facets: tuple[Facet, ...]
    width: float = 3.22
    height: float = 2.56


def field(count: int, ranges: tuple[float, float], rng: np.random.Generator) -> list[Heliostat]:
    """Heliostats spread over slant ranges [m], evenly in their logarithm."""
    shares = (np.arange(count) + rng.random(count)) / count
    distances = ranges[0] * (ranges[1] / ranges[0]) ** shares
    return [
        _heliostat(f"A{chr(65 + i)}{rng.integers(10, 60)}", d, rng)
        for i, d in enumerate(distances.tolist())
    ]


def _heliostat(name: str, distance: float, rng: np.random.Generator) -> Heliostat:
    """A heliostat in the northern field, canted for the targets, with a random mirror."""
    aim, height, bearing = np.array([0.0, -3.2, 39.5]), 1.75, rng.uniform(-0.75, 0.75)
    level = np.sqrt(distance**2 - (aim[2] - height) ** 2) if distance > aim[2] else 10.0
    position = np.array([level * np.sin(bearing), aim[1] + level * np.cos(bearing), height])
    roughness = rng.uniform(0.7, 1.3)
    if distance < ROUGH_WITHIN and rng.random() < 0.4:
        roughness = rng.uniform(1.8, 3)
    focus = 2 * float(np.linalg.norm(aim - position))
    places = ((-0.8075, 0.6425), (0.8075, 0.6425), (-0.8075, -0.6425), (0.8075, -0.6425))
    return Heliostat(
        name, position, tuple(_facet(place, focus, roughness * _bending(rng)) for place in places)
    )


def _facet(place: Sequence[float], focus: float, bending: Array) -> Facet:
    """A facet that touches, about, a sphere of radius ``focus`` [m]."""
    x, y = place
    along, across = (
        np.array([0.8025, 0.0, 0.8025 * x / focus]),
        np.array([0.0, 0.6375, 0.6375 * y / focus]),
    )
    return Facet(np.array([x, y, 0.0402]), along, across, bending)


def _bending(rng: np.random.Generator) -> Array:
    """A random facet (7, 7) [m] of usual roughness."""
    bending = np.zeros((7, 7))
    number = np.hypot(*np.meshgrid([0, *WAVES], [0, *WAVES])) / WAVES[0]
    number[0, 0] = np.inf
    waves = np.ix_([0, 4, 5, 6], [0, 4, 5, 6])
    bending[waves] = WAVE * number**SPECTRUM * rng.standard_normal((4, 4))
    bending[[1, 0], [0, 1]] = TILT * np.array([0.8025, 0.6375]) * rng.standard_normal(2)
    bending[[2, 1, 0], [0, 1, 2]] = BEND * (rng.standard_normal(3) - [0.8, 0, 0.8])
    bending[[3, 0], [0, 3]] = EDGE * rng.standard_normal(2)
    return bending
