"""Modes of the posterior: minima of its cost, by annealing and for given hyperparameters.

Notes
-----
::

    for sigma in annealing:   state = argmin cost(state; noise sigma)          (`anneal`)
    for each round:           hyper = most probable noise and scales at state  (`posterior`)
                              state = argmin cost(state; hyper)                (`find_optimum`)

The cost is that of `model.refinement.posterior`, in nats.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.images import COARSE_SIZE
from model.least_squares import MinimizerOptions, minimize
from model.observation import spread_suns
from model.refinement.image_model import ImageModel, SurfaceState
from model.refinement.posterior import Hyperparameters, Mode, PosteriorCost
from model.surface import FACETS

Array = NDArray[np.float64]

MINIMIZER = MinimizerOptions(
    max_steps=12,
    max_jacobians=12,
    damping=0.03,
    damping_decrease=10.0,
    damping_increase=6.0,
    min_damping=1e-6,
    patience=5,
    min_gain=0.5,
    min_relative_gain=1e-3,
)
"""Minimization of the negative log posterior, whose unit is the nat."""


N_THREADS = 2
"""Threads of a refinement. NumPy and torch release the interpreter's lock."""


@dataclass(frozen=True)
class RefinementOptions:
    """Options of a refinement.

    Attributes
    ----------
    min_sigma : float [of the peak]
        Smallest standard deviation of the noise in a band.
    annealing : tuple of float [of the peak]
        Noise of successive minimizations before the noise is estimated: large features converge
        before small ones. Less noise than the images have is left out (`anneal`).
    max_annealed : int
        Largest number of images for annealing; the suns of those are far apart.
    rounds : int
        Estimates of the noise, each followed by a minimization.
    with_ripples : bool
        Whether the mirror has ripples. Only simulated mirrors that were made of 8 x 8 heights have
        none.
    with_half_samples : bool
        Whether halves of the images widen the covariance. Without them the surface is the same, its
        intervals are too narrow, and half of the time is saved.
    resolution : int
        Pixels along a side of the compared images.
    samples : int
        Traced rays along each side of a facet of four; others have about as many in total
        (`samples_of`).
    max_steps : int
        Of one minimization.
    """

    min_sigma: float = 0.005
    annealing: tuple[float, ...] = (0.1, 0.03)
    max_annealed: int = 8
    rounds: int = 3
    with_ripples: bool = True
    with_half_samples: bool = True
    resolution: int = COARSE_SIZE
    samples: int = 32
    max_steps: int = 12

    def samples_of(self, n_facets: int) -> int:
        """Traced rays along each side of one of a mirror's facets; half as many as of four at
        least.
        """
        return max(round(self.samples * math.sqrt(FACETS / n_facets)), self.samples // 2)

    @property
    def minimizer(self) -> MinimizerOptions:
        """Of all images."""
        return replace(MINIMIZER, max_steps=self.max_steps)

    @property
    def rough_minimizer(self) -> MinimizerOptions:
        """Of half-samples, whose differences are averaged over groups of coefficients."""
        return replace(self.minimizer, min_gain=1.0, min_relative_gain=3e-2)


def find_optimum(model: ImageModel, mode: Mode, minimizer: MinimizerOptions) -> Mode:
    """Minimize the cost from a mode of other hyperparameters, with the whitener of its state."""
    found = minimize(PosteriorCost(model, mode), mode.state, minimizer, mode.jacobian)
    model.steps.advance()
    return replace(mode, state=found.state, jacobian=found.jacobian, cost=found.cost)


def anneal(
    model: ImageModel,
    state: SurfaceState,
    jacobian: NDArray[Any],
    minimizer: MinimizerOptions,
    noise_levels: Sequence[float],
) -> Mode:
    """Minimize the cost for one noise level [of the peak] after the other, down to the images' own.

    Errors of real photographs are smooth: less noise would bend the mirror to explain them, and end
    at another mirror.
    """
    left = 0.0
    for sigma in noise_levels:
        if sigma < left:
            model.steps.advance()
            continue
        hyper = Hyperparameters.uniform(sigma, len(state.coefficients))
        mode = find_optimum(model, Mode(state, jacobian, hyper), minimizer)
        state, jacobian = mode.state, mode.jacobian
        white = mode.whitener(model)(model.measured - state.images)
        left = sigma * float(np.sqrt((white**2).mean()))
    return mode


def anneal_few(
    model: ImageModel,
    start: Array,
    minimizer: MinimizerOptions,
    noise_levels: Sequence[float],
    max_annealed: int,
) -> Mode:
    """Anneal from coefficients (K,) with a few of the images; the mode has the images of all."""
    places = sorted(spread_suns(model.suns, max_annealed))
    few = model if len(places) == len(model.observations) else model.subset(places)
    state = few.state(start)
    mode = anneal(few, state, few.jacobian(state), minimizer, noise_levels)
    if few is model:
        return mode
    state = model.state(mode.state.coefficients)
    return replace(mode, state=state, jacobian=model.jacobian(state))


def find_mode(model: ImageModel, starts: Sequence[Array], options: RefinementOptions) -> Mode:
    """Anneal from each start, coefficients (K,), with a few images; the best mode, with the images
    of all.

    One start is enough for most mirrors like those measured.
    """
    few = model.subset(sorted(spread_suns(model.suns, options.max_annealed)))
    model.steps.phase = f"fitting the surface to {len(few.observations)} images"
    model.steps.total += len(starts) * len(options.annealing)

    if len(starts) > 1:
        few = replace(few, threads=1)

    def anneal_from(start: Array) -> Mode:
        state = few.state(start)
        return anneal(few, state, few.jacobian(state), options.minimizer, options.annealing)

    with ThreadPoolExecutor(N_THREADS) as threads:
        mode = min(threads.map(anneal_from, starts), key=lambda mode: mode.cost)
    if len(few.observations) == len(model.observations):
        return mode
    state = model.state(mode.state.coefficients)
    return replace(mode, state=state, jacobian=model.jacobian(state))
