"""Alignment by the spot: turn a heliostat until its spot's centre of mass lies where it was measured."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from model.errors import UnreachableError
from model.mount import Mount
from model.plant import Heliostat, TargetPlane
from model.surface import DEGREE
from model.tracing.convolution import central_rays
from model.tracing.scene import Scene

Array = NDArray[np.float64]

ROUNDS = 4
"""The spot follows the aim almost one to one, so that each round leaves a tenth of the error, or much less."""

TOLERANCE = 1e-5
"""Distance [m] of the spots from where they shall lie at which the alignment ends."""


class Alignment(NamedTuple):
    """Axis angles (B, 2) [rad], the points (B, 3) [m] in ENU that the mirrors' centres aim at, and the aligned scene.

    The scene is in double precision and without what ``alter`` changes.
    """

    angles: Array
    aims: Array
    scene: Scene


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
    """Axis angles (B, 2) [rad] at which each mirror's centre of mass falls on its ``spots`` (B, 3) [m] in ENU.

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
    for _ in range(ROUNDS):
        with torch.no_grad():
            traced = central_rays(scene if alter is None else alter(scene), samples).spot.numpy()
        missed = np.einsum("bij,bj->bi", axes, goal - center) - traced
        if not np.isfinite(missed).all():
            raise UnreachableError("a mirror sends no light to its target, so that its spot has no place")
        if np.abs(missed).max() < TOLERANCE:
            break
        aims += np.einsum("bi,bij->bj", missed, axes)
        angles = mount.align(positions, directions, aims)
        attitude = mount.attitude(angles)
        turned = {"attitude": attitude, "center": mount.mirror_center(positions, attitude)}
        scene = scene.with_(**{name: torch.as_tensor(values) for name, values in turned.items()})
    return Alignment(angles, aims, scene)
