"""The forward model: traced images as a function of a surface's coefficients.

Notes
-----
::

    z(c) = mean + directions c              heights; c are coefficients of the prior
    images(c, r) = trace(z(c)) + T r        r are coefficients of the ripples, T `ripple_images`

The ripples are so fine that images are linear in them, and T is traced once. They are finer than
the prior's directions: than 8 x 8 heights, and of many facets than the shapes of each. Those of
many facets are reduced to the `MAX_RIPPLES` combinations that change the images most; what is left
of them is noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from model.forecast import Aligned, flux_changes
from model.images import COARSE_SIZE, binned
from model.network.inputs import STEP_HEIGHT
from model.observation import Observation, Saturation, align_observations, common_side, spread_suns
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.prior import SurfacePrior, ripple_shapes, ripples
from model.progress import Steps
from model.refinement.whitening import Whitener
from model.surface import halved
from model.tracing.sensitivity import HeightChanges

Array = NDArray[np.float64]

MAX_RIPPLES = 420
"""Largest number of ripples: those of four facets."""

MAX_COMPARED = 8
"""Largest number of images by which the strongest ripples of many facets are found."""

OVERSAMPLING = 20
"""Further random combinations by which they are found."""


@dataclass(frozen=True, eq=False)
class SurfaceState:
    """A surface with its traced images.

    Attributes
    ----------
    coefficients : (K,)
        Of the prior's directions, then of the ripples.
    aligned : Aligned
        The mirror without ripples, aligned under each sun.
    images : (M, R, R)
        Sum 100, with ripples.
    """

    coefficients: Array
    aligned: Aligned
    images: Array


@dataclass(frozen=True, eq=False)
class ImageModel:
    """Traces the images of a heliostat's observations from coefficients of its surface.

    Attributes
    ----------
    heliostat : Heliostat
    observations : sequence of M Observation
    model : PlantModel
    prior : SurfacePrior
    ripple_images : (N, M, R, R) or None
        Change of the images per coefficient of a ripple (`with_ripples`).
    resolution : int
        R, the number of pixels along a side.
    samples : int
        Traced rays along each side of a facet.
    steps : Steps
        Counts minimizations; the work may be ended before each trace.
    threads : int
        That differentiate the images; one where several fits run in parallel.
    """

    heliostat: Heliostat
    observations: Sequence[Observation]
    model: PlantModel
    prior: SurfacePrior
    ripple_images: NDArray[Any] | None = None
    resolution: int = COARSE_SIZE
    samples: int = 32
    steps: Steps = field(default_factory=Steps)
    threads: int = 1

    @cached_property
    def measured(self) -> Array:
        """The measured images (M, R, R)."""
        return binned(
            np.array([o.flux for o in self.observations], dtype=np.float64), self.resolution
        )

    @cached_property
    def side(self) -> float:
        """Width of the images [m]."""
        return common_side(self.observations)

    @cached_property
    def suns(self) -> Array:
        """Unit vectors (M, 3) towards the suns."""
        return np.array([o.sun for o in self.observations])

    @cached_property
    def ripples(self) -> NDArray[Any]:
        """``ripple_images``; (0, M, R, R) without ripples."""
        none = np.zeros((0, *self.measured.shape), np.float32)
        return none if self.ripple_images is None else self.ripple_images

    @cached_property
    def _saturation(self) -> Saturation:
        return Saturation(self.observations, self.resolution)

    @cached_property
    def _difference_steps(self) -> NDArray[np.float32]:
        """Steps (K,) of the prior's coefficients for finite differences.

        All change heights by about the same: little enough for linear images, and far more than
        their rounding errors.
        """
        heights = np.sqrt((self.prior.basis**2).mean(axis=(1, 2, 3)))
        return np.asarray(np.clip(STEP_HEIGHT / heights, 0.1, 4.0), dtype=np.float32)

    def subset(self, places: Sequence[int]) -> "ImageModel":
        """The model of some of the observations."""
        some = None if self.ripple_images is None else self.ripple_images[:, list(places)]
        return replace(
            self, observations=[self.observations[i] for i in places], ripple_images=some
        )

    def split(self, coefficients: Array) -> tuple[Array, ...]:
        """Coefficients (K,) of the prior and those of the ripples."""
        return tuple(np.split(coefficients, [len(self.prior.basis)]))

    def state(self, coefficients: Array, near: SurfaceState | None = None) -> SurfaceState:
        """Align the mirror of coefficients (K,), faster from a state near by; trace its images."""
        self.steps.alive()
        smooth, fine = self.split(coefficients)
        z, start = self.prior.surface(smooth), None if near is None else near.aligned
        aligned = align_observations(self.heliostat, self.observations, z, self.model, start)
        # In the ripples' precision: a copy of them in double precision takes longer than the trace.
        rippled = np.tensordot(fine.astype(self.ripples.dtype), self.ripples, axes=1)
        return SurfaceState(coefficients, aligned, self._trace(aligned) + rippled)

    def jacobian(self, state: SurfaceState) -> NDArray[Any]:
        """Derivatives (K, M, R, R) of the images by the prior's coefficients."""
        steps = self._difference_steps[:, None, None, None]
        return np.asarray(self._trace_changes(state.aligned, self._difference_changes) / steps)

    @cached_property
    def _difference_changes(self) -> HeightChanges:
        """The prior's directions, each as long as its step."""
        prior, steps = self.prior, self._difference_steps[:, None, None]
        if prior.shapes is None or prior.weights is None:
            return HeightChanges.of(_tensor(prior.basis) * _tensor(steps[..., None]))
        return HeightChanges(_tensor(prior.shapes), _tensor(prior.weights) * _tensor(steps))

    def with_ripples(self, state: SurfaceState, whitener: Whitener) -> "ImageModel":
        """The model with ripples, whose images are those at a state, to first order.

        ``whitener`` is that of the state's images.
        """
        smooth, _ = self.split(state.coefficients)
        z, half_sizes = halved(self.prior.surface(smooth)), self.heliostat.facet_frames.half_sizes
        if self.prior.shapes is None:
            found = self.changes_of(z, HeightChanges.of(_tensor(ripples(half_sizes))))
            return replace(self, ripple_images=found)
        shapes = _tensor(np.concatenate([halved(self.prior.fine), ripple_shapes(half_sizes)]))
        return replace(self, ripple_images=_strongest_ripples(self, z, shapes, whitener))

    def dim_facets(self, state: SurfaceState, share: float) -> Array:
        """Change of the images (F, M, R, R) as each facet in turn loses a share of its light."""
        dimmed = 1 - share * np.eye(len(self.prior.mean))
        images = [
            self._trace(state.aligned.with_facet_light(torch.as_tensor(facets)))
            for facets in dimmed
        ]
        return np.asarray(state.images - np.stack(images))

    def _trace(self, aligned: Aligned) -> Array:
        """Images (M, R, R) as the cameras show them."""
        with torch.no_grad():
            images = aligned.flux_images(size=self.resolution, side=self.side, samples=self.samples)
            images = self._saturation.apply(images)
        return np.asarray(images.double().numpy())

    def changes_of(self, z: Array, changes: HeightChanges) -> NDArray[Any]:
        """Change of the images (K, M, R, R) of the mirror of heights (F, I, J) [m]."""
        aligned = align_observations(self.heliostat, self.observations, z, self.model)
        return self._trace_changes(aligned, changes)

    def _trace_changes(self, aligned: Aligned, directions: HeightChanges) -> NDArray[Any]:
        """Change of the images (K, M, R, R) with K changes of the heights."""
        with torch.no_grad():
            images = flux_changes(
                aligned,
                directions,
                size=self.resolution,
                side=self.side,
                samples=self.samples,
                between=self.steps.alive,
                threads=self.threads,
            )
            images = self._saturation.apply(images)
            return np.asarray((images[1:] - images[:1]).numpy())


