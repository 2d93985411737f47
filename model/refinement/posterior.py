"""The posterior of a surface: its cost, and its Gaussian approximation at a state.

Notes
-----
With the whitener W of the images, the residual ``r = W (measured - images)``, the Jacobian ``J = W
d images / d c`` and the prior's precision P of the coefficients c::

    cost        = (c' P c + r' r) / 2
    gradient    = J' r - P c                      downhill
    curvature   = J' J + P                        Gauss-Newton
    covariance  = (J' J + P)^-1

Image i contributes ``information F_i = J_i' J_i`` and ``score g_i = J_i' r_i``. In the code the
first index of a Jacobian is the coefficient.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.least_squares import Quadratic
from model.refinement.image_model import ImageModel, SurfaceState
from model.refinement.whitening import BANDS, Whitener

Array = NDArray[np.float64]

MIN_IMAGES_FOR_OUTLIER_TEST = 4
"""Smallest number of images by which one may be found to contradict the others."""

CONTRADICTION = 3.0
"""Smallest ratio of a contradicting image's leave-one-out error to the median of all images."""

DARK_SHARE = 0.1
"""Flux [of the peak] above which the noise of a pixel grows with the root of the flux."""


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """Noise of the images and precision of the prior, which are estimated from the images.

    Attributes
    ----------
    sigma : (M, 5), or (1, 5) for equal images [of the peak]
        Standard deviation of the noise in each of `model.refinement.whitening.BANDS`.
    precision : (K,)
        Of the prior of each coefficient.
    """

    sigma: Array
    precision: Array

    @classmethod
    def uniform(cls, sigma: float, n_coefficients: int) -> "Hyperparameters":
        """The same noise in all bands, and the prior's scales as they are."""
        return cls(np.full((1, len(BANDS)), sigma), np.ones(n_coefficients))


@dataclass(frozen=True, eq=False)
class Mode:
    """A local maximum of the posterior, or a state near one.

    Attributes
    ----------
    state : SurfaceState
    jacobian : (K, M, R, R)
        Of the images by the prior's coefficients, at the state or at one shortly before.
    hyper : Hyperparameters
        Given which it is the maximum.
    cost : float
    """

    state: SurfaceState
    jacobian: NDArray[Any]
    hyper: Hyperparameters
    cost: float = np.nan

    def whitener(self, model: ImageModel) -> Whitener:
        """The whitener of the state's images, which are those of a model."""
        size_errors = np.array([o.size_error for o in model.observations])
        return Whitener(self.state.images, self.hyper.sigma, DARK_SHARE, model.side, size_errors)


class PosteriorCost:
    """The negative log posterior as a problem of `model.least_squares`."""

    def __init__(self, model: ImageModel, mode: Mode) -> None:
        self.model, self.precision, self.whitener = (
            model,
            mode.hyper.precision,
            mode.whitener(model),
        )

    def cost(self, state: SurfaceState) -> float:
        """Half the sum of squares."""
        residual = self.whitener(self.model.measured - state.images)
        return (
            float(state.coefficients @ (self.precision * state.coefficients) + (residual**2).sum())
            / 2
        )

    def jacobian(self, state: SurfaceState) -> NDArray[Any]:
        """Derivatives (K, M, R, R) of the images by the prior's coefficients."""
        return self.model.jacobian(state)

    @cached_property
    def _ripples(self) -> NDArray[Any]:
        """Whitened Jacobian (N, M n) of the ripples."""
        return self._flat(self.model.ripples)

    @cached_property
    def _ripple_curvature(self) -> NDArray[Any]:
        """Curvature (N, N) of the ripples, which is the same at all states."""
        return np.asarray(self._ripples @ self._ripples.T)

    def quadratic(self, state: SurfaceState, jacobian: NDArray[Any]) -> Quadratic:
        """Downhill gradient (K,) and curvature (K, K)."""
        smooth, fine = self._flat(jacobian), self._ripples
        (residual,) = self._flat((self.model.measured - state.images)[None].astype(smooth.dtype))
        mixed = smooth @ fine.T
        curvature = np.block(
            [[smooth @ smooth.T, mixed], [mixed.T, self._ripple_curvature]]
        ).astype(np.float64)
        gradient = np.concatenate([smooth @ residual, fine @ residual]).astype(np.float64)
        return Quadratic(
            gradient - self.precision * state.coefficients, curvature + np.diag(self.precision)
        )

    def bounds(self, state: SurfaceState) -> None:
        """None: coefficients have no bounds."""
        return None

    def step(self, state: SurfaceState, change: Array) -> SurfaceState:
        """The state after a change (K,) of the coefficients."""
        return self.model.state(state.coefficients + change, state)

    def _flat(self, changes: NDArray[Any]) -> NDArray[Any]:
        """Whitened changes (K, M n) of changes (K, M, R, R)."""
        white = self.whitener(changes)
        return np.asarray(white.reshape(len(white), np.prod(white.shape[1:], dtype=int)))


