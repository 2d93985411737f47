"""What surface prediction takes in and gives back."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.plant import Heliostat, TargetPlane
from model.surface import control_points
from model.tracing import Optics, Scene, Window, trace
from model.tracing.alignment import align_to_spots

FLUX_SHAPE = (64, 64)
FLUX_WINDOW = 4.0
"""Side [m] of the square that flux images show about their centre of mass (the paper's)."""


@dataclass(frozen=True, eq=False)
class Observation:
    """One measured flux image and where it was taken.

    Attributes
    ----------
    flux : (64, 64)
        4 m x 4 m about the spot's centre of mass, sum 100.
    sun : (3,)
        Unit vector towards the sun in ENU.
    target : TargetPlane
    center_of_mass : (3,) [m]
        The spot in ENU; the target's centre is a fair guess where it is not known.
    identifier : str
    motor_position : (2,) [steps] or None
    """

    flux: NDArray[np.float32]
    sun: NDArray[np.float64]
    target: TargetPlane
    center_of_mass: NDArray[np.float64]
    identifier: str
    motor_position: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.flux.shape != FLUX_SHAPE:
            raise InvalidInputError(f"flux of {self.identifier} must be {FLUX_SHAPE}, got {self.flux.shape}")
        if not np.isfinite(self.flux).all() or not self.flux.sum() > 0:
            raise InvalidInputError(f"flux of {self.identifier} must be finite and hold energy")


@dataclass(frozen=True, eq=False)
class SurfacePrediction:
    """A predicted mirror surface.

    Attributes
    ----------
    z, z_std : (4, 8, 8) [m]
        Control heights over the canted facets, facet mean zero, and their standard deviation.
    control_points : (4, 8, 8, 3) [m]
        In mirror coordinates.
    method : str
        "network" or "refined".
    weights : str
        Name and content hash of the weights that were used.
    misfit : float
        How badly the surface explains its own images: one minus the mean flux accuracy of re-rendering them.
    used : tuple of str
        Identifiers of the images.
    """

    z: NDArray[np.float64]
    z_std: NDArray[np.float64]
    control_points: NDArray[np.float64]
    method: str
    weights: str
    misfit: float
    used: tuple[str, ...]


def scene_of(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    surfaces: Sequence[NDArray[np.float64] | None] = (None,),
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """The scene of a heliostat's M observations with each of K surfaces in turn, aligned by the measured spots.

    ``surfaces`` are heights (4, 8, 8) [m], None the ideal one; the scene holds K * M mirrors, all observations of the
    first surface first.
    """
    count = len(observations) * len(surfaces)
    shapes = [control_points(heliostat, z) for z in surfaces]
    points = [shape for shape in shapes for _ in observations]
    suns = np.tile([o.sun for o in observations], (len(surfaces), 1))
    targets = [o.target for o in observations] * len(surfaces)
    spots = np.tile([o.center_of_mass for o in observations], (len(surfaces), 1))
    angles = align_to_spots([heliostat] * count, points, suns, targets, spots)
    return Scene.build([heliostat] * count, points, angles, suns, targets, dtype=dtype)


def render_observations(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    surfaces: Sequence[NDArray[np.float64]],
    optics: Optics | None = None,
    *,
    samples: int = 24,
) -> NDArray[np.float64]:
    """What each of K surfaces (4, 8, 8) [m] would have thrown on the M targets: fluxes (K, M, 64, 64), sum 100.

    Every surface is aligned anew: a tilt of the whole mirror is taken back by the mount and leaves no trace.
    """
    scene = scene_of(heliostat, observations, surfaces)
    with torch.no_grad():
        window = Window(FLUX_WINDOW, FLUX_WINDOW, on_spot=True)
        flux = trace(scene, window, optics, samples=samples, padding=0.25).normalized()
    return flux.double().numpy().reshape(len(surfaces), len(observations), *flux.shape[1:])


def spread_suns(suns: NDArray[np.float64], count: int) -> list[int]:
    """Indices of up to ``count`` unit vectors of (N, 3): the first, then each time the farthest from those chosen.

    Images under suns that stand far apart tell more of a mirror than images of one morning.
    """
    chosen = [0]
    while len(chosen) < min(count, len(suns)):
        nearest = (suns @ suns[chosen].T).max(axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(nearest.argmin()))
    return chosen
