"""Alignment by the spot: turn a heliostat until its spot's centre of mass is at the measured place.

Notes
-----
The measured place is the centre of the light that a target shows. If a spot extends over the
target's edge, this is not the centre of all its light. So the mirror is turned until the part on
the target has its centre there. For this part, each ray is a round Gaussian as wide as the sun.
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
from model.setup import Setup
from model.tracing.convolution import Rays, central_rays
from model.tracing.scene import Scene

Array = NDArray[np.float64]

ROUNDS = 4
"""Rounds of moving the aim; each leaves a tenth of the error or less."""

TOLERANCE = 1e-5
"""Distance [m] of the spots from their goals at which the alignment ends."""

CONE = 2.4e-3
"""Standard deviation [rad] per axis of the light about a ray: half the sun's radius, and a good
mirror's slopes.

Only its order of magnitude matters, at the target's edge.
"""

NEWTON, STEP, MIN_SLOPE, MISSED = 20, 1e-3, 0.05, 1e-3
"""Newton steps, the difference [m] for their derivatives, the smallest derivative, and the
distance [m] up to which a place is reached.
"""

REACH = 4.0
"""Standard deviations within which a ray's light ends, to find spots that edges truncate."""

WHOLE = 2e-3
"""Share of a spot's light outside of the target up to which the spot is whole."""


class Alignment(NamedTuple):
    """Aligned mirrors.

    Attributes
    ----------
    angles : (B, 2) [rad]
        Of the mounts' axes.
    aims : (B, 3) [m]
        Points in ENU that the mirrors' centres aim at.
    scene : Scene
        In double precision, before it was altered.
    is_truncated : (B,)
        Whether a spot extends over the edge of its target.
    """

    angles: Array
    aims: Array
    scene: Scene
    is_truncated: NDArray[np.bool_]


def align_to_spots(
    setups: Sequence[Setup],
    start: ArrayLike | None = None,
    alter: Callable[[Scene], Scene] | None = None,
    samples: int = 12,
) -> Alignment:
    """Align B setups with surfaces of one grid, so that the light that targets show has its centres
    at the spots.

    Canting and waviness move the spot off the point that the mirror's centre aims at; motor
    positions are accurate to about a degree before a kinematic calibration. The measured spot is
    better than both.

    Parameters
    ----------
    setups : sequence of Setup
        With spots.
    start : array_like (B, 3) [m], optional
        Initial aims, by default the spots; those of a similar alignment save rounds.
    alter : callable, optional
        Changes the scene of aligned mirrors, as gravity does.
    samples : int
        Traced rays along each side of a facet.

    Raises
    ------
    UnreachableError
        Where no attitude reflects the sun there.
    """
    goals = np.array([setup.goal for setup in setups])
    suns = np.array([setup.sun for setup in setups], dtype=np.float64)
    aims = goals.copy() if start is None else np.array(start, dtype=np.float64)
    positions = np.array([setup.heliostat.position for setup in setups])
    mount = Mount.stack([setup.heliostat.mount for setup in setups])
    angles = mount.align(positions, suns, aims)
    scene = Scene.from_setups(setups, angles, dtype=torch.float64)
    center, axes = scene.plane_center.numpy(), scene.plane_axes[:, :2].numpy()
    places = torch.as_tensor(np.einsum("bij,bj->bi", axes, goals - center))
    halves = torch.as_tensor(
        [(s.plane.width / 2, s.plane.height / 2) for s in setups], dtype=torch.float64
    )
    for _ in range(ROUNDS):
        with torch.no_grad():
            light = _Light.from_rays(
                central_rays(scene if alter is None else alter(scene), samples), halves
            )
            centred = light.shift_to(places)
            shift = centred.shift.numpy()
        if not np.isfinite(shift).all():
            raise UnreachableError(
                "a mirror sends no light to its target, so that its spot has no place"
            )
        if np.abs(shift).max() < TOLERANCE:
            break
        aims += np.einsum("bi,bij->bj", shift, axes)
        angles = mount.align(positions, suns, aims)
        attitude = mount.attitude(angles)
        moved = {"attitude": attitude, "center": mount.mirror_center(positions, attitude)}
        scene = scene.with_(**{name: torch.as_tensor(values) for name, values in moved.items()})
    return Alignment(angles, aims, scene, centred.share.numpy() < 1 - WHOLE)


