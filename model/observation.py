"""What surface prediction takes in and gives back."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.effects import Effect
from model.errors import InvalidInputError
from model.forecast import Aligned, Setup, align
from model.images import FLUX_SHAPE, FLUX_SIZE, FLUX_WINDOW, binned, clipped_alike, normalized
from model.metrics import flux_accuracy
from model.plant import Heliostat, TargetPlane
from model.surface import control_points
from model.tracing import Optics, Scene
from model.tracing.alignment import align_to_spots

TRUSTED_MISFIT = 0.2
"""Misfit of an image up to which a surface explains it: twice what clean images leave, more than real ones do."""


TRUSTED_MAHALANOBIS = 1.8
"""Mahalanobis distance per root degree of freedom up to which a surface may be a mirror of this kind.

One in a thousand lies farther (chi-squared, 8).
"""


@dataclass(frozen=True, eq=False)
class Observation:
    """One measured flux image and where it was taken.

    Attributes
    ----------
    flux : (64, 64)
        A square about the spot's centre of mass, sum 100.
    sun : (3,)
        Unit vector towards the sun in ENU.
    target : TargetPlane
    center_of_mass : (3,) [m]
        The spot in ENU; the target's centre is a fair guess where it is not known.
    identifier : str
    motor_position : (2,) [steps] or None
    clipped : (64, 64) [1] or None
        Share of each pixel that the camera's range cut off, where it did: there was at least so much light.
    taken_at : datetime or None
        When, where that is known.
    side : float [m]
        Of the square.
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

    @property
    def clipped_share(self) -> float:
        """Share [1] of the spot's brighter half that the camera's range cut off."""
        if self.clipped is None:
            return 0.0
        return float(self.clipped[self.flux > 0.5 * self.flux.max()].mean())

    def __post_init__(self) -> None:
        if self.clipped is not None and self.clipped.shape != FLUX_SHAPE:
            raise InvalidInputError(f"clipped of {self.identifier} must be {FLUX_SHAPE}, got {self.clipped.shape}")
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
    misfits : tuple of float
        How badly the surface explains each of its own images: one minus the flux accuracy of re-rendering it.
    used : tuple of str
        Identifiers of the images.
    tells : tuple of float [1]
        Share of each image in what all of them tell of the surface, where that was estimated.
    mahalanobis : float
        Mahalanobis distance of the surface from the prior; about one is usual (`SurfacePrior.mahalanobis`).
    contradicting : tuple of str
        Identifiers of images that the surface does without: what the others tell contradicts them.
    doubts : tuple of str
        What else speaks against it, in sentences (`model.doubts`).
    """

    z: NDArray[np.float64]
    z_std: NDArray[np.float64]
    control_points: NDArray[np.float64]
    method: str
    weights: str
    misfits: tuple[float, ...]
    used: tuple[str, ...]
    tells: tuple[float, ...] = ()
    mahalanobis: float = 1.0
    contradicting: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def misfit(self) -> float:
        """Mean of the images' misfits."""
        return float(np.mean(self.misfits))

    @property
    def suspicious(self) -> tuple[str, ...]:
        """Identifiers of the images that the surface does not explain."""
        return tuple(name for name, misfit in zip(self.used, self.misfits, strict=True) if misfit > TRUSTED_MISFIT)

    @property
    def trusted(self) -> bool:
        """Whether every image is explained, and by a mirror like those known, and nothing else speaks against it.

        Not so for a foreign spot, a mirror of another kind, or images of another heliostat: a surface can often be bent
        to explain those, but not a likely one.
        """
        return not self.suspicious and not self.doubts and self.mahalanobis <= TRUSTED_MAHALANOBIS


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


def align_observations(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: NDArray[np.float64],
    effects: Sequence[Effect] = (),
    *,
    latitude_deg: float,
    start: Aligned | None = None,
) -> Aligned:
    """The heliostat with surface ``z`` (4, 8, 8) [m] turned so that its spots lie where the M were observed.

    A tilt of the whole mirror is taken back by the mount and leaves no trace. ``start`` is what this gave for a surface
    that differs little, and saves rounds. ``latitude_deg`` [deg] is the plant's, along which the sun's clock runs.
    """
    points = control_points(heliostat, z)
    setups = [Setup(heliostat, points, o.sun, o.target, o.center_of_mass, taken_at=o.taken_at) for o in observations]
    return align(setups, effects, latitude_deg=latitude_deg, start=start)


def common_side(observations: Sequence[Observation]) -> float:
    """Side [m] of the squares that all of a heliostat's observations show.

    Raises
    ------
    InvalidInputError
        Where they differ.
    """
    sides = sorted({o.side for o in observations})
    if len(sides) > 1:
        raise InvalidInputError(
            f"flux images of one heliostat must show squares of one size, got sides {sides} m; cut all to the largest"
        )
    return sides[0]


class Ranges:
    """Where the camera's range cut off M observations; forecasts of them are cut off there, too.

    ``size`` is that of the forecasts' pixels along a side.
    """

    def __init__(self, observations: Sequence[Observation], size: int = FLUX_SIZE) -> None:
        nothing = np.zeros(FLUX_SHAPE)
        clipped = np.array([nothing if o.clipped is None else o.clipped for o in observations], dtype=np.float64)
        self._cut_off = bool(clipped.any())
        flux = np.array([o.flux for o in observations], dtype=np.float64)
        self._measured, self._clipped = (
            torch.as_tensor(binned(image, size)) for image in (flux, clipped * (size / FLUX_SIZE) ** 2)
        )

    def seen(self, images: Tensor) -> Tensor:
        """Forecasts (..., M, R, R) as the camera shows them, sum 100."""
        if not self._cut_off:
            return images
        return normalized(clipped_alike(images, self._measured.to(images), self._clipped.to(images)))


def render_observations(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: NDArray[np.float64],
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
    *,
    latitude_deg: float,
    samples: int = 24,
) -> NDArray[np.float64]:
    """What the M photographs would show of a surface ``z`` (4, 8, 8) [m]: (M, 64, 64), sum 100."""
    with torch.no_grad():
        aligned = align_observations(heliostat, observations, z, effects, latitude_deg=latitude_deg)
        images = aligned.flux_images(optics, effects, side=common_side(observations), samples=samples)
        return Ranges(observations).seen(images).double().numpy()


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


def misfits(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: NDArray[np.float64],
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
    *,
    latitude_deg: float,
) -> tuple[float, ...]:
    """One minus the accuracy with which heights ``z`` (4, 8, 8) [m] re-render each of the images they came from."""
    images = render_observations(heliostat, observations, z, optics, effects, latitude_deg=latitude_deg).clip(min=0)
    return tuple(1 - flux_accuracy(o.flux, image) for o, image in zip(observations, images, strict=True))