class FacetLight(NamedTuple):
    """Light (F,) of each facet relative to the mean of the others, minus one; its deviation."""

    excess: Array
    std: Array


@dataclass(frozen=True, eq=False)
class Linearization:
    """The Gaussian approximation of the posterior at a state.

    Attributes
    ----------
    hyper : Hyperparameters
    jacobian, residual : (K, M, n), (M, n)
        J and r, whitened; with the ripples.
    bands : (n,)
        The band of each mode.
    """

    hyper: Hyperparameters
    jacobian: NDArray[Any]
    residual: Array
    bands: NDArray[np.int64]

    @cached_property
    def covariance(self) -> Array:
        """Posterior covariance (K, K) of the coefficients."""
        return self._weighted_covariance(np.ones((1, len(BANDS))))

    def _weighted_covariance(self, weight: Array) -> Array:
        """Posterior covariance (K, K) with weights (M, 5) or (1, 5) of the bands."""
        weighted = self.jacobian * np.sqrt(weight[:, self.bands]).astype(np.float32)
        flat = weighted.reshape(len(self.jacobian), -1)
        return np.asarray(
            np.linalg.inv((flat @ flat.T).astype(np.float64) + np.diag(self.hyper.precision))
        )

    def shared_error_covariance(self, grain: float) -> Array:
        """Posterior covariance (K, K) if all images share their errors, except for a ``grain`` [of
        the peak].

        Each part of the noise's variance that all share counts once for each image.
        """
        shared = np.clip(1 - (grain / self.hyper.sigma) ** 2, 0, None)
        return self._weighted_covariance(1 / (1 + (len(self.residual) - 1) * shared))

    @cached_property
    def noise_covariance(self) -> Array:
        """The part (K, K) of the covariance that is due to the noise of the images: C - C P C."""
        return np.asarray(
            self.covariance - (self.covariance * self.hyper.precision) @ self.covariance
        )

    def information(self) -> Iterator[Array]:
        """F_i (K, K) of each image in turn; those of 64 images together would be 230 MB."""
        for of_image in self.jacobian.swapaxes(0, 1):
            yield (of_image @ of_image.T).astype(np.float64)

    @cached_property
    def scores(self) -> Array:
        """g_i (M, K) of each image."""
        of_images = zip(self.jacobian.swapaxes(0, 1), self.residual, strict=True)
        return np.array([of_image @ residual for of_image, residual in of_images])

    def information_shares(self) -> Array:
        """Share (M,) of each image in tr(C F_i), the number of determined coefficients."""
        determined = np.array([(one * self.covariance).sum() for one in self.information()])
        return np.asarray(determined / determined.sum())

    def estimate_sigma(self) -> Array:
        """Re-estimate the noise (M, 5): one factor for each band, another for each image.

        The squares of the residuals are divided by their effective number, the leverages ``diag(J C
        J')`` subtracted (MacKay 1992, doi:10.1162/neco.1992.4.3.415).
        """
        projected = np.tensordot(self.covariance.astype(np.float32), self.jacobian, axes=1)
        free = 1 - np.einsum("kmn,kmn->mn", self.jacobian, projected)
        n_free = np.maximum(np.bincount(self.bands, free.sum(axis=0)), 1)
        of_band = np.bincount(self.bands, (self.residual**2).sum(axis=0)) / n_free
        of_image = (self.residual**2 / of_band[self.bands]).sum(axis=1) / np.maximum(
            free.sum(axis=1), 1
        )
        return np.asarray(self.hyper.sigma * np.sqrt(of_band * of_image[:, None]))

    def overdispersion(self) -> float:
        """Ratio of the scores' squares, ``sum g_i' C g_i``, to their expectation under independent
        noise.

        Errors that look like a bent mirror make it larger than one (quasi-likelihood, Wedderburn
        1974, doi:10.1093/biomet/61.3.439).
        """
        determined = (self.covariance @ of_image for of_image in self.information())
        expected = sum(float(np.trace(one) - (one * one.T).sum()) for one in determined)
        return float(
            np.einsum("mi,ij,mj->", self.scores, self.covariance, self.scores) / max(expected, 1.0)
        )

    def find_contradicting(self) -> int | None:
        """The image that the others contradict most, if they do."""
        if len(self.residual) < MIN_IMAGES_FOR_OUTLIER_TEST:
            return None
        errors = self.leave_one_out_errors()
        return int(errors.argmax()) if errors.max() > CONTRADICTION * np.median(errors) else None

    def leave_one_out_errors(self) -> Array:
        """Mean square error (M,) with which all other images predict each image, to first order.

        By how much the cost falls without the image, divided by the number of its modes.
        """
        return np.asarray((self.leave_one_out_residuals() * self.residual).mean(axis=1))

    def leave_one_out_residuals(self) -> Array:
        """Residuals (M, n) of each image by the surface from all others, to first order.

        The surface without image i differs by ``(I - C F_i)^-1 C g_i``.
        """
        identity = np.eye(len(self.covariance))
        others = (identity - of_image @ self.covariance for of_image in self.information())
        change = np.array([*map(np.linalg.solve, others, self.scores)]) @ self.covariance
        return np.asarray(
            self.residual + np.einsum("mk,kmn->mn", change, self.jacobian, optimize=True)
        )

    def facet_light(self, jacobian: Array) -> FacetLight:
        """Estimate the light of each facet together with the surface.

        ``jacobian`` (F, M, n) are the whitened derivatives of the images by the light. The light of
        a single facet cannot be compared.
        """
        count = len(jacobian)
        if count == 1:
            return FacetLight(np.zeros(1), np.full(1, np.inf))
        flat = (
            np.concatenate([self.jacobian, jacobian])
            .reshape(len(self.jacobian) + count, -1)
            .astype(np.float64)
        )
        precision = np.diag(np.concatenate([self.hyper.precision, np.ones(count)]))
        covariance = np.linalg.inv(flat @ flat.T + precision)
        # At the optimum the gradient by the surface is zero, its prior's included.
        gradient = np.concatenate(
            [np.zeros(len(self.jacobian)), flat[-count:] @ self.residual.ravel()]
        )
        to_excess = (np.eye(count) * count - 1) / (count - 1)
        light, of_light = (covariance @ gradient)[-count:], covariance[-count:, -count:]
        return FacetLight(to_excess @ light, np.sqrt(np.diag(to_excess @ of_light @ to_excess)))


def linearize(model: ImageModel, mode: Mode) -> Linearization:
    """The Gaussian approximation of the posterior at a mode."""
    whitener = mode.whitener(model)
    white = np.concatenate([whitener(mode.jacobian), whitener(model.ripples)])
    return Linearization(
        mode.hyper, white, whitener(model.measured - mode.state.images), whitener.bands
    )
