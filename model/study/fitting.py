"""Fitting effects to photographs: Levenberg and Marquardt within bounds, from several starts.

Images are compared in shares of their peak. Their residuals are far larger than their grain as long as the model lacks
something, so that all pixels count alike (`TRUST`); intervals come from how the images disagree, not from the pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect
from model.errors import InvalidInputError, UnreachableError
from model.study.photographs import Forecaster
from model.study.unknowns import Unknowns

Array = NDArray[np.float64]

TRUST = 0.03
"""Residual of a pixel [of the peak] that weighs as much as an unknown that is half its range away from neutral."""

STARTS = (-0.4, -0.15, -0.05, 0.05, 0.15, 0.4)
"""Where fits of an unknown begin, in shares of its range away from neutral."""

STEP = 2e-3
"""Step of the differences, in shares of an unknown's range."""

RESOLUTION = 32
"""Pixels a side in which fits compare; the sun has blurred all that is finer."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Values (P,) of unknowns, the cost there, and the standard deviation (P,) of the values."""

    values: Array
    cost: float
    spread: Array


class Fitter:
    """Fits unknowns to the photographs of a forecaster, beside effects that stay as they are."""

    def __init__(self, forecaster: Forecaster, fixed: Sequence[Effect] = (), iterations: int = 8) -> None:
        self.forecaster, self.fixed, self.iterations = forecaster, fixed, iterations
        self.heliostats = np.array([p.heliostat for p in forecaster.photographs])
        self.measured = forecaster.measured(RESOLUTION)
        self.peaks = self.measured.max(axis=(1, 2))

    def residuals(self, unknowns: Unknowns, values: Array) -> Array:
        """Measured minus forecast (N, RESOLUTION**2) in units of `TRUST`; infinite where the model fails."""
        try:
            forecast = self.forecaster.cuts([*self.fixed, *unknowns.effects(values)], RESOLUTION)
        except (UnreachableError, InvalidInputError):
            # A clock an hour off puts low suns below the horizon, and all light may be blocked: as wrong as can be.
            return np.full((len(self.measured), RESOLUTION**2), np.inf)
        difference = (self.measured - forecast) / self.peaks[:, None, None] / TRUST
        return np.asarray(difference.reshape(len(difference), -1))

    def _pull(self, unknowns: Unknowns, values: Array) -> Array:
        """Distances (P,) from neutral in half ranges: holds what images cannot tell."""
        low, high = unknowns.bounds
        return np.asarray((values - unknowns.neutral) / ((high - low) / 2))

    def cost(self, unknowns: Unknowns, values: Array, residuals: Array) -> float:
        """Half the sum of squares."""
        return float((residuals**2).sum() + (self._pull(unknowns, values) ** 2).sum()) / 2

    def jacobian(self, unknowns: Unknowns, values: Array, residuals: Array) -> Array:
        """Derivatives of the residuals (P, N, RESOLUTION**2); unknowns of different heliostats are changed at once."""
        low, high = unknowns.bounds
        derivatives = np.zeros((len(values), *residuals.shape))
        for places in unknowns.colours.values():
            steps = STEP * (high - low)[places]
            steps = np.where(values[places] + steps > high[places], -steps, steps)
            changed = values.copy()
            changed[places] += steps
            response = self.residuals(unknowns, changed) - residuals
            for place, step in zip(places, steps, strict=True):
                heliostat = unknowns.all[place].heliostat
                feels = np.full(len(residuals), True) if heliostat is None else self.heliostats == heliostat
                derivatives[place, feels] = response[feels] / step
        return derivatives

    def starts(self, unknowns: Unknowns, begin: Array, free: NDArray[np.bool_]) -> list[Array]:
        """Values to begin with, the best first: ``begin``, and its ``free`` unknowns one colour at a time elsewhere.

        Many effects are even in their parameter, and a fit from neutral would not move; some have several valleys.
        Heliostats choose apart where they have unknowns of their own.
        """
        low, high = unknowns.bounds
        base = self.residuals(unknowns, begin)
        chosen, found = begin.copy(), []
        for places in unknowns.colours.values():
            if not free[places].all():
                continue
            trials = [(self._energies(unknowns, places, base), begin[places])]
            for share in STARTS:
                trial = begin.copy()
                trial[places] = np.clip(begin[places] + share * (high - low)[places], low[places], high[places])
                if np.array_equal(trial, begin):
                    continue
                trials.append((self._energies(unknowns, places, self.residuals(unknowns, trial)), trial[places]))
            energies, options = np.array([t[0] for t in trials]), np.array([t[1] for t in trials])
            best = energies.argmin(axis=0)
            chosen[places] = options[best, np.arange(len(places))]
            single = begin.copy()
            single[places] = chosen[places]
            found.append(single)
        candidates = [begin, *found, chosen, *self._guesses(unknowns, begin, free)]
        costs = [self.cost(unknowns, c, self.residuals(unknowns, c)) for c in candidates]
        order = np.argsort(costs)
        unique: list[Array] = []
        for index in order:
            if not any(np.array_equal(candidates[index], other) for other in unique):
                unique.append(candidates[index])
        return unique

    def _guesses(self, unknowns: Unknowns, begin: Array, free: NDArray[np.bool_]) -> list[Array]:
        """``begin`` with each of the free effects' own guesses."""
        guessed = []
        for kind in unknowns.kinds:
            for guess in kind.guesses:
                values = begin.copy()
                for place, unknown in enumerate(unknowns.all):
                    if free[place] and unknown.effect is kind:
                        values[place] = guess.get(unknown.parameter.name, values[place])
                guessed.append(values)
        return guessed

    def _energies(self, unknowns: Unknowns, places: list[int], residuals: Array) -> Array:
        """Sum of squares (len(places),) over the images that feel each unknown."""
        by_image = (residuals**2).sum(axis=1)
        owners = [unknowns.all[place].heliostat for place in places]
        return np.array([by_image[self.heliostats == h].sum() if h is not None else by_image.sum() for h in owners])

    def fit(self, unknowns: Unknowns, begin: Array, free: NDArray[np.bool_] | None = None, tries: int = 2) -> Fit:
        """The best of the fits from the most promising starts; ``free`` (P,) are those that may start elsewhere."""
        free = np.full(len(begin), True) if free is None else free
        starts = self.starts(unknowns, begin, free)[:tries]
        return min((self.descend(unknowns, start) for start in starts), key=lambda fit: fit.cost)

    def descend(self, unknowns: Unknowns, values: Array) -> Fit:
        """The least cost near ``values`` (P,)."""
        low, high = unknowns.bounds
        scale = 4 / (high - low) ** 2
        damping, residuals = 1e-2, self.residuals(unknowns, values)
        cost = self.cost(unknowns, values, residuals)
        if not np.isfinite(cost):
            return Fit(values, cost, np.full(len(values), np.nan))
        for _ in range(self.iterations):
            jacobian = self.jacobian(unknowns, values, residuals)
            flat = jacobian.reshape(len(values), -1)
            curvature = flat @ flat.T + np.diag(scale)
            gradient = flat @ residuals.ravel() + self._pull(unknowns, values) * np.sqrt(scale)
            before = cost
            for _ in range(5):
                step = -np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient)
                trial = np.clip(values + step, low, high)
                trial_residuals = self.residuals(unknowns, trial)
                trial_cost = self.cost(unknowns, trial, trial_residuals)
                if trial_cost < cost:
                    values, residuals, cost, damping = trial, trial_residuals, trial_cost, damping / 5
                    break
                damping *= 8
            if before - cost < 1e-3 * before:
                break
        return Fit(values, cost, self._spread(jacobian, residuals, scale))

    def _spread(self, jacobian: Array, residuals: Array, scale: Array) -> Array:
        """Standard deviations (P,) by the sandwich of White (1980), with images, not pixels, as independent.

        Pixels of one image err together; how far images disagree says what a value is worth.
        """
        flat = jacobian.reshape(len(jacobian), -1)
        bread = np.linalg.inv(flat @ flat.T + np.diag(scale))
        scores = np.einsum("pnk,nk->np", jacobian, residuals)
        count = len(scores)
        filling = scores.T @ scores * count / max(1, count - len(jacobian) / max(1, len(np.unique(self.heliostats))))
        return np.sqrt(np.diag(bread @ filling @ bread))
