"""Measured images of a heliostat, and the surfaces predicted from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.errors import InvalidInputError
from model.forecast import Aligned, align
from model.images import FLUX_SHAPE, FLUX_SIZE, FLUX_WINDOW, binned, clipped_alike, normalized
from model.metrics import flux_accuracy
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.surface import control_points
from model.tracing import Scene
from model.tracing.alignment import align_to_spots

TRUSTED_MISFIT = 0.2
"""Largest misfit of an explained image: twice that of clean images, more than that of real ones."""


TRUSTED_MAHALANOBIS = 1.8
"""Largest Mahalanobis distance, per root degree of freedom, of a mirror of the known type.

One in a thousand has a larger distance (chi-squared, 8).
"""


@dataclass(frozen=True, eq=False)
class Observation:
    """One measured flux image with its sun and target.

    Attributes
    ----------
    flux : (64, 64)
        A square about the spot's centre of mass, sum 100.
    sun : (3,)
        Unit vector towards the sun in ENU.
    target : TargetPlane
    center_of_mass : (3,) [m]
        Of the spot, in ENU; the target's centre is a fair guess if it is not known.
    identifier : str
    motor_position : (2,) [steps] or None
    clipped : (64, 64) [1] or None
        Saturated share of each pixel, if any: the light there was at least as much.
    taken_at : datetime or None
        None if it is not known.
    side : float [m]
        Of the square.
    size_error : float [1]
        Relative standard deviation of ``side``, if it is not known exactly.
    """

    flux: NDArray[np.float32]
    sun: NDArray[np.float64]
    target: TargetPlane
    center_of_mass: NDArray[np.float64]
    identifier: str
    motor_position: NDArray[np.float64] | None = None
    clipped: NDArray[np.float32] | None = None
    taken_at: datetime | None = None
    side: float = FLUX_WINDOW
    size_error: float = 0.0

    @property
    def clipped_share(self) -> float:
        """Saturated share [1] of the spot's brighter half."""
        if self.clipped is None:
            return 0.0
        return float(self.clipped[self.flux > 0.5 * self.flux.max()].mean())

    def __post_init__(self) -> None:
        if self.clipped is not None and self.clipped.shape != FLUX_SHAPE:
            raise InvalidInputError(
                f"clipped of {self.identifier} must be {FLUX_SHAPE}, got {self.clipped.shape}"
            )
        if self.flux.shape != FLUX_SHAPE:
            raise InvalidInputError(
                f"flux of {self.identifier} must be {FLUX_SHAPE}, got {self.flux.shape}"
            )
        if not np.isfinite(self.flux).all() or not self.flux.sum() > 0:
            raise InvalidInputError(f"flux of {self.identifier} must be finite and hold energy")


@dataclass(frozen=True, eq=False)
class SurfacePrediction:
    """A predicted mirror surface.

    Attributes
    ----------
    z, z_std : (F, 8, 8) [m]
        Control heights over the canted facets, facet mean zero, and their standard deviation.
    control_points : (F, 8, 8, 3) [m]
        In mirror coordinates.
    method : str
        "network" or "refined".
    weights : str
        Name and content hash of the weights.
    misfits : tuple of float
        Of each image: one minus the accuracy of the flux image that is rendered from the surface.
    used : tuple of str
        Identifiers of the images.
    information_shares : tuple of float [1]
        Share of each image in the information about the surface, if it was estimated.
    mahalanobis_distance : float
        Mahalanobis distance of the surface from the prior; about one is usual
        (`SurfacePrior.mahalanobis`).
    contradicting : tuple of str
        Identifiers of images that were excluded because the others contradict them.
    warnings : tuple of str
        Further reasons not to trust it, in sentences (`model.prediction_warnings`).
    is_start_better : bool
        Whether the surface that a refinement started from agrees better with each image than the
        surface that is refined from the others.
    """

    z: NDArray[np.float64]
    z_std: NDArray[np.float64]
    control_points: NDArray[np.float64]
    method: str
    weights: str
    misfits: tuple[float, ...]
    used: tuple[str, ...]
    information_shares: tuple[float, ...] = ()
    mahalanobis_distance: float = 1.0
    contradicting: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    is_start_better: bool = False

    @property
    def misfit(self) -> float:
        """Mean of the images' misfits."""
        return float(np.mean(self.misfits))

    @property
    def suspicious(self) -> Sequence[str]:
        """Identifiers of the images that the surface does not explain."""
        return tuple(
            name
            for name, misfit in zip(self.used, self.misfits, strict=True)
            if misfit > TRUSTED_MISFIT
        )

    @property
    def trusted(self) -> bool:
        """Whether the surface explains every image, is of the known type, and has no warnings.

        A surface can often be bent to explain a foreign spot, a mirror of another type or images of
        another heliostat, but not a likely surface.
        """
        return (
            not self.suspicious
            and not self.warnings
            and self.mahalanobis_distance <= TRUSTED_MAHALANOBIS
        )


