"""Blocking and shading by neighbours between a mirror and the sun, or between it and its target.

Every mirror is the rectangle of its outline. `Neighbours.obstacles` finds the few rectangles that
may hide a mirror; `clear` computes the free share of each of its samples. A sample that an edge
crosses is divided in proportion, so that the power is a continuous function of the edge's position.

Approximations: the sun is a point. Its disc blurs a shadow's edge by some centimetres between
neighbours, equally to both sides. If the edges of two shadows are in one sample, the larger shadow
counts: those of neighbours in a row, or before the sun and before the target, mostly overlap.

Source: ray casting against the neighbours' outlines as in SolTrace; bounding spheres to exclude
others as in Collado and Guallar, *Campo: Generation of regular heliostat fields*, Renewable Energy
46 (2012).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from model.mount import Mount
from model.plant import Heliostat

Array = NDArray[np.float64]

# Obstacles times samples that are intersected at once: arrays of 0.25 MB, which stay in the cache.
_INTERSECTED = 2**16

# A rectangle out of all light, for mirrors with fewer obstacles than others of their batch [m].
_NOWHERE = np.array([[0.0, 0.0, -1e6], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def outlines(heliostats: Sequence[Heliostat], sun: ArrayLike, aims: ArrayLike) -> Array:
    """Rectangles (N, 3, 3) [m] in ENU of mirrors that reflect the sun (3,) to ``aims`` (N, 3) [m].

    Each is its centre, then half its width and half its height as vectors.

    Raises
    ------
    UnreachableError
        If a mount cannot reach its aim.
    """
    mount = Mount.stack([heliostat.mount for heliostat in heliostats])
    positions = np.array([heliostat.position for heliostat in heliostats])
    attitudes = mount.attitude(mount.align(positions, np.asarray(sun, dtype=np.float64), aims))
    halves = np.array([[heliostat.width, heliostat.height] for heliostat in heliostats]) / 2
    sides = np.swapaxes(attitudes[..., :2], -1, -2) * halves[..., None]
    return np.concatenate([mount.mirror_center(positions, attitudes)[:, None], sides], axis=1)


class Outlines(NamedTuple):
    """Names, `outlines` (n, 3, 3) [m] and aims (n, 3) [m] of mirrors."""

    names: Sequence[str]
    rectangles: Array
    aims: Array


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The mirrors of a field, aligned under one sun.

    Attributes
    ----------
    rows : dict
        Heliostat name to its row in the arrays, which are in the order of the mirrors' easting.
    rectangles : (N, 3, 3) [m]
        As of `outlines`.
    aims : (N, 3) [m]
    sun : (3,)
        Unit vector towards the sun.
    """

    rows: dict[str, int]
    rectangles: Array
    aims: Array
    sun: Array

    @classmethod
    def from_outlines(cls, parts: Iterable[Outlines], sun: ArrayLike) -> "Neighbours":
        """Join the outlines of parts of a field."""
        listed = list(parts)
        names = [name for part in listed for name in part.names]
        rectangles = np.concatenate([np.zeros((0, 3, 3)), *(part.rectangles for part in listed)])
        aims = np.concatenate([np.zeros((0, 3)), *(part.aims for part in listed)])
        order = np.argsort(rectangles[:, 0, 0], kind="stable")
        rows = {names[old]: new for new, old in enumerate(order)}
        return cls(rows, rectangles[order], aims[order], np.asarray(sun, dtype=np.float64))

    @property
    def radii(self) -> Array:
        """Half diagonals (N,) [m]."""
        return np.asarray(np.linalg.norm(self.rectangles[:, 1:], axis=(1, 2)))

    def obstacles(self, names: Sequence[str]) -> Array:
        """Rectangles (B, K, 3, 3) [m] that may hide parts of these heliostats' mirrors, for
        `Scene.obstacles`.

        A heliostat that is not in the field has none.
        """
        radii = self.radii
        top = float((self.rectangles[:, 0, 2] + radii).max(initial=-np.inf))
        return stacked_rectangles(
            [self.rectangles[list(self._before(name, radii, top))] for name in names]
        )

    def _before(self, name: str, radii: Array, top: float) -> Iterator[int]:
        """Rows of mirrors whose spheres intersect the beams from this mirror's sphere."""
        if name not in self.rows:
            return
        row = self.rows[name]
        center, easting = self.rectangles[row, 0], self.rectangles[:, 0, 0]
        outgoing = self.aims[row] - center
        length = float(np.linalg.norm(outgoing))
        for direction, end in ((self.sun, np.inf), (outgoing / length, length)):
            # Above the field's top there are no obstacles.
            climb = (top - center[2] + radii[row]) / direction[2] if direction[2] > 0 else np.inf
            reach = min(end, climb) + 2 * float(radii.max())
            first, last = np.searchsorted(easting, [center[0] - reach, center[0] + reach])
            apart = self.rectangles[first:last, 0] - center
            along = apart @ direction
            aside = (apart**2).sum(axis=1) - along**2
            near = radii[first:last] + radii[row]
            in_the_way = (along > -near) & (along < end) & (aside < near**2)
            yield from (other for other in first + np.flatnonzero(in_the_way) if other != row)