class _Visible(NamedTuple):
    """Visible centre (B, 2) [m] and share (B,) of light."""

    center: Tensor
    share: Tensor


class _Shift(NamedTuple):
    """Shifts (B, 2) [m] of light, and visible shares (B,) and distances (B,) [m] to goals after."""

    shift: Tensor
    share: Tensor
    distance: Tensor


class _Light(NamedTuple):
    """Light about rays on targets, right and up of the targets' centres.

    Attributes
    ----------
    hits, power : Tensor (B, 2, S), (B, S) [m, m2]
        Of the rays.
    spot : Tensor (B, 2) [m]
        Centre of all light.
    width : Tensor (B, 2) [m]
        Standard deviation about each ray.
    half : Tensor (B, 2) [m]
        Half of the target's size.
    """

    hits: Tensor
    power: Tensor
    spot: Tensor
    width: Tensor
    half: Tensor

    @classmethod
    def from_rays(cls, rays: Rays, half: Tensor) -> "_Light":
        """The light about traced rays."""
        slope = rays.direction[:, :2] / rays.direction[:, 2:]
        width = CONE * rays.slant_range[:, None] * (1 + slope**2).sqrt()
        return cls(rays.hits, rays.power, rays.spot, width, half)

    def visible(self, shift: Tensor) -> _Visible:
        """The visible part of the light, shifted by ``shift`` (B, 2) [m]."""
        width, half = self.width[..., None], self.half[..., None]
        hits = self.hits + shift[..., None]
        low, high = (-half - hits) / width, (half - hits) / width
        within = torch.special.ndtr(high) - torch.special.ndtr(low)
        moment = hits * within + width * (_density(low) - _density(high))
        power = (self.power * within.prod(dim=1)).sum(-1, keepdim=True)
        center = (self.power[:, None] * moment * within.flip(1)).sum(-1) / power
        return _Visible(center, power[:, 0] / self.power.sum(-1))

    def shift_to(self, goals: Tensor) -> _Shift:
        """Find shifts that bring the visible centres to goals (B, 2) [m].

        If no shift does, as for a goal outside of the target, the centre of all light is brought
        there.
        """
        shift = goals - self.spot
        share, distance = torch.ones_like(shift[:, 0]), torch.zeros_like(shift[:, 0])
        margin = self.half[..., None] - (self.hits + shift[..., None]).abs()
        edge = (margin < REACH * self.width[..., None]).flatten(1).any(dim=1)
        if bool(edge.any()):
            light = _Light(*(part[edge] for part in self))
            found = light._newton(shift[edge], goals[edge])
            reached = found.distance < MISSED
            shift[edge] = torch.where(reached[:, None], found.shift, shift[edge])
            share[edge] = torch.where(reached, found.share, share[edge])
            distance[edge] = found.distance
        return _Shift(shift, share, distance)

    def _newton(self, shift: Tensor, goals: Tensor) -> _Shift:
        """Find shifts from initial ones (B, 2) [m] by Newton's method along each axis."""
        for _ in range(NEWTON):
            center, share = self.visible(shift)
            missing = goals - center
            if not bool((missing.abs() > TOLERANCE / 10).any()):
                break
            steps = STEP * torch.eye(2, dtype=shift.dtype)
            slopes = [
                (self.visible(shift + step).center - center)[:, axis] / STEP
                for axis, step in enumerate(steps)
            ]
            change = missing / torch.stack(slopes, dim=1).clamp(min=MIN_SLOPE)
            shift = shift + change.clamp(-self.half / 2, self.half / 2)
        return _Shift(shift, share, missing.abs().amax(dim=1))


def _density(x: Tensor) -> Tensor:
    """Density of the standard normal distribution."""
    return torch.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
