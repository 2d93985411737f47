"""Surface refinement: maximum a posteriori through the tracer.

Heights are ``mean + basis @ c`` with standard normal coefficients c: a Gaussian prior estimated from measured mirrors.
Levenberg-Marquardt steps bring the traced images to the measured ones; what a camera adds to an image (a shift, another
exposure, background, a little blur, another response) enters as a few directions per image with priors of their own and
is marginalised exactly. The curvature at the end gives the uncertainty.

The tracer costs a fraction of a millisecond per image, so the Jacobian is taken by differences: one batched trace of
all coefficients and images.
"""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.metrics import flux_accuracy
from model.observation import FLUX_WINDOW, Observation, SurfacePrediction, render_observations
from model.plant import Heliostat
from model.surface import control_points
from model.tracing import Optics

Array = NDArray[np.float64]

STEP_HEIGHT = 3e-5
"""Height [m, root mean square] by which a surface is changed to take a difference of its images."""

PRIOR = Path(__file__).parent / "weights" / "surface-prior.npz"


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """A Gaussian over surfaces.

    Attributes
    ----------
    mean : (4, 8, 8) [m]
    basis : (K, 4, 8, 8) [m]
        Orthogonal directions, each as long as its standard deviation.
    residual : float [m]
        Standard deviation per control point of what the basis leaves out.
    name : str
        Which file, with its content hash.
    """

    mean: Array
    basis: Array
    residual: float
    name: str = "unnamed"

    @classmethod
    def load(cls, path: Path = PRIOR) -> "SurfacePrior":
        """Read a prior that `training.prior` wrote."""
        content = path.read_bytes()
        with np.load(io.BytesIO(content)) as data:
            name = f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"
            mean, basis = data["mean"].astype(np.float64), data["basis"].astype(np.float64)
            return cls(mean, basis, float(data["residual"]), name)

    def coefficients(self, z: Array) -> Array:
        """Coefficients (K,) of the surface of the prior's span nearest to ``z`` (4, 8, 8) [m]."""
        flat = self.basis.reshape(len(self.basis), -1)
        return np.asarray(flat @ (z - self.mean).ravel() / (flat**2).sum(axis=1))

    def surface(self, coefficients: Array) -> Array:
        """Heights (4, 8, 8) [m] of coefficients (K,)."""
        return np.asarray(self.mean + np.tensordot(coefficients, self.basis, axes=1))


@lru_cache(maxsize=1)
def default_prior() -> SurfacePrior:
    """The shipped prior, loaded once."""
    return SurfacePrior.load()


@dataclass(frozen=True)
class RefinementOptions:
    """How images are trusted.

    ``noise`` is the standard deviation of a pixel as a share of the image's peak, before ``correlation`` pixels are
    taken to err together; residuals of real images are correlated, and pixels counted one by one would be trusted
    far too much. ``shift_m``, ``exposure``, ``background`` [of the peak], ``blur_m`` and ``gamma`` are the standard
    deviations of the nuisance parameters. ``annealing`` multiplies the noise, stage by stage: images that are trusted
    little at first let the large features settle before the small ones are looked at.
    """

    noise: float = 0.02
    correlation: float = 16.0
    iterations: int = 12
    annealing: tuple[float, ...] = (10.0, 3.0, 1.0)
    shift_m: float = 0.03
    exposure: float = 0.1
    background: float = 0.02
    blur_m: float = 0.05
    gamma: float = 0.1
    samples: int = 24


def _nuisance(image: Array, options: RefinementOptions) -> Array:
    """Directions (64 * 64, 6) in which a camera may change an image, each as long as its standard deviation."""
    pixel = FLUX_WINDOW / image.shape[0]
    up, right = np.gradient(image, pixel)
    laplacian = np.gradient(up, pixel, axis=0) + np.gradient(right, pixel, axis=1)
    peak = image.max()
    relative = np.clip(image / peak, 1e-4, None)
    directions = [
        right * options.shift_m,
        up * options.shift_m,
        image * options.exposure,
        np.full_like(image, peak * options.background),
        laplacian * options.blur_m**2 / 2,
        image * np.log(relative) * options.gamma,
    ]
    return np.stack([d.ravel() for d in directions], axis=-1)


