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
import torch
from numpy.typing import NDArray

from model.effects import Effect
from model.errors import InvalidInputError
from model.forecast import Aligned, View
from model.metrics import flux_accuracy
from model.observation import FLUX_WINDOW, Observation, SurfacePrediction, align_observations, render_observations
from model.plant import Heliostat
from model.surface import control_points
from model.tracing import Optics

Array = NDArray[np.float64]

STEP_HEIGHT = 3e-5
"""Height [m, root mean square] by which a surface is changed to take a difference of its images."""

BLOCK = 4
"""Pixels along the side of the patches in which residuals of images err together."""

PRIOR = Path(__file__).parent / "weights" / "surface-prior.npz"


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """A Gaussian over surfaces.

    Attributes
    ----------
    mean : (4, 8, 8) [m]
    basis : (K, 4, 8, 8) [m]
        Orthogonal directions, each as long as its standard deviation.
    name : str
        Which file, with its content hash.
    """

    mean: Array
    basis: Array
    name: str = "unnamed"

    @classmethod
    def load(cls, path: Path = PRIOR) -> "SurfacePrior":
        """Read a prior that `training.prior` wrote."""
        content = path.read_bytes()
        with np.load(io.BytesIO(content)) as data:
            name = f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"
            return cls(data["mean"].astype(np.float64), data["basis"].astype(np.float64), name)

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

    ``noise`` is the least standard deviation of a pixel as a share of the image's peak; what the images then turn out
    to err by is taken instead where it is more. ``annealing`` are the noises to begin with, stage by stage: images that
    are trusted little at first let the large features settle before the small ones are looked at. ``shift_m``,
    ``exposure``, ``background`` [of the peak], ``blur_m`` and ``gamma`` are the standard deviations of the nuisance
    parameters; pixels up to ``dark`` [of the peak] are lifted by noise that cannot go below black. Images are compared
    at ``resolution`` pixels a side: the sun has blurred all that is finer. Their changes may be traced more coarsely
    than they themselves, which are few.
    """

    noise: float = 0.005
    annealing: tuple[float, ...] = (0.5, 0.1)
    iterations: int = 10
    estimates: int = 2
    shift_m: float = 0.03
    exposure: float = 0.1
    background: float = 0.02
    blur_m: float = 0.05
    gamma: float = 0.1
    dark: float = 0.01
    resolution: int = 32
    samples: int = 32
    jacobian_samples: int = 12


def _nuisance(image: Array, options: RefinementOptions) -> Array:
    """Directions (n, 7) in which a camera may change an image, each as long as its standard deviation."""
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
        # Noise that is cut at black lifts the dark, and only the dark.
        np.exp(-relative / options.dark) * peak * options.background,
    ]
    return np.stack([d.ravel() for d in directions], axis=-1)


@dataclass(frozen=True, eq=False)
class _State:
    """Coefficients (K,), where the mirror they make stands before each sun, and its images (M, R, R) of sum 100."""

    c: Array
    aligned: Aligned
    images: Array


class _Posterior:
    """The posterior of one heliostat's surface, in coefficients of the prior."""

    def __init__(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        prior: SurfacePrior,
        model: tuple[Optics, Sequence[Effect]],
        options: RefinementOptions,
    ) -> None:
        self.heliostat, self.observations = heliostat, observations
        self.prior, self.options = prior, options
        self.optics, self.effects = model
        self.view = View(options.resolution, options.resolution, window=FLUX_WINDOW)
        self.measured = _binned(np.array([o.flux for o in observations], dtype=np.float64), options.resolution)
        # The same height for each direction: small enough for images to be linear in it, large enough to stand out from
        # their last digits.
        height = np.sqrt((prior.basis**2).mean(axis=(1, 2, 3)))
        self.steps = np.clip(STEP_HEIGHT / height, 0.1, 4.0)
        ideal = control_points(heliostat)
        normals = control_points(heliostat, np.ones_like(prior.mean)) - ideal
        changes = np.einsum("k,kfij,fijc->kfcij", self.steps, _untilted(prior.basis, ideal), normals)
        self.changes = torch.as_tensor(changes, dtype=torch.float32)

    def _photographs(self, aligned: Aligned, samples: int) -> Array:
        """Images (B, R, R), sum 100, of mirrors that stand."""
        with torch.no_grad():
            images = aligned.images(self.optics, self.effects, replace(self.view, samples=samples)).double().numpy()
        return np.asarray(100 * images / images.sum(axis=(1, 2), keepdims=True))

    def state(self, c: Array) -> _State:
        """The mirror of coefficients (K,) before its suns."""
        aligned = align_observations(self.heliostat, self.observations, self.prior.surface(c), self.effects)
        return _State(c, aligned, self._photographs(aligned, self.options.samples))

    def jacobian(self, state: _State) -> Array:
        """Change of the images per coefficient (K, M, R, R).

        The mount takes back what a change tilts the mirror as a whole (`_untilted`).
        """
        (group,), samples = state.aligned.groups, self.options.jacobian_samples
        points = (group.scene.control_points + self.changes[:, None]).flatten(0, 1)
        scene = group.scene.repeated(len(self.changes)).with_(control_points=points)
        planes = group.planes * len(self.changes)
        stacked = replace(group, rows=list(range(scene.batch)), planes=planes, scene=scene)
        changed = self._photographs(Aligned((stacked,)), samples).reshape(len(self.changes), *state.images.shape)
        return np.asarray((changed - self._photographs(state.aligned, samples)) / self.steps[:, None, None, None])

    def _whitened(self, image: Array, noise: float) -> tuple[float, Array, Array]:
        """Noise of an image's pixels, its nuisance directions over that noise (n, 7), and Woodbury's inner inverse.

        With residual r = J dc + N n + noise and n ~ N(0, 1), the noise covariance is s^2 + N N'.
        """
        sigma = noise * float(image.max())
        directions = _nuisance(image, self.options) / sigma
        inner = np.linalg.inv(np.eye(directions.shape[1]) + directions.T @ directions)
        return sigma, directions, np.asarray(inner, dtype=np.float64)

    def cost(self, state: _State, noise: float) -> float:
        """Negative logarithm of the posterior density, to a constant."""
        total = float(state.c @ state.c)
        for measured, image in zip(self.measured, state.images, strict=True):
            sigma, directions, inner = self._whitened(image, noise)
            r = (measured - image).ravel() / sigma
            along = directions.T @ r
            total += float(r @ r - along @ inner @ along)
        return total / 2

    def quadratic(self, state: _State, noise: float) -> tuple[Array, Array]:
        """Downhill gradient (K,) and Gauss-Newton curvature (K, K) of the cost."""
        gradient, curvature = -state.c, np.eye(len(state.c))
        jacobian = self.jacobian(state)
        for index, (measured, image) in enumerate(zip(self.measured, state.images, strict=True)):
            sigma, directions, inner = self._whitened(image, noise)
            r = (measured - image).ravel() / sigma
            j = jacobian[:, index].reshape(len(state.c), -1).T / sigma
            projected = inner @ (directions.T @ j)
            gradient = gradient + j.T @ r - projected.T @ (directions.T @ r)
            curvature = curvature + j.T @ j - (directions.T @ j).T @ projected
        return gradient, curvature

    def maximise(self, state: _State, noise: float) -> tuple[_State, Array]:
        """The state of the highest density near another and the curvature (K, K) there (Levenberg-Marquardt)."""
        damping, cost = 0.1, self.cost(state, noise)
        for _ in range(self.options.iterations):
            gradient, curvature = self.quadratic(state, noise)
            for _ in range(6):
                change = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient)
                trial = self.state(state.c + change)
                trial_cost = self.cost(trial, noise)
                if trial_cost < cost:
                    break
                damping *= 4
            else:
                return state, curvature
            gain, cost, state = cost - trial_cost, trial_cost, trial
            damping = max(damping / 5, 1e-4)
            if gain < 0.5:
                break
        return state, curvature

    def noise(self, state: _State) -> float:
        """Standard deviation of a pixel, of the peak, that what the state leaves of the images amounts to.

        Residuals of a model that lacks something are patches, not grains, and pixels counted one by one would be
        trusted far too much: sums over blocks of ``BLOCK`` pixels a side say how many of them err together.
        """
        grain, patch = 0.0, 0.0
        for measured, image in zip(self.measured, state.images, strict=True):
            directions = _nuisance(image, self.options)
            residual = (measured - image).ravel() / image.max()
            residual -= directions @ np.linalg.lstsq(directions, residual, rcond=None)[0]
            grain += residual.var()
            patch += _binned(residual.reshape(1, *image.shape), image.shape[0] // BLOCK).var() / BLOCK**2
        return max(self.options.noise, float(np.sqrt(max(grain, patch) / len(self.measured))))


def _untilted(z: Array, ideal: Array) -> Array:
    """Heights (K, F, I, J) [m] over ideal control points (F, I, J, 3) [m] without the tilt of the whole mirror."""
    modes = np.moveaxis(ideal[..., :2] - ideal[..., :2].mean(axis=(1, 2), keepdims=True), -1, 0).reshape(2, -1)
    flat = z.reshape(len(z), -1)
    return np.asarray((flat - flat @ np.linalg.pinv(modes) @ modes).reshape(z.shape))


def _binned(images: Array, resolution: int) -> Array:
    """Images (M, n, n) at ``resolution`` pixels a side, their sums kept."""
    size = images.shape[-1] // resolution
    return np.asarray(images.reshape(-1, resolution, size, resolution, size).sum(axis=(2, 4)))


def refine(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    start: NDArray[np.float64] | None = None,
    *,
    prior: SurfacePrior | None = None,
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
    options: RefinementOptions | None = None,
) -> SurfacePrediction:
    """The most probable surface of a heliostat, given its images and a model with these optics and effects.

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
    posterior = _Posterior(heliostat, observations, prior, (optics, effects), options)
    state = posterior.state(np.zeros(len(prior.basis)) if start is None else prior.coefficients(start))
    for noise in options.annealing:
        state, _ = posterior.maximise(state, noise)
    for _ in range(options.estimates):
        state, curvature = posterior.maximise(state, posterior.noise(state))
    z = prior.surface(state.c)
    covariance = np.linalg.inv(curvature)
    variance = np.einsum("kfij,kl,lfij->fij", prior.basis, covariance, prior.basis, optimize=True)
    return SurfacePrediction(
        z=z,
        z_std=np.sqrt(variance),
        control_points=control_points(heliostat, z),
        method="refined",
        weights=prior.name,
        misfit=misfit(heliostat, observations, z, optics, effects),
        used=tuple(o.identifier for o in observations),
    )


def misfit(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    z: NDArray[np.float64],
    optics: Optics | None = None,
    effects: Sequence[Effect] = (),
) -> float:
    """One minus the mean accuracy with which heights ``z`` (4, 8, 8) [m] re-render the images they came from."""
    images = render_observations(heliostat, observations, z, optics, effects).clip(min=0)
    return float(1 - np.mean([flux_accuracy(o.flux, image) for o, image in zip(observations, images, strict=True)]))
