"""Alignment by the spot: turn a heliostat until its spot's centre of mass lies where it was measured.

What is measured is the centre of the light that a target shows. Of a spot that runs over the target's edge this is not
the centre of all its light: the mirror is turned until the part on the target has its centre there. For that part each
ray is taken for a round Gaussian as wide as the sun.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from model.errors import UnreachableError
from model.mount import Mount
from model.plant import Heliostat, TargetPlane
from model.surface import DEGREE
from model.tracing.convolution import Rays, central_rays
from model.tracing.scene import Scene

Array = NDArray[np.float64]

ROUNDS = 4
"""The spot follows the aim almost one to one, so that each round leaves a tenth of the error, or much less."""

TOLERANCE = 1e-5
"""Distance [m] of the spots from where they shall lie at which the alignment ends."""

CONE = 2.4e-3
"""Deviation [rad] along one axis of the light about a ray: the sun's disc (half its radius) and a good mirror's slopes.

Where the target ends only its order of magnitude matters.
"""

NEWTON, STEP, LEAST_SLOPE, MISSED = 20, 1e-3, 0.05, 1e-3
"""Newton's steps, the difference [m] for their slopes, the slope that is taken at least, and the distance [m] up to
which a place counts as reached."""

REACH = 4.0
"""Deviations within which a ray's light ends: a spot farther from its target's edges is whole."""

WHOLE = 2e-3
"""Share of a spot's light beside the target up to which the spot counts as whole."""


class Alignment(NamedTuple):
    """Axis angles (B, 2) [rad], the points (B, 3) [m] in ENU that the mirrors' centres aim at, and the aligned scene.

    The scene is in double precision and without what ``alter`` changes. ``cut`` (B,) tells which spots run over their
    target's edge.
    """

    angles: Array
    aims: Array
    scene: Scene
    cut: NDArray[np.bool_]


def align_to_spots(
    heliostats: Sequence[Heliostat],
    control_points: Sequence[ArrayLike],
    suns: ArrayLike,
    planes: Sequence[TargetPlane],
    spots: ArrayLike,
    *,
    degree: int = DEGREE,
    samples: int = 12,
) -> Array:
    """Axis angles (B, 2) [rad] at which the light that targets show has its centres on the ``spots`` (B, 3) [m] in ENU.

    Canting and waviness move the spot off the point that the mirror's centre aims at; motor positions are good to
    about a degree before a kinematic calibration. The measured spot is better than both.

    Parameters
    ----------
    heliostats, planes : sequences of length B
    control_points : B arrays (F, I, J, 3) [m]
        In mirror coordinates.
    suns : array_like (B, 3)
    spots : array_like (B, 3) [m]

    Raises
    ------
    UnreachableError
        Where no attitude reflects the sun there.
    """
    return align_scene(heliostats, control_points, suns, planes, spots, degree=degree, samples=samples).angles


def align_scene(
    heliostats: Sequence[Heliostat],
    control_points: Sequence[ArrayLike],
    suns: ArrayLike,
    planes: Sequence[TargetPlane],
    spots: ArrayLike,
    *,
    degree: int = DEGREE,
    samples: int = 12,
    start: ArrayLike | None = None,
    alter: Callable[[Scene], Scene] | None = None,
) -> Alignment:
    """As `align_to_spots`, of mirrors that ``alter`` changes once they are aligned (by gravity, say).

    ``start`` (B, 3) [m] are aims to begin with in place of the spots: those of an alignment that differs little save
    rounds.
    """
    goal, directions = np.asarray(spots, dtype=np.float64), np.asarray(suns, dtype=np.float64)
    aims = goal.copy() if start is None else np.array(start, dtype=np.float64)
    positions = np.array([heliostat.position for heliostat in heliostats])
    mount = Mount.stack([heliostat.mount for heliostat in heliostats])
    angles = mount.align(positions, directions, aims)
    scene = Scene.build(heliostats, control_points, angles, directions, planes, degree=degree, dtype=torch.float64)
    center, axes = scene.plane_center.numpy(), scene.plane_axes[:, :2].numpy()
    places = torch.as_tensor(np.einsum("bij,bj->bi", axes, goal - center))
    halves = torch.as_tensor([(plane.width / 2, plane.height / 2) for plane in planes], dtype=torch.float64)
    for _ in range(ROUNDS):
        with torch.no_grad():
            light = _Light.of(central_rays(scene if alter is None else alter(scene), samples), halves)
            missed, share = light.way_to(places)
        if not np.isfinite(missed).all():
            raise UnreachableError("a mirror sends no light to its target, so that its spot has no place")
        if np.abs(missed).max() < TOLERANCE:
            break
        aims += np.einsum("bi,bij->bj", missed, axes)
        angles = mount.align(positions, directions, aims)
        attitude = mount.attitude(angles)
        turned = {"attitude": attitude, "center": mount.mirror_center(positions, attitude)}
        scene = scene.with_(**{name: torch.as_tensor(values) for name, values in turned.items()})
    return Alignment(angles, aims, scene, share < 1 - WHOLE)


