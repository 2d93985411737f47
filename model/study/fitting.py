"""Fitting effects to photographs: Levenberg and Marquardt within bounds, from several starts.

Images are compared in shares of their peak. Their residuals are far larger than their grain as long as the model lacks
something, so that all pixels count alike (`PIXEL_NOISE`); intervals come from how the images disagree, not from the
pixels. Where a spot lies beside where its motors sent it is two more residuals (`model.study.position`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect
from model.errors import InvalidInputError, UnreachableError
from model.images import COARSE_SIZE
from model.least_squares import Descent, minimize
from model.study.flux_images import Forecaster
from model.study.unknowns import Unknowns, copied

Array = NDArray[np.float64]

PIXEL_NOISE = 0.03
"""Standard deviation of a pixel [of the peak] that fits count with, beside the unknowns' ``prior_std``."""

RESIDUALS = COARSE_SIZE**2 + 2
"""R, those of one photograph: its pixels, and where its spot lies."""

STARTS = (-0.4, -0.15, -0.05, 0.05, 0.15, 0.4)
"""Where fits of an unknown begin, in shares of its range away from neutral."""

WORST_START = 3
"""Cost of a start, in costs of the best one, above which none is made from it."""

AT_ONCE = 16
"""Forecasts of all images that are traced at once, where they differ in mirrors alone."""

STEP = 5e-3
"""Step of the differences, in shares of an unknown's range."""


TRIES = 3
"""Steps from one Jacobian, each shorter than the last, after which a fit has come to its end."""

DESCENT = Descent(steps=24, jacobians=8, patience=TRIES, least_share=1e-3)
"""How the least cost is sought; a Jacobian is few forecasts, and is taken after every step."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Values (P,) of unknowns, the cost there, and the standard deviation (P,) of the values."""

    values: Array
    cost: float
    spread: Array