class _Posterior:
    """The posterior of one heliostat's surface, in coefficients of the prior."""

    def __init__(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        prior: SurfacePrior,
        optics: Optics,
        options: RefinementOptions,
    ) -> None:
        self.heliostat, self.observations = heliostat, observations
        self.prior, self.optics, self.options = prior, optics, options
        self.measured = np.array([o.flux / o.flux.sum() * 100 for o in observations], dtype=np.float64)

    def images(self, surfaces: Array) -> Array:
        """Traced images (K, M, 64, 64) of surfaces (K, 4, 8, 8) [m]."""
        return render_observations(
            self.heliostat, self.observations, list(surfaces), self.optics, samples=self.options.samples
        )

    def _nuisances(self, image: Array) -> tuple[float, Array, Array]:
        """Noise of an image's pixels, its nuisance directions over that noise (n, 6), and Woodbury's inner inverse.

        With residual r = J dc + N n + noise and n ~ N(0, 1), the noise covariance is s^2 + N N'.
        """
        sigma = self.options.noise * float(image.max()) * self.options.correlation**0.5
        directions = _nuisance(image, self.options) / sigma
        return sigma, directions, np.linalg.inv(np.eye(directions.shape[1]) + directions.T @ directions)

    def cost(self, c: Array, traced: Array) -> float:
        """Negative logarithm of the posterior density at coefficients (K,) with images (M, 64, 64), to a constant."""
        total = float(c @ c)
        for measured, image in zip(self.measured, traced, strict=True):
            sigma, directions, inner = self._nuisances(image)
            r = (measured - image).ravel() / sigma
            along = directions.T @ r
            total += float(r @ r - along @ inner @ along)
        return total / 2

    def quadratic(self, c: Array, traced: Array, jacobian: Array) -> tuple[Array, Array]:
        """Downhill gradient (K,) and Gauss-Newton curvature (K, K) of the cost; jacobian (K, M, 64, 64)."""
        gradient, curvature = -c, np.eye(len(c))
        for index, (measured, image) in enumerate(zip(self.measured, traced, strict=True)):
            sigma, directions, inner = self._nuisances(image)
            r = (measured - image).ravel() / sigma
            j = jacobian[:, index].reshape(len(c), -1).T / sigma
            projected = inner @ (directions.T @ j)
            gradient = gradient + j.T @ r - projected.T @ (directions.T @ r)
            curvature = curvature + j.T @ j - (directions.T @ j).T @ projected
        return gradient, curvature

    def _steps(self) -> Array:
        """Steps (K, 1, 1, 1) of the differences: the same height for each direction.

        Small enough for the images to be linear in it, large enough to stand out from their last digits.
        """
        height = np.sqrt((self.prior.basis**2).mean(axis=(1, 2, 3), keepdims=True))
        return np.asarray(np.clip(STEP_HEIGHT / height, 0.1, 4.0))

    def maximise(self, c: Array) -> tuple[Array, Array]:
        """Coefficients (K,) of the highest density near ``c`` and the curvature (K, K) there (Levenberg-Marquardt)."""
        damping, steps = 0.1, self._steps()
        images = self.images(self.prior.surface(c)[None])[0]
        cost = self.cost(c, images)
        for _ in range(self.options.iterations):
            z = self.prior.surface(c)
            shifted = self.images(z + steps * self.prior.basis)
            gradient, curvature = self.quadratic(c, images, (shifted - images) / steps)
            for _ in range(6):
                change = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient)
                trial = c + change
                trial_images = self.images(self.prior.surface(trial)[None])[0]
                trial_cost = self.cost(trial, trial_images)
                if trial_cost < cost:
                    break
                damping *= 4
            else:
                return c, curvature
            gain, cost, c, images = cost - trial_cost, trial_cost, trial, trial_images
            damping = max(damping / 5, 1e-4)
            if gain < 0.05:
                break
        return c, curvature


def refine(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    start: NDArray[np.float64] | None = None,
    *,
    prior: SurfacePrior | None = None,
    optics: Optics | None = None,
    options: RefinementOptions | None = None,
) -> SurfacePrediction:
    """The most probable surface of a heliostat, given its images.

    Parameters
    ----------
    heliostat : Heliostat
    observations : sequence of Observation
        Any number from one.
    start : (4, 8, 8) [m], optional
        Where to begin, the network's prediction, say; the prior's mean unless given.

    Raises
    ------
    InvalidInputError
        Without images.
    """
    if not observations:
        raise InvalidInputError("a refinement takes at least one image")
    prior, optics = prior or default_prior(), optics or Optics()
    options = options or RefinementOptions()
    c = np.zeros(len(prior.basis)) if start is None else prior.coefficients(start)
    for factor in options.annealing:
        softened = replace(options, noise=options.noise * factor)
        c, curvature = _Posterior(heliostat, observations, prior, optics, softened).maximise(c)
    z = prior.surface(c)
    covariance = np.linalg.inv(curvature)
    variance = np.einsum("kfij,kl,lfij->fij", prior.basis, covariance, prior.basis, optimize=True) + prior.residual**2
    return SurfacePrediction(
        z=z,
        z_std=np.sqrt(variance),
        control_points=control_points(heliostat, z),
        method="refined",
        weights=prior.name,
        misfit=misfit(heliostat, observations, z, optics),
        used=tuple(o.identifier for o in observations),
    )


def misfit(
    heliostat: Heliostat, observations: Sequence[Observation], z: NDArray[np.float64], optics: Optics | None = None
) -> float:
    """One minus the mean accuracy with which heights ``z`` (4, 8, 8) [m] re-render the images they came from."""
    images = render_observations(heliostat, observations, [z], optics)[0]
    return float(
        1 - np.mean([flux_accuracy(o.flux, image.clip(min=0)) for o, image in zip(observations, images, strict=True)])
    )