def _setups(
    heliostat: Heliostat, observations: Sequence[Observation], z: NDArray[np.float64]
) -> list[Setup]:
    """Setups of a surface ``z`` (F, I, J) [m]."""
    points = control_points(heliostat, z)
    return [
        Setup(heliostat, points, o.sun, o.target, o.center_of_mass, taken_at=o.taken_at)
        for o in observations
    ]


def observed_scene(
    heliostat: Heliostat, observations: Sequence[Observation], z: NDArray[np.float64]
) -> Scene:
    """The scene of M observations of a surface ``z`` (F, 8, 8) [m], aligned by the spots."""
    return align_to_spots(_setups(heliostat, observations, z)).scene.to(torch.float32)


def align_observations(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: NDArray[np.float64],
    model: PlantModel,
    start: Aligned | None = None,
) -> Aligned:
    """Align the heliostat with surface ``z`` (F, 8, 8) [m] so that its spots are where the M were
    observed.

    The mount compensates a tilt of the whole mirror. ``start`` is the result for a similar surface,
    and saves rounds.
    """
    return align(_setups(heliostat, observations, z), model, start=start)


def common_side(observations: Sequence[Observation]) -> float:
    """Width [m] of the squares of all observations of a heliostat.

    Raises
    ------
    InvalidInputError
        If they differ.
    """
    sides = sorted({o.side for o in observations})
    if len(sides) > 1:
        raise InvalidInputError(
            f"flux images of one heliostat must show squares of one size, got sides {sides} m; cut"
            " all to the largest"
        )
    return sides[0]


class Saturation:
    """Saturates forecasts where the camera saturated M observations.

    ``size`` is the number of pixels along a side of the forecasts.
    """

    def __init__(self, observations: Sequence[Observation], size: int = FLUX_SIZE) -> None:
        nothing = np.zeros(FLUX_SHAPE)
        clipped = np.array(
            [nothing if o.clipped is None else o.clipped for o in observations], dtype=np.float64
        )
        self._is_saturated = bool(clipped.any())
        flux = np.array([o.flux for o in observations], dtype=np.float64)
        self._measured, self._clipped = (
            torch.as_tensor(binned(image, size))
            for image in (flux, clipped * (size / FLUX_SIZE) ** 2)
        )

    def apply(self, images: Tensor) -> Tensor:
        """Forecasts (..., M, R, R) as the camera shows them, sum 100."""
        if not self._is_saturated:
            return images
        return normalized(
            clipped_alike(images, self._measured.to(images), self._clipped.to(images))
        )


def render_observations(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: NDArray[np.float64],
    model: PlantModel,
    samples: int = 24,
) -> NDArray[np.float64]:
    """Render the M images of a surface ``z`` (F, 8, 8) [m]: (M, 64, 64), sum 100."""
    with torch.no_grad():
        aligned = align_observations(heliostat, observations, z, model)
        images = aligned.flux_images(side=common_side(observations), samples=samples)
        return Saturation(observations).apply(images).double().numpy()


def spread_suns(suns: NDArray[np.float64], count: int) -> list[int]:
    """Select up to ``count`` of N unit vectors (N, 3): the first, then each time the farthest from
    those selected.

    Images under suns that are far apart determine a mirror better than images of one morning.
    """
    chosen = [0]
    while len(chosen) < min(count, len(suns)):
        nearest = (suns @ suns[chosen].T).max(axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(nearest.argmin()))
    return chosen


def misfits(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: NDArray[np.float64],
    model: PlantModel,
) -> tuple[float, ...]:
    """One minus the accuracy with which heights ``z`` (F, 8, 8) [m] render each image."""
    images = render_observations(heliostat, observations, z, model).clip(min=0)
    return tuple(
        1 - flux_accuracy(o.flux, image) for o, image in zip(observations, images, strict=True)
    )