class Fitter:
    """Fits unknowns to the photographs of a forecaster, beside effects that stay as they are.

    With a ``fine`` forecaster of the same photographs fits may be traced coarsely: what both differ by where a fit
    begins, its grid's trace in the image, is taken off.
    """

    def __init__(
        self,
        forecaster: Forecaster,
        fine: Forecaster | None = None,
        fixed: Sequence[Effect] = (),
        iterations: int = 8,
    ) -> None:
        self.forecaster, self.fine, self.fixed, self.iterations = forecaster, fine, fixed, iterations
        self.heliostats = np.array([p.heliostat for p in forecaster.flux_images])
        self.measured = forecaster.measured(COARSE_SIZE)
        self.peaks = self.measured.max(axis=(1, 2))

    def residuals(self, unknowns: Unknowns, values: Array) -> Array:
        """Measured minus forecast (N, R) in standard deviations; infinite where the model fails, 0 if not known."""
        return np.asarray(self.residuals_of(unknowns, values[None])[0])

    def residuals_of(self, unknowns: Unknowns, trials: Array) -> Array:
        """Residuals (M, N, R) of many trials (M, P), traced at once where only mirrors differ in them."""
        shared = np.array([unknown.shared for unknown in unknowns.all], dtype=bool)
        _, group = np.unique(trials[:, shared], axis=0, return_inverse=True)
        residuals = np.empty((len(trials), len(self.measured), RESIDUALS))
        for one in np.unique(group):
            rows = np.flatnonzero(group == one)
            for part in np.array_split(rows, -(-len(rows) // AT_ONCE)):
                residuals[part] = self._residuals_alike(unknowns, trials[part])
        return residuals

    def _residuals_alike(self, unknowns: Unknowns, trials: Array) -> Array:
        """Residuals (M, N, R) of trials (M, P) with the same shared unknowns."""
        count = len(trials)
        copies, values = unknowns.copies(trials)
        fixed = [copied(effect, count) for effect in self.fixed]
        forecaster, model = self.forecaster.copies(count), [*fixed, *copies.effects(values)]
        try:
            forecast, off = forecaster.cuts(model, COARSE_SIZE), forecaster.off(model)
        except (UnreachableError, InvalidInputError):
            if count > 1:
                return np.concatenate([self._residuals_alike(unknowns, trial[None]) for trial in trials])
            # A clock an hour off puts low suns below the horizon, and all light may be blocked: as wrong as can be.
            return np.full((1, len(self.measured), RESIDUALS), np.inf)
        difference = self.measured - forecast.reshape(count, *self.measured.shape)
        shares = difference / self.peaks[:, None, None] / PIXEL_NOISE
        parts = (shares, np.nan_to_num(off))
        return np.concatenate([part.reshape(count, len(self.measured), -1) for part in parts], axis=-1)

    def _take_off_grid(self, unknowns: Unknowns, begin: Array) -> None:
        """Add to the measured images what the coarse forecast of ``begin`` differs by from the fine one."""
        if self.fine is not None:
            model = [*self.fixed, *unknowns.acting(begin)]
            grid = self.forecaster.cuts(model, COARSE_SIZE) - self.fine.cuts(model, COARSE_SIZE)
            self.measured = self.forecaster.measured(COARSE_SIZE) + grid

    def cost(self, unknowns: Unknowns, values: Array, residuals: Array) -> float:
        """Half the sum of squares, and of the prior's, which fixes what images cannot tell."""
        away = values - unknowns.neutral
        return float((residuals**2).sum() + away @ unknowns.prior_precision @ away) / 2

    def jacobian(self, unknowns: Unknowns, values: Array, residuals: Array) -> Array:
        """Derivatives of the residuals (P, N, R); a group is changed at once."""
        low, high = unknowns.bounds
        steps = STEP * (high - low)
        steps = np.where(values + steps > high, -steps, steps)
        groups = list(unknowns.groups.values())
        trials = np.tile(values, (len(groups), 1))
        for trial, places in zip(trials, groups, strict=True):
            trial[places] += steps[places]
        derivatives = np.zeros((len(values), *residuals.shape))
        for places, response in zip(groups, self.residuals_of(unknowns, trials) - residuals, strict=True):
            for place in places:
                affected = self._affected(unknowns, place)
                derivatives[place, affected] = response[affected] / steps[place]
        return derivatives

    def _affected(self, unknowns: Unknowns, place: int) -> NDArray[np.bool_]:
        """Which images (N,) an unknown changes."""
        unknown = unknowns.all[place]
        return np.array([unknown.owns(p.heliostat, p.taken_at) for p in self.forecaster.flux_images])

    def starts(self, unknowns: Unknowns, begin: Array, free: NDArray[np.bool_]) -> tuple[list[Array], list[float]]:
        """Values to begin with and their costs, the best first: ``begin``, and its ``free`` unknowns elsewhere.

        Many effects are even in their parameter, and a fit from neutral would not move; some have several local optima.
        Each unknown is moved by itself; heliostats choose apart where they have unknowns of their own.
        """
        low, high = unknowns.bounds
        groups = [places for places in unknowns.groups.values() if free[places].all()]
        if not groups:
            return [begin], [0.0]
        trials = np.tile(begin, (len(groups), 1 + len(STARTS), 1))
        for moved, places in zip(trials, groups, strict=True):
            moved[:, places] += np.array([0.0, *STARTS])[:, None] * (high - low)[places]
        trials = np.clip(trials, low, high)
        residuals = self.residuals_of(unknowns, trials.reshape(-1, len(begin)))
        energies = (residuals**2).sum(axis=-1).reshape(*trials.shape[:2], -1)
        chosen, found = begin.copy(), []
        for moved, energy, places in zip(trials, energies, groups, strict=True):
            for place in places:
                best = energy[:, self._affected(unknowns, place)].sum(axis=1).argmin()
                chosen[place] = moved[best, place]
            if unknowns.all[places[0]].shared:
                found.append(np.where(np.isin(np.arange(len(begin)), places), chosen, begin))
        candidates = np.unique([begin, *found, chosen, *self._guesses(unknowns, begin, free)], axis=0)
        costs = [self.cost(unknowns, *c) for c in zip(candidates, self.residuals_of(unknowns, candidates), strict=True)]
        order = np.argsort(costs, kind="stable")
        return list(candidates[order]), [costs[index] for index in order]

    def _guesses(self, unknowns: Unknowns, begin: Array, free: NDArray[np.bool_]) -> list[Array]:
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

    def fit(self, unknowns: Unknowns, begin: Array, free: NDArray[np.bool_] | None = None, tries: int = 2) -> Fit:
        """The best of the fits from the most promising starts; ``free`` (P,) are those that may start elsewhere."""
        free = np.full(len(begin), True) if free is None else free
        self._take_off_grid(unknowns, begin)
        starts, costs = self.starts(unknowns, begin, free)
        promising = [start for start, cost in zip(starts, costs, strict=True) if not cost > WORST_START * costs[0]][
            :tries
        ]
        return min((self.descend(unknowns, start) for start in promising), key=lambda fit: fit.cost)

    def descend(self, unknowns: Unknowns, values: Array) -> Fit:
        """The least cost near ``values`` (P,)."""
        begin = _Point(values, self.residuals(unknowns, values))
        problem = _Problem(self, unknowns)
        cost = problem.cost(begin)
        if not np.isfinite(cost):
            return Fit(values, cost, np.full(len(values), np.nan))
        descent = replace(DESCENT, jacobians=self.iterations, steps=self.iterations * TRIES)
        found = minimize(problem, begin, descent)
        end = found.state
        return Fit(end.values, found.cost, self._spread(found.jacobian, end.residuals, unknowns.prior_precision))

    def _spread(self, jacobian: Array, residuals: Array, prior_precision: Array) -> Array:
        """Standard deviations (P,) by the sandwich of White (1980), with images, not pixels, as independent.

        Pixels of one image err together; how far images disagree says what a value is worth.
        """
        flat = jacobian.reshape(len(jacobian), -1)
        bread = np.linalg.inv(flat @ flat.T + prior_precision)
        scores = np.einsum("pnk,nk->np", jacobian, residuals)
        count = len(scores)
        filling = scores.T @ scores * count / max(1, count - len(jacobian) / max(1, len(np.unique(self.heliostats))))
        return np.sqrt(np.diag(bread @ filling @ bread))


@dataclass(frozen=True, eq=False)
class _Point:
    """Values (P,) of unknowns and the residuals (N, R) there."""

    values: Array
    residuals: Array


@dataclass(frozen=True, eq=False)
class _Problem:
    """The fit of unknowns as a least-squares problem."""

    fitter: Fitter
    unknowns: Unknowns

    def cost(self, point: _Point) -> float:
        return self.fitter.cost(self.unknowns, point.values, point.residuals)

    def response(self, point: _Point) -> Array:
        return point.residuals

    def jacobian(self, point: _Point) -> Array:
        return self.fitter.jacobian(self.unknowns, point.values, point.residuals)

    def quadratic(self, point: _Point, jacobian: Array) -> tuple[Array, Array]:
        flat, precision = jacobian.reshape(len(jacobian), -1), self.unknowns.prior_precision
        prior_gradient = precision @ (point.values - self.unknowns.neutral)
        return -(flat @ point.residuals.ravel() + prior_gradient), flat @ flat.T + precision

    def bounds(self, point: _Point) -> tuple[Array, Array]:
        low, high = self.unknowns.bounds
        return low - point.values, high - point.values

    def moved(self, point: _Point, change: Array) -> _Point:
        values = point.values + change
        return _Point(values, self.fitter.residuals(self.unknowns, values))
