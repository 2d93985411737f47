"""Light thrown ray by ray through a disturbed world.

Written from the physics alone: no effect and no tracer of the model takes part, and attitude,
surface and sun have their own formulas here. A mirror is strewn with points; at each of them the
normal is drawn, and how the mirror swings just then; and each sends on the light of random
directions of the sun's disc and aureole by the law of reflection.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.undeclared.plant import Facet, Heliostat, Target, unit
from tests.undeclared.world import Values, World

Array = NDArray[np.float64]
Rays = NDArray[np.float32]

DISC, AUREOLE = 4.65e-3, 43.6e-3
"""Where the sun's disc and its aureole end [rad]."""

PIVOT = 0.175
"""From the mount's pivot to the mirror's centre [m]."""

MEASURED_AT = np.radians(30.0)
"""Elevation of the normal at which mirrors were measured, under their own weight."""

TUBE = 0.4
"""Sag of a mirror's left and right edges, which the torque tube bears, to that of the upper and
lower ones.
"""

CAMERA = (0.0, 15.0, 40.0)
"""Where the camera is: right, up and in front of each target [m]."""

CHUNK = 1024
"""Mirror points whose rays are traced at a time: what fits into a core's cache."""


# --- sun
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sun:
    """Random directions near +z (3, n), and the light (n,) of each.

    A quarter of them lie in the aureole, however little light that has, so that faint tails are
    smooth as well.
    """

    directions: Rays
    light: Rays

    @classmethod
    def of(
        cls, ratio: float, clouded: float, rng: np.random.Generator, count: int = 1 << 20
    ) -> "Sun":
        """Buie's sun (Buie, Monger, Dey, Solar Energy 74 (2003), eqs. 6 to 9), half of it
        ``clouded`` by a share.
        """
        shares = np.array([3 * count // 4, count // 4])
        rings = np.linspace(0, DISC, 2001), np.geomspace(DISC, AUREOLE, 4001)
        thrown = [
            _ring(edges, ratio, share, rng) for edges, share in zip(rings, shares, strict=True)
        ]
        energy = np.array([ring[0] for ring in thrown])
        light = np.repeat(energy / energy.sum() * count / shares, shares)
        angle, turn = np.concatenate([ring[1] for ring in thrown]), rng.uniform(0, 2 * np.pi, count)
        directions = np.array(
            [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
        )
        light *= 1 - clouded * (directions[0] > 0)
        order = rng.permutation(count)
        return cls(directions[:, order].astype(np.float32), light[order].astype(np.float32))


def _ring(edges: Array, ratio: float, count: int, rng: np.random.Generator) -> tuple[float, Array]:
    """Energy between the first and the last of ``edges`` [rad], and random angles (count,) that
    share it evenly.
    """
    theta = 1e3 * (edges[1:] + edges[:-1]) / 2
    if edges[-1] <= DISC:
        radiance = np.cos(0.326 * theta) / np.cos(0.308 * theta)
    else:
        kappa = 0.9 * np.log(13.5 * ratio) * ratio**-0.3
        gamma = 2.2 * np.log(0.52 * ratio) * ratio**0.43 - 0.1
        radiance = np.exp(kappa) * theta**gamma
    energy = np.concatenate([[0.0], np.cumsum(radiance * theta * np.diff(edges))])
    return float(energy[-1]), np.interp(rng.random(count) * energy[-1], energy, edges)


# --- mirror
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Points:
    """Mirror points (3, n) [m], area vectors (3, n) [m2] and the facets (n,) that they lie on."""

    places: Array
    areas: Array
    facets: NDArray[np.int64]

    def bent(self, hessian: Array) -> "Points":
        """With z raised by the quadratic form of ``hessian`` (2, 2) [1/m] over the mirror."""
        return Points(*_bent(self.places, self.areas, hessian), self.facets)


def _bent(places: Array, areas: Array, hessian: Array) -> tuple[Array, Array]:
    slopes = hessian @ places[:2]
    rise = (places[:2] * slopes).sum(axis=0) / 2
    return np.vstack([places[:2], places[2] + rise]), np.vstack(
        [areas[:2] - areas[2] * slopes, areas[2]]
    )


def _facet(
    facet: Facet, tilt: Array, curvature: float, seal: float, u: Array, v: Array
) -> tuple[Array, Array]:
    """Points and area vectors of a facet in mirror coordinates at the grid ``u`` by ``v``; ``tilt``
    (2,) and the slope ``seal`` at its edges [rad].
    """
    heights, by_x, by_y = (values.ravel() for values in facet.surface(u, v))
    edge_x, edge_y = np.meshgrid(u**9, v**9, indexing="ij")
    by_x, by_y = by_x + seal * edge_x.ravel(), by_y + seal * edge_y.ravel()
    x, y = (
        axis.ravel() for axis in np.meshgrid(u * facet.half[0], v * facet.half[1], indexing="ij")
    )
    cell = 4 * facet.half.prod() / (len(u) * len(v))
    areas = cell * np.array([-by_x, -by_y, np.ones_like(x)])
    places, areas = _bent(np.array([x, y, heights]), areas, curvature * np.eye(2))
    turn = facet.frame @ Rotation.from_rotvec([tilt[1], -tilt[0], 0.0]).as_matrix()
    return turn @ places + facet.position[:, None], turn @ areas


# --- the mirror before the sun
# ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Exposure:
    """One heliostat of a world, its ``index`` there, as it throws its light onto ``goal`` (3,) [m]
    on a target.

    ``sun`` (3,) is the true one; ``warmth`` says by how many standard deviations the day is warmer
    than usual.
    """

    world: World
    index: int
    heliostat: Heliostat
    sun: Array
    target: Target
    goal: Array
    warmth: float = 0.0

    def mirror(self, side: int, rng: np.random.Generator | None = None) -> Points:
        """Points of the mirror at rest, in its own coordinates, ``side`` squared a facet in even
        cells.
        """
        tilts = 1e-3 * self._own(self.world.canting_mrad, 4, 2)
        upper = np.array([1.0, 1.0, 0.0, 0.0])
        curvatures = self._own(self.world.curvature, 4) + upper * self.world.row_focus * self.warmth
        parts = []
        for part in zip(self.heliostat.facets, tilts, curvatures, strict=True):
            u, v = (
                2 * (np.arange(side) + (0.5 if rng is None else rng.random(side))) / side - 1
                for _ in "uv"
            )
            parts.append(_facet(*part, 1e-3 * self.world.seal_mrad, u, v))
        places, areas = (np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))
        places[:2] += self.world.gap_m / 2 * np.sign(places[:2])
        twist = 1e-3 * self.world.twist_mrad_m * self.warmth
        return Points(places, areas, np.repeat(np.arange(4), side**2)).bent(
            twist * np.array([[0.0, 1], [1, 0]])
        )

    def light(self, points: Points) -> Array:
        """Share (n,) of the light that points reflect and that nothing takes away."""
        height = self.heliostat.height + self.world.gap_m
        line = (self._own(self.world.hidden) - 0.5) * height
        light = self._own(self.world.reflectivity, 4)[points.facets] * (points.places[1] >= line)
        middles = np.array([facet.position[1] for facet in self.heliostat.facets])
        halves = np.array([facet.half[1] for facet in self.heliostat.facets])
        lower = points.places[1] < (middles - halves / 3)[points.facets]
        return np.asarray(light * (1 - self.world.dew * lower))

    def _own(self, values: Values, *shape: int) -> Array:
        """What belongs to this heliostat of a disturbance."""
        array = np.asarray(values)
        return np.broadcast_to(array[self.index] if array.ndim else array, shape)

    @property
    def ground(self) -> Rotation:
        """How the ground is turned: about north, then about up."""
        return Rotation.from_euler("yz", self.world.tilt_deg, degrees=True)

    @property
    def first_axis(self) -> Array:
        """Where the first axis, east by the plans, really points, but for the pylon's lean."""
        return self.ground.apply([1.0, 0.0, 0.0])

    def leaning(self, normal: Array) -> Rotation:
        """How a mirror that faces ``normal`` (3,), which hangs before its pylon, pulls
        that over.
        """
        return Rotation.from_rotvec(
            1e-3 * self.world.pylon_mrad * np.cross([0.0, 0.0, 1.0], normal)
        )

    def encoders(self, pose: "Pose") -> Array:
        """What the encoders of both axes (2,) [rad] say; zeros where the mirror faces south by the
        plans, upright.
        """
        normal = pose.attitude[:, 2]
        east, north, up = self.ground.inv().apply(self.leaning(normal).inv().apply(normal))
        return np.array([np.arctan2(-up, -north), np.arcsin(east)]) - np.radians(
            self._own(self.world.encoder_deg, 2)
        )

    def facing(self, aim: Array) -> "Pose":
        """The mirror turned so that its centre sends the sun to ``aim`` (3,) [m]."""
        center = self.heliostat.position
        for _ in range(5):
            normal = unit(self.sun + unit(aim - center))
            center = self.heliostat.position + PIVOT * normal
        # The second axis, perpendicular to the first, is the mirror's own upward direction.
        upward = unit(np.cross(normal, self.leaning(normal).apply(self.first_axis)))
        return Pose(np.column_stack([np.cross(upward, normal), upward, normal]), center)

    def sagging(self, points: Points, pose: "Pose") -> Points:
        """Points of a mirror whose edges hang by the share of its weight that presses on it more
        than when measured.
        """
        pressing = pose.attitude[2, 2] - np.sin(MEASURED_AT)
        edges = np.array([self.heliostat.width, self.heliostat.height]) / 2
        return points.bent(-2e-3 * self.world.sag_mm * pressing * np.diag([TUBE, 1.0] / edges**2))

    def stand(self) -> "Pose":
        """The pose in which the centre of mass of the light lies at the goal."""
        points, aim, axes = self.mirror(16), self.goal, self.target.axes
        light = self.light(points)
        for _ in range(6):
            pose = self.facing(aim)
            bent = self.sagging(points, pose)
            places, areas = (axes @ a for a in pose.in_sight(bent, self.target))
            sun = (axes @ self.sun)[:, None]
            weight = light * (areas * sun).sum(axis=0)
            right, up = land(places, reflected(unit(areas), sun)) @ weight / weight.sum()
            miss = axes @ (self.goal - self.target.center) - [right, up, 0.0]
            aim = aim + miss[:2] @ axes[:2]
        return pose


@dataclass(frozen=True, eq=False)
class Pose:
    """Mirror coordinates to east-north-up (3, 3), and the mirror's centre (3,) [m]."""

    attitude: Array
    center: Array

    def in_sight(self, points: Points, target: Target) -> tuple[Array, Array]:
        """Points [m] from the target's centre and area vectors, each (3, n), in east-north-up."""
        return (
            self.attitude @ points.places + (self.center - target.center)[:, None],
            self.attitude @ points.areas,
        )


def reflected(normals: Array, suns: Array) -> Array:
    """Directions (3, n) of light that comes from ``suns`` (3, n)."""
    return np.asarray(2 * (normals * suns).sum(axis=0) * normals - suns)


def land(places: Array, directions: Array) -> Array:
    """Where light from ``places`` (3, n) meets the plane z = 0, (2, n)."""
    return np.asarray(places[:2] - places[2] / directions[2] * directions[:2])


def throw(
    exposure: Exposure, sun: Sun, side: int, fan: int, rng: np.random.Generator
) -> Iterator[tuple[Rays, Rays]]:
    """Hits (2, n) [m], right and up of the target's centre, and their light (n,), some thousand at
    a time.

    ``side`` squared points a facet send on ``fan`` rays each.
    """
    places, normals, weight = _swung(exposure, side, rng)
    toward = exposure.target.axes @ exposure.sun
    across = unit(np.cross(toward, [1.0, 0.0, 0.0]))
    frame = np.column_stack([across, np.cross(toward, across), toward])
    # Reflection of directions about the sun, point by point: 2 n n^T - 1.
    mirrors = (2 * np.einsum("in,jn->nij", normals, normals) - np.eye(3)) @ frame
    order = rng.permutation(len(weight))
    for start in range(0, len(order), CHUNK):
        some = order[start : start + CHUNK]
        first = rng.integers(sun.light.size - len(some) * fan)
        chosen = slice(first, first + len(some) * fan)
        suns = sun.directions[:, chosen].reshape(3, len(some), fan).transpose(1, 0, 2)
        if exposure.world.flattened:
            suns = _flattened(suns, exposure, frame)
        out = mirrors[some].astype(np.float32) @ suns
        hits = land(places[:, some, None].astype(np.float32), out.transpose(1, 0, 2))
        light = weight[some, None].astype(np.float32) * sun.light[chosen].reshape(len(some), fan)
        if exposure.world.gloss:
            light = light * (1 + exposure.world.gloss * _gloss(hits, out.transpose(1, 0, 2)))
        yield hits.reshape(2, -1), light.ravel()


def _flattened(suns: Rays, exposure: Exposure, frame: Array) -> Rays:
    """Directions (n, 3, m) of a sun that is flattened upwards, in the ``frame`` (3, 3)."""
    low = np.exp(-np.degrees(np.arcsin(exposure.sun[2])) / 40)
    up = unit((exposure.target.axes @ [0.0, 0.0, 1.0]) @ frame[:, :2])
    rise = np.einsum("d,ndm->nm", up, suns[:, :2])
    pressed = suns.copy()
    pressed[:, :2] -= (exposure.world.flattened * low * up[:, None] * rise[:, None]).astype("f4")
    return pressed


def _gloss(hits: Rays, directions: Rays) -> Rays:
    """Share (n, m) by which light (3, n, m) at hits (2, n, m) [m] shines to the camera."""
    sight = np.stack([-hits[0], CAMERA[1] - hits[1], np.full_like(hits[0], CAMERA[2])])
    sight /= np.linalg.norm(sight, axis=0)
    mirrored = directions * np.array([1, 1, -1], dtype=np.float32)[:, None, None]
    return np.asarray((mirrored * sight).sum(axis=0).clip(min=0) ** 40)


def _swung(exposure: Exposure, side: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Places (3, n) [m], normals (3, n) and collected light (n,) of mirror points in the target's
    frame.
    """
    world, pose, axes = exposure.world, exposure.stand(), exposure.target.axes
    points = exposure.sagging(exposure.mirror(side, rng), pose)
    places, areas = (axes @ a for a in pose.in_sight(points, exposure.target))
    weight = exposure.light(points) * (areas * (axes @ exposure.sun)[:, None]).sum(axis=0).clip(
        min=0
    )
    count = weight.size
    swings = [
        (exposure.first_axis, world.first_axis_mrad),
        (pose.attitude[:, 1], world.second_axis_mrad),
    ]
    swing = 1e-3 * sum(
        np.outer(axes @ axis, sigma * rng.standard_normal(count)) for axis, sigma in swings
    )
    center = (axes @ (pose.center - exposure.target.center))[:, None]
    normals = unit(areas)
    normals = unit(
        normals
        + np.cross(swing, normals, axis=0)
        + 1e-3 * world.roughness_mrad * rng.standard_normal((3, count))
    )
    return places + np.cross(swing, places - center, axis=0), normals, weight
