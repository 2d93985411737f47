"""Surface refinement: maximum a posteriori through the tracer.

Heights are ``mean + basis @ c`` with a prior of c that was estimated from measured mirrors (`model.prior`).
Levenberg-Marquardt steps bring the traced images to the measured ones; the curvature at the end gives the uncertainty.

Two things decide whether that ends where it should. Derivatives must be those of the images
(`model.tracing.sensitivity`): a facet's canting changes an image by one percent, and differences of coarse traces miss
a third of it. And what is minimised must not change on the way: images are weighed as those of the surface that a
stage begins with. Then one start is enough for most mirrors like those measured; some rough ones end at another mirror
from one start and not from the other, and what they leave of the images tells.

What a camera adds to an image (a shift, another exposure, background, a little blur, another response) enters as a few
directions per image with priors of their own (`model.nuisances`), and is marginalised exactly. All other errors, of the
camera and of the model, grow with the flux and come in patches: they are taken for independent in the cosine transform
of the image, with one variance for each band of spatial frequency and another for each image, a factor of the former: a
hazy photograph tells less. They are estimated from what is left of the images and from how far a surface could bend to
them (MacKay 1992, doi:10.1162/neco.1992.4.3.415). Errors that look like a bent mirror weigh more than that: how far
apart the images pull the surface tells by how much (the overdispersion of quasi-likelihoods, Wedderburn 1974,
doi:10.1093/biomet/61.3.439). An image that the others contradict is left out.

Mirrors have more than their 8 x 8 heights tell, and what such ripples do to images, those heights would do in their
place: mirrors rendered as deflectometry has them, refined without ripples, are missed by three times as much or more.
They are sought with the surface (`model.prior.ripples`), their images to first order, and are not told of.

All that is of one place: where images tell mirrors apart by little, their errors decide which of several mirrors is
found, and no curvature at one of them shows the others. Halves of the images do, each fitted anew from another mirror
(`_Posterior.covariance`).
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import dct

from model import doubts
from model.effects import Effect
from model.errors import InvalidInputError
from model.forecast import Aligned
from model.images import COARSE_SIZE, binned
from model.least_squares import Descent, Minimum, minimize
from model.network.inputs import STEP_HEIGHT
from model.nuisances import nuisances
from model.observation import (
    Observation,
    Ranges,
    SurfacePrediction,
    align_observations,
    common_side,
    misfits,
    spread_suns,
)
from model.plant import Heliostat
from model.prior import SurfacePrior, prior_of, ripples
from model.surface import control_points, halved, require_own_grid
from model.tracing import Optics

Array = NDArray[np.float64]

BANDS = (3.0, 6.0, 10.0, 16.0, 24.0)
"""Ends of the bands of spatial frequency [half cycles per window]; what is finer the sun has blurred."""

CONSENSUS = 4
"""Images that it takes to say of one that the others contradict it."""

CONTRADICTION = 3.0
"""Mean square by which the others miss an image, in medians of all, from which on it is left out."""

DIMMING = 0.1
"""Share of its light by which a facet is dimmed to see what its light does to the images."""

DESCENT = Descent(
    steps=12,
    jacobians=12,
    damping=0.03,
    easing=10.0,
    raising=6.0,
    least_damping=1e-6,
    patience=5,
    least_gain=0.5,
    least_share=1e-3,
)
"""How the minimum of the negative log posterior is sought; a gain of half a unit, or of a thousandth, is none."""

ROUGHLY = replace(DESCENT, least_gain=1.0, least_share=3e-2)
"""How it is sought by halves of the images, whose differences are told in groups."""


@dataclass(frozen=True)
class RefinementOptions:
    """How images are trusted.

    Errors of a pixel have standard deviations relative to the image's peak, ``grain`` at least in each of `BANDS`, that
    grow with the root of the flux from a share ``dark`` of the peak on. ``annealing`` are the errors to begin with,
    stage by stage: images that are trusted little at first let the large features settle before the small ones are
    looked at, by up to ``few`` of the images. Then they are estimated, in several ``rounds``, from all. Images are
    compared at ``resolution`` pixels a side, traced with ``samples``. Mirrors are ``rippled`` unless they were made of
    8 x 8 heights, which only simulated ones are.
    """

    grain: float = 0.005
    dark: float = 0.1
    annealing: tuple[float, ...] = (0.1, 0.03)
    rounds: int = 3
    few: int = 8
    steps: int = 12
    resolution: int = COARSE_SIZE
    samples: int = 32
    rippled: bool = True


def _half_samples(suns: Array) -> list[tuple[list[int], list[int]]]:
    """Ways to halve M images by their suns (M, 3): fewer than four in one way, others in three balanced ones.

    Four groups of like suns, along the direction in which suns lie widest apart, are joined to halves in each way there
    is: halves then differ on average as much as four groups would, and are each half of all (balanced half-samples,
    McCarthy 1969, *Pseudo-replication: half samples*, Review of the International Statistical Institute 37).
    """
    around = suns - suns.mean(axis=0)
    order = np.argsort(around @ np.linalg.svd(around)[2][0], kind="stable").tolist()
    if len(order) < CONSENSUS:
        return [(order[: len(order) // 2], order[len(order) // 2 :])]
    first, *others = (part.tolist() for part in np.array_split(order, 4))
    return [(first + others[i], others[i - 2] + others[i - 1]) for i in range(3)]


def _unlike(one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Squared difference (K,) of what two halves of the images find, over its variance by the images' errors."""
    return np.asarray((one[0] - other[0]) ** 2 / (one[1] + other[1]))


