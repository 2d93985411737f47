"""Surface refinement: maximum a posteriori through the tracer.

Heights are ``mean + basis @ c`` with standard normal coefficients c: a Gaussian prior estimated from measured mirrors.
Levenberg-Marquardt steps bring the traced images to the measured ones; what a camera adds to an image (a shift, another
exposure, background, a little blur, another response) enters as a few directions per image with priors of their own and
is marginalised exactly. The curvature at the end gives the uncertainty.

The Jacobian is taken by differences, one batched trace of all coefficients and images. That is most of the work, so a
Jacobian serves many steps, and every step corrects it by what the images really did (Broyden 1965).

Light from four facets lies in one spot, and facets can take each other's part: the posterior has several local
optima. The optimisation starts from every guess there is, and the best local optimum is taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from model.effects import Effect
from model.errors import InvalidInputError
from model.forecast import Aligned
from model.images import COARSE_SIZE, FLUX_WINDOW, binned
from model.least_squares import Descent, minimize
from model.network.inputs import STEP_HEIGHT
from model.observation import Observation, Ranges, SurfacePrediction, align_observations, misfits
from model.plant import Heliostat
from model.prior import SurfacePrior, default_prior
from model.surface import control_points, require_own_grid
from model.tracing import Optics

Array = NDArray[np.float64]

BLOCK = 4
"""Pixels along the side of the patches in which residuals of images err together."""

DESCENT = Descent(
    steps=16,
    jacobians=1,
    corrected=True,
    damping=0.1,
    raising=4.0,
    least_damping=1e-4,
    most_damping=100.0,
    least_gain=0.5,
)
"""How the minimum of the negative log posterior is sought; a gain of half a unit is none."""


@dataclass(frozen=True)
class RefinementOptions:
    """How images are trusted.

    ``noise`` is the least standard deviation of a pixel as a share of the image's peak; what the images then turn out
    to err by, times ``noise_share``, is taken instead where it is more, in several ``rounds``. Errors of a model that
    lacks something come in patches, in which pixels err together and must not be counted one by one: variance that
    blocks of `BLOCK` pixels a side have beyond that of grain counts ``patches`` times. ``annealing`` are the noises to
    begin with, stage by stage, with the ``leading`` directions of the prior: images that are trusted little at first
    let the large features settle before the small ones are looked at. ``calibration`` is how many times the images'
    variance is counted in the uncertainty: the curvature at one local optimum knows nothing of others nearby. It was
    chosen so that 90 % intervals hold nine of ten heights of mirrors left out, in five folds.
    ``shift_m``, ``exposure``, ``background`` [of the peak], ``blur_m`` and ``gamma`` are the standard deviations of the
    nuisance parameters; pixels up to ``dark`` [of the peak] are lifted by noise that cannot go below black. Images are
    compared at ``resolution`` pixels a side. Their changes may be traced more
    coarsely than they themselves, which are few.
    """

    noise: float = 0.005
    noise_share: float = 0.7
    patches: float = 32.0
    rounds: int = 4
    annealing: tuple[float, ...] = (0.5, 0.1, 0.03)
    leading: int = 60
    steps: int = 16
    calibration: float = 30.0
    shift_m: float = 0.03
    exposure: float = 0.1
    background: float = 0.02
    blur_m: float = 0.05
    gamma: float = 0.1
    dark: float = 0.01
    resolution: int = COARSE_SIZE
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
    """Coefficients (K,), the mirror they make as aligned under each sun, and its images (M, R, R) of sum 100."""

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
        latitude_deg: float,
        options: RefinementOptions,
    ) -> None:
        self.heliostat, self.observations = heliostat, observations
        self.prior, self.options = prior, options
        (self.optics, self.effects), self.latitude_deg = model, latitude_deg
        self.ranges = Ranges(observations, options.resolution)
        self.measured = binned(np.array([o.flux for o in observations], dtype=np.float64), options.resolution)
        # The same height for each direction: small enough for images to be linear in it, large enough to stand out from
        # their last digits.
        height = np.sqrt((prior.basis**2).mean(axis=(1, 2, 3)))
        self.steps = np.clip(STEP_HEIGHT / height, 0.1, 4.0)
        untilted = _untilted(prior.basis, control_points(heliostat))
        changes = np.einsum("k,kfij,fc->kfcij", self.steps, untilted, heliostat.facet_normals)
        self.changes = torch.as_tensor(changes, dtype=torch.float32)

    def _rendered(self, aligned: Aligned, samples: int) -> Array:
        """Images (B, R, R), sum 100, of aligned mirrors, the M observations over and over, as the cameras show them."""
        with torch.no_grad():
            images = aligned.flux_images(self.optics, self.effects, size=self.options.resolution, samples=samples)
            each = images.double().view(-1, *self.measured.shape)
        return np.asarray(self.ranges.seen(each).flatten(0, 1).numpy())

    def state(self, c: Array) -> _State:
        """The mirror of coefficients (K,), aligned under each sun."""
        aligned = align_observations(
            self.heliostat, self.observations, self.prior.surface(c), self.effects, latitude_deg=self.latitude_deg
        )
        return _State(c, aligned, self._rendered(aligned, self.options.samples))

    def jacobian(self, state: _State, count: int) -> Array:
        """Change of the images per coefficient (count, M, R, R), of the first so many.

        The mount takes back what a change tilts the mirror as a whole (`_untilted`).
        """
        (group,), samples, changes = state.aligned.groups, self.options.jacobian_samples, self.changes[:count]
        points = (group.scene.control_points + changes[:, None]).flatten(0, 1)
        scene = group.scene.repeated(count).with_(control_points=points)
        stacked = replace(group, rows=list(range(scene.batch)), planes=group.planes * count, scene=scene)
        changed = self._rendered(Aligned((stacked,)), samples).reshape(count, *state.images.shape)
        return np.asarray((changed - self._rendered(state.aligned, samples)) / self.steps[:count, None, None, None])

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

    def quadratic(self, state: _State, jacobian: Array, noise: float) -> tuple[Array, Array]:
        """Downhill gradient (k,) and Gauss-Newton curvature (k, k) of the cost, in a Jacobian's k coefficients."""
        count = len(jacobian)
        gradient, curvature = -state.c[:count], np.eye(count)
        for index, (measured, image) in enumerate(zip(self.measured, state.images, strict=True)):
            sigma, directions, inner = self._whitened(image, noise)
            r = (measured - image).ravel() / sigma
            j = jacobian[:, index].reshape(count, -1).T / sigma
            projected = inner @ (directions.T @ j)
            gradient = gradient + j.T @ r - projected.T @ (directions.T @ r)
            curvature = curvature + j.T @ j - (directions.T @ j).T @ projected
        return gradient, curvature

    def moved(self, state: _State, change: Array) -> _State:
        """The mirror after a change (k,) of its first coefficients."""
        return self.state(state.c + np.pad(change, (0, len(state.c) - len(change))))

    def optimize(self, state: _State, noise: float, jacobian: Array, retraced: int = 1) -> tuple[_State, Array]:
        """The state of the highest density near another, in a Jacobian's (k, M, R, R) coefficients, and its Jacobian.

        The Jacobian is traced anew up to ``retraced`` times, where corrections no longer help.
        """
        descent = replace(DESCENT, steps=self.options.steps, jacobians=retraced)
        found = minimize(_Problem(self, noise, len(jacobian)), state, descent, jacobian)
        return found.state, found.jacobian

    def optimum(self, c: Array) -> tuple[_State, Array]:
        """The local optimum near coefficients (K,) and the Jacobian there: large features first, then all."""
        state, options = self.state(c), self.options
        jacobian = self.jacobian(state, min(options.leading, len(c)))
        for noise in options.annealing:
            state, jacobian = self.optimize(state, noise, jacobian)
        jacobian = self.jacobian(state, len(c))
        for left in reversed(range(options.rounds)):
            state, jacobian = self.optimize(
                state, self.noise(state, options.noise_share), jacobian, retraced=int(left == 0)
            )
        return state, jacobian

    def covariance(self, state: _State, jacobian: Array) -> Array:
        """Covariance (K, K) of the coefficients: the inverse curvature, the images' noise counted more than once."""
        _, curvature = self.quadratic(state, jacobian, self.noise(state) * np.sqrt(self.options.calibration))
        return np.asarray(np.linalg.inv(curvature), dtype=np.float64)

    def noise(self, state: _State, share: float = 1.0) -> float:
        """Standard deviation of a pixel, of the peak: a ``share`` of what the state leaves of the images."""
        grain, patch = 0.0, 0.0
        for measured, image in zip(self.measured, state.images, strict=True):
            directions = _nuisance(image, self.options)
            residual = (measured - image).ravel() / image.max()
            residual -= directions @ np.linalg.lstsq(directions, residual, rcond=None)[0]
            grain += residual.var()
            patch += binned(residual.reshape(1, *image.shape), image.shape[0] // BLOCK).var() / BLOCK**2
        variance = (grain + self.options.patches * max(0.0, patch - grain)) / len(self.measured)
        return max(self.options.noise, share * float(np.sqrt(variance)))


@dataclass(frozen=True, eq=False)
class _Problem:
    """A posterior as a least-squares problem: in its first ``count`` coefficients, with one ``noise`` of images."""

    posterior: _Posterior
    noise: float
    count: int

    def cost(self, state: _State) -> float:
        return self.posterior.cost(state, self.noise)

    def response(self, state: _State) -> Array:
        return state.images

    def jacobian(self, state: _State) -> Array:
        return self.posterior.jacobian(state, self.count)

    def quadratic(self, state: _State, jacobian: Array) -> tuple[Array, Array]:
        return self.posterior.quadratic(state, jacobian, self.noise)

    def bounds(self, state: _State) -> None:
        return None

    def moved(self, state: _State, change: Array) -> _State:
        return self.posterior.moved(state, change)


def _untilted(z: Array, ideal: Array) -> Array:
    """Heights (K, F, I, J) [m] over ideal control points (F, I, J, 3) [m] without the tilt of the whole mirror."""
    modes = np.moveaxis(ideal[..., :2] - ideal[..., :2].mean(axis=(1, 2), keepdims=True), -1, 0).reshape(2, -1)
    flat = z.reshape(len(z), -1)
    return np.asarray((flat - flat @ np.linalg.pinv(modes) @ modes).reshape(z.shape))


def refine(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    start: NDArray[np.float64] | None = None,
    *,
    latitude_deg: float,
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
        Where to begin besides the prior's mean: the network's prediction, say.
    latitude_deg : float [deg]
        Of the plant.

    Raises
    ------
    InvalidInputError
        Without images, or for a heliostat that does not have four facets.
    """
    if not observations:
        raise InvalidInputError("a refinement takes at least one image")
    require_own_grid(heliostat)
    prior, optics = prior or default_prior(), optics or Optics()
    options = options or RefinementOptions()
    posterior = _Posterior(heliostat, observations, prior, (optics, effects), latitude_deg, options)
    starts = [np.zeros(len(prior.basis))] + ([] if start is None else [prior.coefficients(start)])
    optima = [posterior.optimum(c) for c in starts]
    state, jacobian = min(optima, key=lambda optimum: posterior.cost(optimum[0], options.noise))
    z = prior.surface(state.c)
    return SurfacePrediction(
        z=z,
        z_std=prior.deviation(posterior.covariance(state, jacobian)),
        control_points=control_points(heliostat, z),
        method="refined",
        weights=prior.name,
        misfits=misfits(heliostat, observations, z, optics, effects, latitude_deg=latitude_deg),
        used=tuple(o.identifier for o in observations),
        mahalanobis=prior.mahalanobis(z),
    )
