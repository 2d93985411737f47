"""Fit effects to photographs by least squares within bounds, from several starts.

Notes
-----
The values v of P unknowns are those of the lowest cost, with the prior's precision Q about neutral
values::

    cost(v) = (r' r + (v - neutral)' Q (v - neutral)) / 2
    r       = (measured - forecast(v)) / (PIXEL_NOISE peak), and the offset of each spot
    J       = d r / d v                                   differences of `STEP`

As long as the model lacks something, residuals are far larger than an image's grain. So all pixels
have the same weight. The offset of a spot from where its motors sent it is two more residuals
(`model.study.position`). The standard deviations come from how the images disagree, with the score
g_i = J_i r_i of image i::

    covariance = B (sum_i g_i g_i') B n / (n - d),   B = (J J' + Q)^-1

for n images and d unknowns per heliostat. Sources: `model.least_squares`; White 1980,
doi:10.2307/1912934 (sandwich estimator).

The stages are `find_starts`, `Fitter.descend` from the most promising starts, and `sandwich_std`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect
from model.errors import InvalidInputError, UnreachableError
from model.images import COARSE_SIZE
from model.least_squares import Bounds, MinimizerOptions, Quadratic, minimize
from model.study.flux_images import Forecaster
from model.study.parameters import ParameterVector, copied, copy_vector

Array = NDArray[np.float64]

PIXEL_NOISE = 0.03
"""Standard deviation of a pixel [of the peak] in fits."""

RESIDUALS = COARSE_SIZE**2 + 2
"""R, those of one photograph: its pixels, and where its spot lies."""

STARTS = (-0.4, -0.15, -0.05, 0.05, 0.15, 0.4)
"""Where fits of an unknown begin, in shares of its range away from neutral."""

WORST_START = 3
"""Cost of a start, in costs of the best one, above which no fit begins there."""

AT_ONCE, MAX_IMAGES_AT_ONCE = 8, 1024
"""Forecasts of all images that are traced at once, where they differ in mirrors alone; and the most
images of them.
"""

STEP = 5e-3
"""Step of the differences, in shares of an unknown's range."""

TRIES = 3
"""Steps from one Jacobian, each shorter than the last, after which a fit has come to its end."""

MINIMIZER = MinimizerOptions(max_steps=24, max_jacobians=8, patience=TRIES, min_relative_gain=1e-3)


@dataclass(frozen=True, eq=False)
class Fit:
    """Values (P,) of unknowns, the cost there, and the standard deviation (P,) of the values."""

    values: Array
    cost: float
    spread: Array


class Start(NamedTuple):
    """Values (P,) at which a fit may begin, and the cost there."""

    values: Array
    cost: float