class _Weights:
    """What a change of M images weighs, where bands of frequency err by ``sigma`` (M, 5), or (1, 5) in all alike.

    With residual r = J dc + N n + noise and n ~ N(0, 1), the noise covariance is S + N N'. Its inverse root is known:
    the nuisances' directions, made orthogonal in units of S, shrink. S and N are those of ``images`` (M, R, R),
    over ``side`` [m], of a surface near the one that is looked for. They stay while it is, or what is minimised would
    not be what was differentiated; and they come of no photograph, or its noise would be weighed with itself. Errors
    grow with the flux from ``dark`` [of the peak] on.
    """

    def __init__(self, images: Array, sigma: Array, dark: float, side: float) -> None:
        peak, along = images.max(axis=(1, 2), keepdims=True), np.arange(images.shape[-1])
        along = along[along < BANDS[-1]]
        frequency = np.hypot(*np.meshgrid(along, along))
        self._kept = frequency < BANDS[-1]
        self._cosines = dct(np.eye(images.shape[-1]), axis=0, norm="ortho")[along]
        self.bands = np.digitize(frequency[self._kept], BANDS)
        self._scale = peak * np.sqrt(np.clip(images / peak, 0, None) + dark)
        self._sigma = sigma[:, self.bands]
        free = self._white(nuisances(torch.as_tensor(images), side).numpy().swapaxes(0, 1))
        _, singular, self._directions = np.linalg.svd(free.swapaxes(0, 1), full_matrices=False)
        self._shrunk = 1 - 1 / np.sqrt(1 + singular**2)

    def __call__(self, changes: NDArray[Any]) -> NDArray[Any]:
        """Changes (..., M, R, R) as ones (..., M, n) that err independently of each other with unit variance."""
        white = self._white(changes)
        directions, shrunk = (values.astype(changes.dtype) for values in (self._directions, self._shrunk))
        along = np.einsum("...mn,mdn->...md", white, directions, optimize=True) * shrunk
        white -= np.einsum("...md,mdn->...mn", along, directions, optimize=True)
        return white

    def _white(self, changes: NDArray[Any]) -> NDArray[Any]:
        cosines, scale, sigma = (values.astype(changes.dtype) for values in (self._cosines, self._scale, self._sigma))
        modes = cosines @ (changes / scale) @ cosines.T
        return np.asarray(modes[..., self._kept] / sigma)