class _Light(NamedTuple):
    """Light about rays on targets: ``hits`` (B, 2, S) [m], ``power`` (B, S), ``spot``, ``width``, ``half`` (B, 2) [m].

    Right and up of the targets' centres; ``spot`` is the centre of all of it, ``width`` the deviation about each ray,
    ``half`` half of a target's size.
    """

    hits: Tensor
    power: Tensor
    spot: Tensor
    width: Tensor
    half: Tensor

    @classmethod
    def of(cls, rays: Rays, half: Tensor) -> "_Light":
        """That of traced rays."""
        slope = rays.direction[:, :2] / rays.direction[:, 2:]
        width = CONE * rays.slant_range[:, None] * (1 + slope**2).sqrt()
        return cls(rays.hits, rays.power, rays.spot, width, half)

    def shown(self, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Centre (B, 2) [m] and share (B,) of what the targets show of the light, shifted by ``shift`` (B, 2) [m]."""
        hits, width, half = self.hits + shift[..., None], self.width[..., None], self.half[..., None]
        low, high = (-half - hits) / width, (half - hits) / width
        within = torch.special.ndtr(high) - torch.special.ndtr(low)
        moment = hits * within + width * (_density(low) - _density(high))
        shown = (self.power * within.prod(dim=1)).sum(-1, keepdim=True)
        center = (self.power[:, None] * moment * within.flip(1)).sum(-1) / shown
        return center, shown[:, 0] / self.power.sum(-1)

    def way_to(self, places: Tensor) -> tuple[Array, Array]:
        """Shifts (B, 2) [m] that bring the centres of what is shown to ``places`` (B, 2) [m], and the shares (B,) then.

        Where no shift does, as for a place beside the target: those that bring all light's there.
        """
        shift = places - self.spot
        share = torch.ones_like(shift[:, 0])
        margin = self.half[..., None] - (self.hits + shift[..., None]).abs()
        edge = (margin < REACH * self.width[..., None]).flatten(1).any(dim=1)
        if bool(edge.any()):
            light = _Light(*(part[edge] for part in self))
            found, shown, missed = light._newton(shift[edge], places[edge])
            reached = missed < MISSED
            shift[edge] = torch.where(reached[:, None], found, shift[edge])
            share[edge] = torch.where(reached, shown, share[edge])
        return shift.numpy(), share.numpy()

    def _newton(self, shift: Tensor, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Shifts, shares then, and by how much (B,) [m] places are missed, by Newton's method along each axis."""
        for _ in range(NEWTON):
            center, share = self.shown(shift)
            missed = places - center
            if not bool((missed.abs() > TOLERANCE / 10).any()):
                break
            steps = STEP * torch.eye(2, dtype=shift.dtype)
            slopes = [(self.shown(shift + step)[0] - center)[:, axis] / STEP for axis, step in enumerate(steps)]
            towards = missed / torch.stack(slopes, dim=1).clamp(min=LEAST_SLOPE)
            shift = shift + towards.clamp(-self.half / 2, self.half / 2)
        return shift, share, missed.abs().amax(dim=1)


def _density(x: Tensor) -> Tensor:
    """Of the standard normal distribution."""
    return torch.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
