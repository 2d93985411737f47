"""Variance between modes: which other surfaces explain the images of a mirror.

Notes
-----
The light of many facets overlaps. Images then show how facets are canted, and hardly which of them
is canted how: surfaces with exchanged facets explain them nearly as well. The curvature at one mode
does not show the others. So the facets' deviations are permuted, and the fit is repeated from
there. Large facets make such modes alone: turned or reversed they send similar light. The true
surface may be near any of the modes: the mean square difference of the others from the best one is
added to the variance, in each group of coefficients.

Mirrors of four facets need no such modes: their half-samples begin with exchanged facets
(`half_samples`).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.prior import SurfacePrior
from model.refinement.image_model import ImageModel
from model.refinement.modes import N_THREADS, RefinementOptions, anneal_few, find_optimum
from model.refinement.posterior import Mode
from model.surface import FACETS

Array = NDArray[np.float64]

N_MODES = 4
"""Number of other modes that are sought."""


class OtherModes(NamedTuple):
    """Coefficients (N, K) of other modes, and their costs (N,) minus the best one's."""

    coefficients: Array
    excess: Array


def n_other_minimizations(n_facets: int, options: RefinementOptions) -> int:
    """Number of minimizations of `find_other_modes`."""
    return 0 if n_facets == FACETS else N_MODES * (len(options.annealing) + 1)


def find_other_modes(model: ImageModel, mode: Mode, options: RefinementOptions) -> OtherModes:
    """Find modes from permuted or turned facets; none for mirrors of four."""
    if len(model.prior.mean) == FACETS:
        return OtherModes(np.zeros((0, len(mode.state.coefficients))), np.zeros(0))
    model.steps.phase = "comparing surfaces with exchanged facets"
    model = replace(model, threads=1)

    def fit(start: Array) -> Mode:
        near = anneal_few(
            model, start, options.rough_minimizer, options.annealing, options.max_annealed
        )
        return find_optimum(model, replace(near, hyper=mode.hyper), options.rough_minimizer)

    with ThreadPoolExecutor(N_THREADS) as threads:
        found = list(threads.map(fit, changed_facets(model.prior, mode.state.coefficients)))
    return OtherModes(
        np.array([other.state.coefficients for other in found]),
        np.array([other.cost - mode.cost for other in found]),
    )


def changed_facets(prior: SurfacePrior, coefficients: Array) -> list[Array]:
    """Coefficients (K,) with the deviations of all facets from the prior's mean permuted.

    Those of fewer than four facets are reversed: in height, along x, along y and along both. The
    ripples are zero.
    """
    rng = np.random.default_rng(0)
    smooth, fine = np.split(coefficients, [len(prior.basis)])
    z = prior.surface(smooth) - prior.mean
    if len(z) < FACETS:
        changed = [-z, z[:, ::-1], z[:, :, ::-1], z[:, ::-1, ::-1]]
    else:
        changed = [z[rng.permutation(len(z))] for _ in range(N_MODES)]
    none = np.zeros_like(fine)
    return [np.concatenate([prior.coefficients(prior.mean + other), none]) for other in changed]


def between_mode_variance(prior: SurfacePrior, best: Array, others: OtherModes) -> Array:
    """Variance (K,) of the prior's coefficients between the ``best`` (K,) mode and the others."""
    if not len(others.excess):
        return np.zeros(len(prior.basis))
    squares = ((others.coefficients - best)[:, : len(prior.basis)] ** 2).mean(axis=0)
    counts = np.diff([*prior.groups, len(squares)])
    return np.repeat(np.add.reduceat(squares, prior.groups) / counts, counts)