@dataclass(frozen=True, eq=False)
class _State:
    """Coefficients (K,), the mirror they make as aligned under each sun, and its images (M, R, R) of sum 100.

    The prior's coefficients come first, then those of ripples, which the aligned mirror lacks and its images show.
    """

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
        optics: Optics,
        effects: Sequence[Effect],
        latitude_deg: float,
        options: RefinementOptions,
        rippled: NDArray[Any] | None = None,
    ) -> None:
        self.heliostat, self.observations, self.prior, self.options = heliostat, observations, prior, options
        self.optics, self.effects, self.latitude_deg = optics, effects, latitude_deg
        self.ranges, self.side = Ranges(observations, options.resolution), common_side(observations)
        flux = np.array([o.flux for o in observations], dtype=np.float64)
        self.measured = binned(flux, options.resolution)
        self.rippled = np.zeros((0, *self.measured.shape), np.float32) if rippled is None else rippled
        # The same height for each direction: small enough for images to be linear in it, large enough to stand out from
        # their last digits.
        height = np.sqrt((prior.basis**2).mean(axis=(1, 2, 3)))
        self.steps = np.clip(STEP_HEIGHT / height, 0.1, 4.0).astype(np.float32)
        self.changes = (
            torch.as_tensor(prior.basis, dtype=torch.float32) * torch.as_tensor(self.steps)[:, None, None, None]
        )

    def state(self, c: Array) -> _State:
        """The mirror of coefficients (K,), aligned under each sun."""
        smooth, fine = np.split(c, [len(self.prior.basis)])
        aligned = self._aligned(self.prior.surface(smooth))
        return _State(c, aligned, self._images(aligned) + np.tensordot(fine, self.rippled, axes=1))

    def _aligned(self, z: Array) -> Aligned:
        """The mirror of heights (F, I, J) [m], aligned under each sun."""
        model = self.heliostat, self.observations, z, self.effects
        return align_observations(*model, latitude_deg=self.latitude_deg)

    def jacobian(self, state: _State) -> NDArray[Any]:
        """Change of the images (K, M, R, R) per coefficient of the prior; per one of ripples it stays `rippled`."""
        return np.asarray(self._changes(state.aligned, self.changes) / self.steps[:, None, None, None])

    def rippling(self, state: _State, belief: "_Belief") -> tuple["_Posterior", _State, "_Belief"]:
        """The posterior, and what is known of a state, with ripples, whose images are taken there, to first order."""
        directions = torch.as_tensor(ripples(self.heliostat.facet_frames[2]), dtype=torch.float32)
        rippled = self._changes(self._aligned(halved(self.prior.surface(state.c))), directions)
        model = self.prior, self.optics, self.effects, self.latitude_deg, self.options
        precision = np.concatenate([belief.precision, np.ones(len(rippled))])
        return (
            _Posterior(self.heliostat, self.observations, *model, rippled),
            replace(state, c=np.concatenate([state.c, np.zeros(len(rippled))])),
            replace(belief, precision=precision),
        )

    def _changes(self, aligned: Aligned, directions: torch.Tensor) -> NDArray[Any]:
        """Change of the images (K, M, R, R) of aligned mirrors with directions (K, F, I, J) [m] of the heights."""
        size, side, samples = self.options.resolution, self.side, self.options.samples
        with torch.no_grad():
            images = aligned.flux_changes(directions, self.optics, self.effects, size=size, side=side, samples=samples)
            images = self.ranges.seen(images)
            return np.asarray((images[1:] - images[:1]).numpy())

    def weights(self, state: _State, belief: "_Belief") -> _Weights:
        """What changes of a state's images weigh."""
        return _Weights(state.images, belief.sigma, self.options.dark, self.side)

    def optimum(self, state: _State, belief: "_Belief", jacobian: NDArray[Any], descent: Descent) -> Minimum[_State]:
        """The highest density near a state whose Jacobian is known."""
        problem = _Problem(self, self.weights(state, belief), belief.precision)
        return minimize(problem, state, replace(descent, steps=self.options.steps), jacobian)

    def fit(self, state: _State, jacobian: NDArray[Any], belief: "_Belief") -> "_Fit":
        """What there is to say of a state that was found with a belief."""
        weights = self.weights(state, belief)
        white = weights(np.concatenate([jacobian, self.rippled]))
        return _Fit(belief, white, weights(self.measured - state.images), weights.bands)

    def facet_light(self, state: _State, fit: "_Fit") -> tuple[Array, Array]:
        """By how much each facet sends more light than the others' mean (F,) [1], and its standard deviation.

        Traced with each facet a little dimmed, and estimated with the surface, which may bend instead, to first order.
        """
        weights = self.weights(state, fit.belief)
        count = len(self.prior.mean)
        dimmed = 1 - DIMMING * np.eye(count)
        images = [self._images(state.aligned.soiled(torch.as_tensor(facets))) for facets in dimmed]
        return fit.facet_light(weights(state.images - np.stack(images)) / DIMMING)

    def _images(self, aligned: Aligned) -> Array:
        """Images (M, R, R) of aligned mirrors, as the cameras show them."""
        size, side, samples = self.options.resolution, self.side, self.options.samples
        with torch.no_grad():
            images = aligned.flux_images(self.optics, self.effects, size=size, side=side, samples=samples)
            images = self.ranges.seen(images)
        return np.asarray(images.double().numpy())

    def settled(
        self, state: _State, jacobian: NDArray[Any], stages: Sequence[float], descent: Descent
    ) -> tuple[Minimum[_State], "_Belief"]:
        """The minimum near a state at which large features are right, and what it was found with."""
        for error in stages:
            belief = _Belief(np.full((1, len(BANDS)), error), np.ones(len(state.c)))
            found = self.optimum(state, belief, jacobian, descent)
            state, jacobian = found.state, found.jacobian
        return found, belief

    def settled_best(self, starts: Sequence[Array]) -> tuple[Minimum[_State], "_Belief"]:
        """The lowest of what is `settled` from coefficients (K,), compared at one noise, two at a time."""

        def settle(c: Array) -> tuple[Minimum[_State], "_Belief"]:
            state = self.state(c)
            return self.settled(state, self.jacobian(state), self.options.annealing, DESCENT)

        with ThreadPoolExecutor(2) as threads:
            return min(threads.map(settle, starts), key=lambda settled: settled[0].cost)

    def covariance(self, state: _State, fit: "_Fit") -> Array:
        """Covariance (K, K) of the prior's coefficients, as far apart as halves of the images find the mirror.

        Each half is fitted anew, from blurred to sharp, and begins with another two facets exchanged: the light of all
        falls on one spot, and far away or by few suns images hardly tell which facet is bent how. Halves that begin at
        one mirror tend to end at one. By as much as halves differ more than their errors should make them, group by
        group of the prior's directions, the part that comes of errors grows; what the prior leaves open stays. Halves
        do not show errors that all images share: `_Fit.cautious` allows for those.
        """
        known, suns = slice(len(self.prior.basis)), np.array([o.sun for o in self.observations])
        cautious = fit.cautious(self.options.grain)[known, known]
        if len(suns) < 2:
            return cautious
        # NumPy and torch compute without the interpreter: two threads take little more than half as long.
        with ThreadPoolExecutor(2) as threads:
            halves, starts = chain.from_iterable(_half_samples(suns)), self._exchanged(state.c)
            found = list(threads.map(lambda half, start: self._half(half, start, fit.belief), halves, starts))
        unlike = np.mean([_unlike(*pair) for pair in zip(found[::2], found[1::2], strict=True)], axis=0)[known]
        growth = np.sqrt(np.maximum(1 / self.prior.precision(np.sqrt(unlike), np.zeros_like(unlike)), 1))
        return np.asarray(cautious + fit.of_errors[known, known] * (np.outer(growth, growth) - 1))

    def _exchanged(self, c: Array) -> Iterator[Array]:
        """Coefficients (K,) with each pair of facets exchanged, in what they differ from the prior's mean by.

        Six of four facets, as many as there are halves at the most; without ripples.
        """
        smooth, fine = np.split(c, [len(self.prior.basis)])
        bent = self.prior.surface(smooth) - self.prior.mean
        for a, b in combinations(range(len(bent)), 2):
            other = bent.copy()
            other[[a, b]] = bent[[b, a]]
            yield np.concatenate([self.prior.coefficients(self.prior.mean + other), np.zeros_like(fine)])

    def _half(self, images: Sequence[int], start: Array, belief: "_Belief") -> tuple[Array, Array]:
        """Coefficients (K,) that some of the images find from a start (K,), and their variance (K,) by their errors."""
        model = self.prior, self.optics, self.effects, self.latitude_deg, self.options
        part = [self.observations[i] for i in images]
        half = _Posterior(self.heliostat, part, *model, self.rippled[:, list(images)])
        state = half.state(start)
        near, _ = half.settled(state, half.jacobian(state), self.options.annealing[:1], ROUGHLY)
        sigma = np.broadcast_to(belief.sigma, (len(self.observations), len(BANDS)))[list(images)]
        belief = replace(belief, sigma=sigma)
        found = half.optimum(near.state, belief, near.jacobian, ROUGHLY)
        return found.state.c, np.diag(half.fit(found.state, found.jacobian, belief).of_errors)

    def estimated(self, state: _State, jacobian: NDArray[Any], belief: "_Belief") -> tuple[_State, "_Fit"]:
        """The state of the highest density near another, with errors of the images as they turn out."""
        for left in reversed(range(self.options.rounds)):
            fit = self.fit(state, jacobian, belief)
            sigma = fit.errors() if left else belief.sigma * np.sqrt(max(fit.overdispersion(), 1.0))
            known = len(self.prior.basis)
            precision = self.prior.precision(state.c[:known], np.diag(fit.covariance)[:known])
            belief = _Belief(np.maximum(sigma, self.options.grain), np.r_[precision, belief.precision[known:]])
            found = self.optimum(state, belief, jacobian, DESCENT)
            state, jacobian = found.state, found.jacobian
        return state, self.fit(state, jacobian, belief)


