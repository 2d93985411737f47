"""Monte Carlo simulation of a field of heliostats with shading and blocking.

It shares no code with the tracers under test. Every ray starts at a random point of a random facet.
It comes from a random point of a uniform sun (a pillbox) and is reflected exactly. It is lost if
the outline of another mirror is in its way, before or after the reflection. The simulation uses the
geometry of a heliostat (`model.plant`) and no other code of the model: numpy, brute force.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from model.plant import Cylinder, Heliostat, TargetPlane

Array = NDArray[np.float64]
Land = Callable[[Array, Array], tuple[Array, Array, Array]]
"""Right and up [m] on a map where rays (n, 3) from points (n, 3) meet the receiver, and whether
they do.
"""

PIVOT = 0.175
DNI = 1000.0


def unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def pose(heliostat: Heliostat, sun: Array, aim: Array) -> tuple[Array, Array]:
    """Centre (3,) and axes right, up, normal (3, 3) of a Juelich mirror: first axis east, second
    upright in it.
    """
    center = heliostat.position
    for _ in range(6):
        normal = unit(sun + unit(aim - center))
        center = heliostat.position + PIVOT * normal
    up = unit(np.cross(normal, [1.0, 0.0, 0.0]))
    return center, np.array([np.cross(up, normal), up, normal])


def onto_plane(plane: TargetPlane) -> Land:
    right = np.cross(plane.up, plane.normal)

    def land(start: Array, ray: Array) -> tuple[Array, Array, Array]:
        distance = (plane.center - start) @ plane.normal / (ray @ plane.normal)
        place = start + distance[:, None] * ray - plane.center
        return place @ right, place @ plane.up, (distance > 0) & (ray @ plane.normal < 0)

    return land


def onto_cylinder(cylinder: Cylinder) -> Land:
    """Right counts the arc from the middle, up the height; only the outside is lit, where a ray
    meets it first.
    """
    right = np.cross(cylinder.up, cylinder.normal)
    axis = cylinder.center - cylinder.radius * cylinder.normal
    frame = np.array([cylinder.normal, right])

    def land(start: Array, ray: Array) -> tuple[Array, Array, Array]:
        p, d = (start - axis) @ frame.T, ray @ frame.T
        a, b, c = (d**2).sum(1), (p * d).sum(1), (p**2).sum(1) - cylinder.radius**2
        root = np.sqrt(np.maximum(b**2 - a * c, 0))
        first = (-b - root) / a
        place = p + first[:, None] * d
        up = (start + first[:, None] * ray - axis) @ cylinder.up
        return (
            cylinder.radius * np.arctan2(place[:, 1], place[:, 0]),
            up,
            (b**2 > a * c) & (first > 0),
        )

    return land


def trace_field(
    heliostats: Sequence[Heliostat],
    sun: Array,
    aim: Array,
    land: Land,
    size: tuple[float, float],
    bins: tuple[int, int],
    *,
    half_angle: float,
    rays: int,
    seed: int,
    shadows: bool = True,
) -> tuple[Array, Array]:
    """Irradiance (rows, columns) [W/m2] on a map of ``size`` (width, height) [m], and power (N,)
    [W] of each mirror.

    ``rays`` a mirror; power is what leaves the field towards the receiver, whether it meets it or
    not.
    """
    rng = np.random.default_rng(seed)
    poses = [pose(heliostat, sun, aim) for heliostat in heliostats]
    total, powers = np.zeros(bins), np.zeros(len(heliostats))
    for index, heliostat in enumerate(heliostats):
        center, axes = poses[index]
        facets = rng.integers(len(heliostat.facets), size=rays)
        x, y = rng.uniform(-1, 1, (2, rays, 1))
        half_x, half_y, middle = (
            np.array([getattr(facet, name) for facet in heliostat.facets]) @ axes
            for name in ("canting_x", "canting_y", "position")
        )
        start = center + middle[facets] + x * half_x[facets] + y * half_y[facets]
        area = np.cross(2 * half_x, 2 * half_y)[facets]
        toward = _sun_points(sun, half_angle, rays, rng)
        light = np.clip((area * toward).sum(1), 0, None) * len(heliostat.facets) / rays * DNI
        normal = unit(area)
        out = 2 * (normal * toward).sum(1, keepdims=True) * normal - toward
        if shadows:
            for other, neighbour in enumerate(heliostats):
                if other != index:
                    light *= ~_meets(start, toward, poses[other], neighbour)
                    light *= ~_meets(start, out, poses[other], neighbour)
        powers[index] = light.sum()
        right, up, lands = land(start, out)
        columns, rows = ((right / size[0] + 0.5) * bins[1], (0.5 - up / size[1]) * bins[0])
        lands &= (columns >= 0) & (columns < bins[1]) & (rows >= 0) & (rows < bins[0])
        np.add.at(total, (rows[lands].astype(int), columns[lands].astype(int)), light[lands])
    return total * bins[0] * bins[1] / (size[0] * size[1]), powers


def _sun_points(sun: Array, half_angle: float, rays: int, rng: np.random.Generator) -> Array:
    """Directions (n, 3) to points even over a small disc about the sun's centre."""
    first = unit(np.cross(sun, [1.0, 0.0, 0.0]))
    second = np.cross(sun, first)
    radius, turn = half_angle * np.sqrt(rng.random(rays)), rng.uniform(0, 2 * np.pi, rays)
    return unit(
        sun + np.outer(radius * np.cos(turn), first) + np.outer(radius * np.sin(turn), second)
    )


def _meets(
    start: Array, ray: Array, placement: tuple[Array, Array], heliostat: Heliostat
) -> NDArray[np.bool_]:
    """Whether rays (n, 3) from points (n, 3) meet the outline of a mirror.

    ``placement`` is its centre, and its right, up and normal directions.
    """
    center, (right, up, normal) = placement
    distance = (center - start) @ normal / (ray @ normal)
    place = start + distance[:, None] * ray - center
    inside = (np.abs(place @ right) < heliostat.width / 2) & (
        np.abs(place @ up) < heliostat.height / 2
    )
    return inside & (distance > 0)
