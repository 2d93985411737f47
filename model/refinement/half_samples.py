"""Covariance of a surface by half-samples: how much surfaces from halves of the images differ.

Notes
-----
If images determine the surface weakly, their errors decide which of several surfaces is found, and
the curvature at one of them does not show the others. So each half of the images is fitted again,
from a start with two facets exchanged. The squared difference of two halves, divided by its
variance due to the noise, has an expectation of one for each coefficient. If it is larger in a
group of coefficients, their noise part of the covariance grows in proportion; the part that the
prior leaves does not.

Source of balanced half-samples: McCarthy 1969, *Pseudo-replication: half samples*, Review of the
International Statistical Institute 37.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import chain, combinations, cycle
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.observation import spread_suns
from model.prior import SurfacePrior
from model.refinement.image_model import ImageModel
from model.refinement.modes import N_THREADS, RefinementOptions, anneal_few, find_optimum
from model.refinement.posterior import Hyperparameters, Linearization, Mode, linearize
from model.refinement.whitening import BANDS

Array = NDArray[np.float64]

N_GROUPS = 4
"""Groups of images with similar suns, which are combined to halves."""


class HalfSplit(NamedTuple):
    """Indices of the images in two halves."""

    first: list[int]
    second: list[int]


class HalfEstimate(NamedTuple):
    """Coefficients (K,) from a half of the images, and their variance (K,) due to the noise."""

    coefficients: Array
    variance: Array


def half_samples(suns: Array, max_images: int) -> list[HalfSplit]:
    """Split M images by their suns (M, 3) into halves: fewer than four in one way, others in three
    balanced ways.

    Four groups of similar suns, along the direction of the largest scatter, are combined to halves
    in all ways. Of a half with more than ``max_images`` those are taken whose suns are far apart:
    the squared differences are relative to their variance, whatever the number of images is.
    """

    def some(half: list[int]) -> list[int]:
        if len(half) <= max_images:
            return half
        return [half[i] for i in spread_suns(suns[half], max_images)]

    around = suns - suns.mean(axis=0)
    order = np.argsort(around @ np.linalg.svd(around)[2][0], kind="stable").tolist()
    if len(order) < N_GROUPS:
        return [HalfSplit(order[: len(order) // 2], order[len(order) // 2 :])]
    first, *others = (part.tolist() for part in np.array_split(order, N_GROUPS))
    return [
        HalfSplit(some(first + others[i]), some(others[i - 2] + others[i - 1])) for i in range(3)
    ]


def n_minimizations(n_images: int) -> int:
    """Number of minimizations of `half_sample_covariance`: two for each half."""
    return 2 * 2 * (0 if n_images < 2 else 1 if n_images < N_GROUPS else 3)


def half_sample_covariance(
    model: ImageModel, mode: Mode, linearization: Linearization, options: RefinementOptions
) -> Array:
    """Covariance (K, K) of the prior's coefficients, without the ripples.

    Half-samples do not show errors that all images share: `Linearization.shared_error_covariance`
    includes those.
    """
    smooth = slice(len(model.prior.basis))
    shared = linearization.shared_error_covariance(options.min_sigma)[smooth, smooth]
    if len(model.suns) < 2 or not options.with_half_samples:
        return shared
    model.steps.phase = "comparing half-samples of the images"
    with ThreadPoolExecutor(N_THREADS) as threads:
        halves = chain.from_iterable(half_samples(model.suns, options.max_annealed))
        starts = exchange_facets(model.prior, mode.state.coefficients)
        found = list(
            threads.map(
                lambda half, start: fit_half(model, half, start, mode.hyper, options),
                halves,
                starts,
            )
        )
    pairs = zip(found[::2], found[1::2], strict=True)
    squares = np.mean([squared_difference(*pair) for pair in pairs], axis=0)[smooth]
    growth = np.sqrt(
        np.maximum(1 / model.prior.precision(np.sqrt(squares), np.zeros_like(squares)), 1)
    )
    return np.asarray(
        shared + linearization.noise_covariance[smooth, smooth] * (np.outer(growth, growth) - 1)
    )


def squared_difference(one: HalfEstimate, other: HalfEstimate) -> Array:
    """Squared difference (K,) of two estimates over its variance due to the noise."""
    return np.asarray(
        (one.coefficients - other.coefficients) ** 2 / (one.variance + other.variance)
    )


def exchange_facets(prior: SurfacePrior, coefficients: Array) -> Iterator[Array]:
    """Coefficients (K,) with the deviations of two facets from the prior's mean exchanged, for each
    pair of facets, without end.

    Four facets have six pairs, the largest number of halves. A single facet is turned by half a
    turn. The ripples are zero.
    """
    smooth, fine = np.split(coefficients, [len(prior.basis)])
    deviation = prior.surface(smooth) - prior.mean
    n_facets = len(deviation)
    for a, b in cycle([*combinations(range(n_facets), 2)] or [(0, 0)]):
        exchanged = deviation[:, ::-1, ::-1].copy() if n_facets == 1 else deviation.copy()
        exchanged[[a, b]] = exchanged[[b, a]]
        yield np.concatenate([prior.coefficients(prior.mean + exchanged), np.zeros_like(fine)])


def fit_half(
    model: ImageModel,
    half: Sequence[int],
    start: Array,
    hyper: Hyperparameters,
    options: RefinementOptions,
) -> HalfEstimate:
    """Fit some of the images from coefficients (K,), with the noise that all images have."""
    part, n_images = replace(model.subset(half), threads=1), len(model.observations)
    near = anneal_few(
        part, start, options.rough_minimizer, options.annealing[:1], options.max_annealed
    )
    sigma = np.broadcast_to(hyper.sigma, (n_images, len(BANDS)))[list(half)]
    found = find_optimum(
        part, replace(near, hyper=replace(hyper, sigma=sigma)), options.rough_minimizer
    )
    variance = np.diag(linearize(part, found).noise_covariance)
    return HalfEstimate(found.state.coefficients, variance)