@dataclass(frozen=True, eq=False)
class _Belief:
    """What bands of each image err by (M, 5), or (1, 5) of all alike, and the precision (K,) of the prior."""

    sigma: Array
    precision: Array


@dataclass(frozen=True, eq=False)
class _Fit:
    """What images tell of a state.

    Attributes
    ----------
    belief : _Belief
        What it was found with.
    white, left : (K, M, n), (M, n)
        Derivatives of weighed images by all coefficients, and what is left of those images.
    bands : (n,)
        The band of each mode.
    """

    belief: _Belief
    white: NDArray[Any]
    left: Array
    bands: NDArray[np.int64]

    @cached_property
    def covariance(self) -> Array:
        """Covariance (K, K) of the coefficients."""
        return self._covariance(np.ones((1, len(BANDS))))

    @cached_property
    def of_errors(self) -> Array:
        """The part of the covariance (K, K) that comes of the images' errors; the rest is what the prior leaves."""
        return np.asarray(self.covariance - (self.covariance * self.belief.precision) @ self.covariance)

    def _covariance(self, share: Array) -> Array:
        """Covariance (K, K), where bands tell a ``share`` (M, 5) or (1, 5) of what they seem to."""
        flat = (self.white * np.sqrt(share[:, self.bands]).astype(np.float32)).reshape(len(self.white), -1)
        return np.asarray(np.linalg.inv((flat @ flat.T).astype(np.float64) + np.diag(self.belief.precision)))

    @cached_property
    def information(self) -> Array:
        """What each image tells of the coefficients (M, K, K)."""
        each = self.white.swapaxes(0, 1)
        return np.asarray(each @ each.swapaxes(1, 2), dtype=np.float64)

    @cached_property
    def scores(self) -> Array:
        """Where each image would move the coefficients (M, K): down the gradient of its cost."""
        return np.asarray(np.einsum("kmn,mn->mk", self.white, self.left, optimize=True))

    def errors(self) -> Array:
        """What bands of each image err by (M, 5): what is left of them, less what coefficients took away."""
        turned = np.tensordot(self.covariance.astype(np.float32), self.white, axes=1)
        free = 1 - np.einsum("kmn,kmn->mn", self.white, turned)
        modes = np.maximum(np.bincount(self.bands, free.sum(axis=0)), 1)
        of_band = np.bincount(self.bands, (self.left**2).sum(axis=0)) / modes
        of_image = (self.left**2 / of_band[self.bands]).sum(axis=1) / np.maximum(free.sum(axis=1), 1)
        return np.asarray(self.belief.sigma * np.sqrt(of_band * of_image[:, None]))

    def tells(self) -> Array:
        """Share (M,) of each image in what all tell of the coefficients, by the numbers that they settle."""
        settled = np.einsum("mij,ji->m", self.information, self.covariance)
        return np.asarray(settled / settled.sum())

    def overdispersion(self) -> float:
        """How many times farther apart images pull the surface than independent errors would make them, squared.

        Of one where they err as they are thought to: errors that look like a bent mirror weigh more than others.
        """
        along = self.covariance @ self.information
        expected = np.trace(along, axis1=1, axis2=2).sum() - np.einsum("mij,mji->", along, along)
        return float(np.einsum("mi,ij,mj->", self.scores, self.covariance, self.scores) / max(expected, 1.0))

    def contradicted(self) -> int | None:
        """The image that the others contradict most, if they do: by what a surface found from them leaves of it."""
        if len(self.left) < CONSENSUS:
            return None
        missed = self.missed()
        return int(missed.argmax()) if missed.max() > CONTRADICTION * np.median(missed) else None

    def missed(self) -> Array:
        """Squared distance (M,) of each image from what the others tell of it, in what they tell it by, over its modes.

        By how much the cost of all falls where the image is left out, to first order.
        """
        others = np.eye(len(self.covariance)) - self.information @ self.covariance
        turned = np.linalg.solve(others, self.scores[..., None])[..., 0] @ self.covariance
        alone = self.left + np.einsum("mk,kmn->mn", turned, self.white, optimize=True)
        return np.asarray((alone * self.left).mean(axis=1))

    def facet_light(self, changes: Array) -> tuple[Array, Array]:
        """Each facet's light over the others' mean (F,), less one, and its deviation.

        ``changes`` (F, M, n) are those of weighed images with it.
        """
        count = len(changes)
        flat = np.concatenate([self.white, changes]).reshape(len(self.white) + count, -1).astype(np.float64)
        precision = np.diag(np.concatenate([self.belief.precision, np.ones(count)]))
        covariance = np.linalg.inv(flat @ flat.T + precision)
        # The surface is at its optimum, where its own gradient and its prior's cancel.
        gradient = np.concatenate([np.zeros(len(self.white)), flat[-count:] @ self.left.ravel()])
        against = (np.eye(count) * count - 1) / (count - 1)
        found, spread = (covariance @ gradient)[-count:], covariance[-count:, -count:]
        return against @ found, np.sqrt(np.diag(against @ spread @ against))

    def cautious(self, grain: float) -> Array:
        """Covariance (K, K) where photographs share errors: all variance beyond a ``grain`` counts once for each."""
        extra = np.clip(1 - (grain / self.belief.sigma) ** 2, 0, None)
        return self._covariance(1 / (1 + (len(self.left) - 1) * extra))