def stacked_rectangles(rectangles: Sequence[Array]) -> Array:
    """Rectangles (B, K, 3, 3) [m] of B mirrors; those that a mirror lacks are out of all light."""
    padded = np.tile(_NOWHERE, (len(rectangles), max([1, *map(len, rectangles)]), 1, 1))
    for row, some in zip(padded, rectangles, strict=True):
        row[: len(some)] = some
    return padded


def clear(obstacles: Tensor, points: Tensor, direction: Tensor, cell: Tensor) -> Tensor:
    """Share (B, S) of the light from mirror points that meets no obstacle along a direction.

    Parameters
    ----------
    obstacles : Tensor (B, K, 3, 3) [m]
        Centre and half sides of rectangles, in the frame of the points.
    points : Tensor (B, 3, S) [m]
    direction : Tensor (B, 3, S) or (B, 3, 1)
    cell : Tensor (B,) [m]
        Width of the patch of the mirror around each point.
    """
    step = max(1, _INTERSECTED // (points.shape[0] * points.shape[-1]))
    parts = (_clear(some, points, direction, cell) for some in torch.split(obstacles, step, dim=1))
    return reduce(torch.minimum, parts)


def _clear(obstacles: Tensor, points: Tensor, direction: Tensor, cell: Tensor) -> Tensor:
    """`clear` of a few obstacles at once."""
    center, right, up = obstacles.unbind(-2)
    length_x, length_y = right.norm(dim=-1), up.norm(dim=-1)
    normal = torch.linalg.cross(right, up)
    # Coordinates in which a rectangle extends from -1 to 1: rows for x, y and the distance from
    # its plane.
    frame = torch.stack(
        [right / length_x[..., None] ** 2, up / length_y[..., None] ** 2, normal], dim=-2
    )
    place = frame @ points[:, None] - frame @ center[..., None]
    moved = frame @ direction[:, None]
    ahead = moved[..., 2, :]
    distance = -place[..., 2, :] / torch.where(
        ahead.abs() < 1e-9, torch.full_like(ahead, 1e-9), ahead
    )
    x, y = (place[..., axis, :] + distance * moved[..., axis, :] for axis in (0, 1))
    hidden = (
        (distance > 0)
        * _covered(x, cell[:, None] / length_x)
        * _covered(y, cell[:, None] / length_y)
    )
    return (1 - hidden).amin(dim=1)


def _covered(x: Tensor, cell: Tensor) -> Tensor:
    """Share (B, K, S), from -1 to 1, of cells of width ``cell`` (B, K) about ``x`` (B, K, S)."""
    share: Tensor = ((1 - x.abs()) / cell[..., None] + 0.5).clamp(0, 1)
    return share