class Fitter:
    """Fits unknowns to the photographs of a forecaster, in addition to ``fixed`` effects.

    With a ``fine`` forecaster of the same photographs fits may be traced coarsely: what both differ
    by where a fit begins, its grid's trace in the image, is taken off.
    """

    def __init__(
        self,
        forecaster: Forecaster,
        fine: Forecaster | None = None,
        fixed: Sequence[Effect] = (),
        iterations: int = 8,
    ) -> None:
        self.forecaster, self.fine = forecaster, fine
        self.fixed, self.iterations = fixed, iterations
        self.heliostats = np.array([p.heliostat for p in forecaster.flux_images])
        self.measured = forecaster.measured(COARSE_SIZE)
        self.peaks = self.measured.max(axis=(1, 2))

    def residuals(self, unknowns: ParameterVector, values: Array) -> Array:
        """Residuals (N, R) of one trial; infinite if the model fails, 0 if unknown."""
        return np.asarray(self.residuals_of(unknowns, values[None])[0])

    def residuals_of(self, unknowns: ParameterVector, trials: Array) -> Array:
        """Residuals (M, N, R) of trials (M, P); equal shared unknowns are traced at once."""
        residuals = np.empty((len(trials), len(self.measured), RESIDUALS))
        for part in self._alike(unknowns, trials):
            residuals[part] = self._residuals_alike(unknowns, trials[part])
        return residuals

    def energies_of(self, unknowns: ParameterVector, trials: Array) -> Array:
        """Sums (M, N) of squares of `residuals_of`, in the memory of a few trials."""
        energies = np.empty((len(trials), len(self.measured)))
        for part in self._alike(unknowns, trials):
            residuals = self._residuals_alike(unknowns, trials[part])
            energies[part] = (residuals**2).sum(axis=-1)
        return energies

    def _alike(self, unknowns: ParameterVector, trials: Array) -> Iterator[NDArray[np.intp]]:
        """Places of trials (M, P) with the same shared unknowns, which are traced at once."""
        shared = np.array([unknown.shared for unknown in unknowns.all], dtype=bool)
        _, group = np.unique(trials[:, shared], axis=0, return_inverse=True)
        most = max(1, min(AT_ONCE, MAX_IMAGES_AT_ONCE // len(self.measured)))
        for number in np.unique(group):
            rows = np.flatnonzero(group == number)
            yield from np.array_split(rows, -(-len(rows) // most))

    def _residuals_alike(self, unknowns: ParameterVector, trials: Array) -> Array:
        """Residuals (M, N, R) of trials (M, P) with the same shared unknowns."""
        count = len(trials)
        copies, values = copy_vector(unknowns, trials)
        fixed = [copied(effect, count) for effect in self.fixed]
        forecaster, model = self.forecaster.copies(count), [*fixed, *copies.effects(values)]
        try:
            forecast = forecaster.cuts(model, COARSE_SIZE)
            off = forecaster.position_residuals(model)
        except (UnreachableError, InvalidInputError):
            if count > 1:
                return np.concatenate(
                    [self._residuals_alike(unknowns, trial[None]) for trial in trials]
                )
            # A clock an hour off puts low suns below the horizon, and all light may be blocked: as
            # wrong as can be.
            return np.full((1, len(self.measured), RESIDUALS), np.inf)
        difference = self.measured - forecast.reshape(count, *self.measured.shape)
        shares = difference / self.peaks[:, None, None] / PIXEL_NOISE
        parts = (shares, np.nan_to_num(off))
        return np.concatenate(
            [part.reshape(count, len(self.measured), -1) for part in parts], axis=-1
        )

    def take_off_grid(self, unknowns: ParameterVector, begin: Array) -> None:
        """Add the difference of coarse and fine forecasts at ``begin`` to the measured images."""
        if self.fine is not None:
            model = [*self.fixed, *unknowns.acting(begin)]
            grid = self.forecaster.cuts(model, COARSE_SIZE) - self.fine.cuts(model, COARSE_SIZE)
            self.measured = self.forecaster.measured(COARSE_SIZE) + grid

    def cost(self, unknowns: ParameterVector, values: Array, residuals: Array) -> float:
        """Half the sum of squares plus the prior's, which fixes what images do not determine."""
        away = values - unknowns.neutral
        return float((residuals**2).sum() + away @ unknowns.prior_precision @ away) / 2

    def jacobian(self, unknowns: ParameterVector, values: Array, residuals: Array) -> Array:
        """Derivatives of the residuals (P, N, R); a group is changed at once."""
        low, high = unknowns.bounds
        steps = STEP * (high - low)
        steps = np.where(values + steps > high, -steps, steps)
        groups = list(unknowns.groups.values())
        trials = np.tile(values, (len(groups), 1))
        for trial, places in zip(trials, groups, strict=True):
            trial[places] += steps[places]
        derivatives = np.zeros((len(values), *residuals.shape))
        for places, response in zip(
            groups, self.residuals_of(unknowns, trials) - residuals, strict=True
        ):
            for place in places:
                affected = self.affected(unknowns, place)
                derivatives[place, affected] = response[affected] / steps[place]
        return derivatives

    def affected(self, unknowns: ParameterVector, place: int) -> NDArray[np.bool_]:
        """Which images (N,) an unknown changes."""
        unknown = unknowns.all[place]
        return np.array(
            [unknown.owns(p.heliostat, p.taken_at) for p in self.forecaster.flux_images]
        )

    def fit(
        self,
        unknowns: ParameterVector,
        begin: Array,
        free: NDArray[np.bool_] | None = None,
        tries: int = 2,
    ) -> Fit:
        """Fit from the most promising starts; ``free`` (P,) unknowns may start elsewhere."""
        free = np.full(len(begin), True) if free is None else free
        self.take_off_grid(unknowns, begin)
        starts = find_starts(self, unknowns, begin, free)
        promising = [s.values for s in starts if not s.cost > WORST_START * starts[0].cost]
        fits = (self.descend(unknowns, values) for values in promising[:tries])
        return min(fits, key=lambda fit: fit.cost)

    def descend(self, unknowns: ParameterVector, values: Array) -> Fit:
        """The least cost near ``values`` (P,)."""
        begin = _Point(values, self.residuals(unknowns, values))
        problem = _FitProblem(self, unknowns)
        cost = problem.cost(begin)
        if not np.isfinite(cost):
            return Fit(values, cost, np.full(len(values), np.nan))
        options = replace(
            MINIMIZER, max_jacobians=self.iterations, max_steps=self.iterations * TRIES
        )
        found = minimize(problem, begin, options)
        spread = sandwich_std(
            found.jacobian,
            found.state.residuals,
            unknowns.prior_precision,
            len(np.unique(self.heliostats)),
        )
        return Fit(found.state.values, found.cost, spread)


def find_starts(
    fitter: Fitter, unknowns: ParameterVector, begin: Array, free: NDArray[np.bool_]
) -> list[Start]:
    """Find where fits may begin, the best first: ``begin``, and its ``free`` unknowns moved.

    Many effects are even in their parameter, so a fit from neutral would not move. Some have
    several local optima. Each unknown is moved separately. If heliostats have separate unknowns,
    each heliostat chooses its own start.
    """
    low, high = unknowns.bounds
    groups = [places for places in unknowns.groups.values() if free[places].all()]
    if not groups:
        return [Start(begin, 0.0)]
    trials = np.tile(begin, (len(groups), 1 + len(STARTS), 1))
    for moved, places in zip(trials, groups, strict=True):
        moved[:, places] += np.array([0.0, *STARTS])[:, None] * (high - low)[places]
    trials = np.clip(trials, low, high)
    energies = fitter.energies_of(unknowns, trials.reshape(-1, len(begin)))
    energies = energies.reshape(*trials.shape[:2], -1)
    chosen, found = begin.copy(), []
    for moved, energy, places in zip(trials, energies, groups, strict=True):
        for place in places:
            best = energy[:, fitter.affected(unknowns, place)].sum(axis=1).argmin()
            chosen[place] = moved[best, place]
        if unknowns.all[places[0]].shared:
            found.append(np.where(np.isin(np.arange(len(begin)), places), chosen, begin))
    candidates = np.unique([begin, *found, chosen, *_guesses(unknowns, begin, free)], axis=0)
    residuals = fitter.residuals_of(unknowns, candidates)
    starts = [
        Start(values, fitter.cost(unknowns, values, residual))
        for values, residual in zip(candidates, residuals, strict=True)
    ]
    return [starts[place] for place in np.argsort([s.cost for s in starts], kind="stable")]


def _guesses(unknowns: ParameterVector, begin: Array, free: NDArray[np.bool_]) -> list[Array]:
    """``begin`` with each of the free effects' own guesses."""
    guessed = []
    for term in unknowns.terms:
        for guess in term.kind.guesses:
            values = begin.copy()
            for place, unknown in enumerate(unknowns.all):
                if free[place] and unknown.term == term:
                    values[place] = guess.get(unknown.parameter.name, values[place])
            guessed.append(values)
    return guessed


def sandwich_std(
    jacobian: Array, residuals: Array, prior_precision: Array, n_heliostats: int
) -> Array:
    """Standard deviations (P,) by the sandwich estimator, with images, not pixels, as independent.

    ``jacobian`` is (P, N, R), ``residuals`` (N, R), ``prior_precision`` (P, P). Pixels of one image
    have common errors.
    """
    flat = jacobian.reshape(len(jacobian), -1)
    bread = np.linalg.inv(flat @ flat.T + prior_precision)
    scores = np.einsum("pnk,nk->np", jacobian, residuals)
    count = len(scores)
    filling = scores.T @ scores * count / max(1, count - len(jacobian) / max(1, n_heliostats))
    return np.sqrt(np.diag(bread @ filling @ bread))


@dataclass(frozen=True, eq=False)
class _Point:
    """Values (P,) of unknowns and the residuals (N, R) there."""

    values: Array
    residuals: Array


@dataclass(frozen=True, eq=False)
class _FitProblem:
    """The fit of unknowns as a least-squares problem."""

    fitter: Fitter
    unknowns: ParameterVector

    def cost(self, point: _Point) -> float:
        return self.fitter.cost(self.unknowns, point.values, point.residuals)

    def jacobian(self, point: _Point) -> Array:
        return self.fitter.jacobian(self.unknowns, point.values, point.residuals)

    def quadratic(self, point: _Point, jacobian: Array) -> Quadratic:
        flat, precision = jacobian.reshape(len(jacobian), -1), self.unknowns.prior_precision
        prior_gradient = precision @ (point.values - self.unknowns.neutral)
        return Quadratic(
            -(flat @ point.residuals.ravel() + prior_gradient), flat @ flat.T + precision
        )

    def bounds(self, point: _Point) -> Bounds:
        low, high = self.unknowns.bounds
        return Bounds(low - point.values, high - point.values)

    def step(self, point: _Point, change: Array) -> _Point:
        values = point.values + change
        return _Point(values, self.fitter.residuals(self.unknowns, values))
