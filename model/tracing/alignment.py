"""Alignment by the spot: turn a heliostat until its spot's centre of mass lies where it was measured."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from model.plant import Heliostat, TargetPlane
from model.surface import DEGREE
from model.tracing.convolution import central_rays
from model.tracing.scene import Scene, by_heliostat

ROUNDS = 3
"""The spot follows the aim almost one to one, so that each round leaves a thousandth of the error or less."""


def align_to_spots(
    heliostats: Sequence[Heliostat],
    control_points: Sequence[ArrayLike],
    suns: ArrayLike,
    planes: Sequence[TargetPlane],
    spots: ArrayLike,
    *,
    degree: int = DEGREE,
    samples: int = 12,
) -> NDArray[np.float64]:
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
    goal, directions = np.asarray(spots, dtype=np.float64), np.asarray(suns, dtype=np.float64)
    aim = goal.copy()
    for _ in range(ROUNDS):
        angles = _align(heliostats, directions, aim)
        scene = Scene.build(heliostats, control_points, angles, directions, planes, degree=degree, dtype=torch.float64)
        traced = central_rays(scene, samples).spot.numpy()
        center, axes = scene.plane_center.numpy(), scene.plane_axes.numpy()
        aim += goal - center - np.einsum("bi,bij->bj", traced, axes[:, :2])
    return _align(heliostats, directions, aim)


def _align(
    heliostats: Sequence[Heliostat], suns: NDArray[np.float64], aims: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Axis angles (B, 2) [rad] that send the ray from each mirror's centre to its aim (B, 3)."""
    angles = np.empty((len(heliostats), 2))
    for heliostat, rows in by_heliostat(heliostats):
        angles[rows] = heliostat.mount.align(heliostat.position, suns[rows], aims[rows])
    return angles