@dataclass(frozen=True, eq=False)
class _Problem:
    """A posterior as a least-squares problem, with fixed weights of the images and a fixed prior."""

    posterior: _Posterior
    weights: _Weights
    precision: Array

    def cost(self, state: _State) -> float:
        left = self.weights(self.posterior.measured - state.images)
        return float(state.c @ (self.precision * state.c) + (left**2).sum()) / 2

    def response(self, state: _State) -> Array:
        return state.images

    def jacobian(self, state: _State) -> Array:
        return self.posterior.jacobian(state)

    @cached_property
    def _fine(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Weighed images (N, M n) of ripples, and their curvature (N, N), which no step changes."""
        white = self._flat(self.posterior.rippled)
        return white, white @ white.T

    def quadratic(self, state: _State, jacobian: Array) -> tuple[Array, Array]:
        smooth, (fine, of_fine) = self._flat(jacobian), self._fine
        (left,) = self._flat((self.posterior.measured - state.images)[None].astype(smooth.dtype))
        both = smooth @ fine.T
        curvature = np.block([[smooth @ smooth.T, both], [both.T, of_fine]]).astype(np.float64)
        gradient = np.concatenate([smooth @ left, fine @ left]).astype(np.float64)
        return gradient - self.precision * state.c, curvature + np.diag(self.precision)

    def _flat(self, changes: NDArray[Any]) -> NDArray[Any]:
        """Weighed changes (K, M n) of changes (K, M, R, R)."""
        white = self.weights(changes)
        return np.asarray(white.reshape(len(white), np.prod(white.shape[1:], dtype=int)))

    def bounds(self, state: _State) -> None:
        return None

    def moved(self, state: _State, change: Array) -> _State:
        return self.posterior.state(state.c + change)


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
        Where to begin besides the prior's mean: the network's prediction, say. What leaves less of the images goes on.
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
    prior, optics = prior or prior_of(heliostat), optics or Optics()
    options = options or RefinementOptions()
    posterior, state, fit, left_out = _consensus(
        heliostat, observations, start, (prior, optics, effects), latitude_deg, options
    )
    z, tells = prior.surface(state.c[: len(prior.basis)]), np.zeros(len(observations))
    tells[[i for i in range(len(observations)) if i not in left_out]] = fit.tells()
    against = [
        *doubts.of_the_situation(heliostat, observations),
        *doubts.of_canting(prior, z),
        *doubts.of_facet_light(*posterior.facet_light(state, fit)),
    ]
    return SurfacePrediction(
        z=z,
        z_std=prior.deviation(posterior.covariance(state, fit)),
        control_points=control_points(heliostat, z),
        method="refined",
        weights=prior.name,
        misfits=misfits(heliostat, observations, z, optics, effects, latitude_deg=latitude_deg),
        used=tuple(o.identifier for o in observations),
        tells=tuple(tells.tolist()),
        mahalanobis=prior.mahalanobis(z),
        contradicting=tuple(observations[i].identifier for i in left_out),
        doubts=tuple(against),
    )


def _consensus(
    heliostat: Heliostat,
    observations: Sequence[Observation],
    start: Array | None,
    model: tuple[SurfacePrior, Optics, Sequence[Effect]],
    latitude_deg: float,
    options: RefinementOptions,
) -> tuple[_Posterior, _State, _Fit, list[int]]:
    """The most probable surface, by which images, what there is to say of it, and the places of those left out."""

    def posterior(part: Sequence[int]) -> _Posterior:
        return _Posterior(heliostat, [observations[i] for i in part], *model, latitude_deg, options)

    kept, left_out = list(range(len(observations))), list[int]()
    mean = np.zeros(len(model[0].basis))
    starts = [mean] if start is None else [model[0].coefficients(start), mean]
    while True:
        suns = np.array([observations[i].sun for i in kept])
        few = [kept[i] for i in sorted(spread_suns(suns, options.few))]
        whole = posterior(few)
        settled, belief = whole.settled_best(starts)
        state, jacobian = settled.state, settled.jacobian
        if len(few) < len(kept):
            whole = posterior(kept)
            state = whole.state(state.c)
            jacobian = whole.jacobian(state)
        out = whole.fit(state, jacobian, belief).contradicted()
        if out is None:
            if options.rippled:
                whole, state, belief = whole.rippling(state, belief)
            return whole, *whole.estimated(state, jacobian, belief), left_out
        left_out.append(kept.pop(out))
