"""Surface refinement: maximum a posteriori through the tracer.

Heights are ``mean + basis @ c`` with standard normal coefficients c: a Gaussian prior estimated from measured mirrors.
Gauss-Newton steps bring the traced images to the measured ones; what a camera adds to an image (a shift, another
exposure, background, a little blur, another response) enters as a few directions per image with priors of their own and
is marginalised exactly. The curvature at the end gives the uncertainty.

The tracer costs a fraction of a millisecond per image, so the Jacobian is taken by differences: one batched trace of
all coefficients and images.
"""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.errors import InvalidInputError
from model.metrics import flux_accuracy
from model.observation import FLUX_WINDOW, Observation, SurfacePrediction, scene_of
from model.plant import Heliostat
from model.surface import control_points
from model.tracing import Optics, Scene, Window, trace

Array = NDArray[np.float64]

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
    deviations of the nuisance parameters.
    """

    noise: float = 0.02
    correlation: float = 16.0
    iterations: int = 8
    shift_m: float = 0.03
    exposure: float = 0.1
    background: float = 0.02
    blur_m: float = 0.05
    gamma: float = 0.1
    samples: int = 20


def _images(scene: Scene, surfaces: Array, heliostat: Heliostat, optics: Optics, samples: int) -> Array:
    """Traced images (K, M, 64, 64), sum 100, of surfaces (K, 4, 8, 8) [m] under the M suns and targets of a scene."""
    points = np.array([control_points(heliostat, z) for z in surfaces])
    stacked = torch.as_tensor(points, dtype=scene.sun.dtype).movedim(-1, -3).repeat_interleave(scene.batch, dim=0)

    def tiled(values: Tensor) -> Tensor:
        return values.repeat(len(surfaces), *[1] * (values.ndim - 1))

    batch = Scene(
        control_points=stacked,
        attitude=tiled(scene.attitude),
        center=tiled(scene.center),
        sun=tiled(scene.sun),
        plane_center=tiled(scene.plane_center),
        plane_axes=tiled(scene.plane_axes),
    )
    window = Window(FLUX_WINDOW, FLUX_WINDOW, on_spot=True)
    with torch.no_grad():
        flux = trace(batch, window, optics, samples=samples, padding=0.25).normalized()
    return flux.double().numpy().reshape(len(surfaces), scene.batch, *flux.shape[1:])


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


def _whitened(residual: Array, jacobian: Array, image: Array, options: RefinementOptions) -> tuple[Array, Array]:
    """Gradient (K,) and Gauss-Newton matrix (K, K) of one image, its nuisance parameters marginalised.

    With residual r = J dc + N n + noise and n ~ N(0, 1), the noise covariance becomes s^2 + N N', inverted by
    Woodbury's identity.
    """
    sigma = options.noise * image.max() * np.sqrt(options.correlation)
    directions = _nuisance(image, options) / sigma
    r, j = residual.ravel() / sigma, jacobian.reshape(len(jacobian), -1).T / sigma
    inner = np.linalg.inv(np.eye(directions.shape[1]) + directions.T @ directions)
    projected = inner @ (directions.T @ j)
    return j.T @ r - projected.T @ (directions.T @ r), j.T @ j - (directions.T @ j).T @ projected


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
    prior, optics, options = prior or default_prior(), optics or Optics(), options or RefinementOptions()
    measured = np.array([o.flux / o.flux.sum() * 100 for o in observations], dtype=np.float64)
    c = np.zeros(len(prior.basis)) if start is None else prior.coefficients(start)
    for _ in range(options.iterations):
        z = prior.surface(c)
        scene = scene_of(heliostat, observations, z)
        step = 0.25
        surfaces = np.concatenate([z[None], z + step * prior.basis])
        images = _images(scene, surfaces, heliostat, optics, options.samples)
        jacobian = (images[1:] - images[0]) / step
        gradient, curvature = -c, np.eye(len(c))
        for image in range(len(measured)):
            g, h = _whitened(measured[image] - images[0, image], jacobian[:, image], images[0, image], options)
            gradient, curvature = gradient + g, curvature + h
        change = np.linalg.solve(curvature, gradient)
        # A trust region of two standard deviations: beyond it the images are far from linear in the surface.
        change *= min(1.0, 2.0 / np.abs(change).max())
        c = c + change
        if np.abs(change).max() < 0.01:
            break
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
    scene = scene_of(heliostat, observations, z)
    images = _images(scene, z[None], heliostat, optics or Optics(), RefinementOptions().samples)[0]
    return float(
        1 - np.mean([flux_accuracy(o.flux, image.clip(min=0)) for o, image in zip(observations, images, strict=True)])
    )