def _tensor(values: NDArray[Any]) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


def _strongest_ripples(
    model: ImageModel, z: Array, shapes: torch.Tensor, whitener: Whitener
) -> NDArray[Any]:
    """Change of the images (N, M, R, R) per ripple: `MAX_RIPPLES` combinations of each facet's
    ``shapes`` (L, I, J) [m], on the mirror of heights ``z`` (F, I, J) [m].
    """
    if len(shapes) * len(z) <= MAX_RIPPLES:
        return model.changes_of(z, HeightChanges(shapes))
    places = sorted(spread_suns(model.suns, MAX_COMPARED))
    by_shape = model.subset(places).changes_of(z, HeightChanges(shapes))
    weights = _strongest(whitener.subset(places)(by_shape), MAX_RIPPLES)
    if len(places) == len(model.observations):
        return np.asarray(np.tensordot(weights, by_shape, axes=1))
    of_facets = _tensor(weights.reshape(len(weights), len(z), -1))
    return model.changes_of(z, HeightChanges(shapes, of_facets))


def _strongest(white: NDArray[Any], count: int) -> NDArray[Any]:
    """Orthonormal combinations (count, N) of whitened changes (N, M, n) that change images most.

    By a randomized range finder (Halko, Martinsson and Tropp 2011, doi:10.1137/090771806).
    """
    flat = white.reshape(len(white), -1)
    guess = np.random.default_rng(0).normal(size=(count + OVERSAMPLING, len(flat)))
    found = np.linalg.qr(flat @ (guess.astype(flat.dtype) @ flat).T)[0].T
    _, axes = np.linalg.eigh((found @ flat) @ (found @ flat).T)
    return np.asarray(axes[:, : -count - 1 : -1].T @ found)
