"""Whether an effect that was found is equally strong in halves of the photographs.

A cause has the same parameters for near and far heliostats, and under high and low suns. What
imitates a cause has not: its strength drifts with what the true cause scales with.

Notes
-----
An effect of strength s moves its parameters from neutral by s times what was fitted, so s = 1. One
step of Gauss-Newton gives the strength of a half, by residuals r and J = d r / d s of images::

    s = 1 - sum J r / sum J J,   variance = sum (J r)**2 / (sum J J)**2 n / (n - 1)

Halves are compared by Welch's t, at a familywise level of 1 % (Bonferroni).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ttest_ind_from_stats

from model.covariates import covariates_of
from model.study.fitting import Fitter
from model.study.parameters import Term
from model.study.trials import Trial, TrialFitter

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEVEL = 0.01
"""Probability that an effect of equal strength is said to drift, by any of the comparisons."""

MIN_DRIFT, MIN_DRIFT_ESTIMATED = 0.2, 0.4
"""Smallest differences of strengths that count, with exact and with estimated surfaces: two tracers
and a surface's finite resolution make small ones. Estimated surfaces have absorbed some of an
effect, near and far: a camera's true curve had strengths of 0.86 and 1.18.
"""

MIN_HALF = 4
"""Smallest number of photographs in a half."""

STEP = 0.05
"""Step of the strength for its derivative."""


class Strength(NamedTuple):
    """Strength [1] of an effect in some photographs, its deviation, and their number."""

    value: float
    std: float
    n_images: int


def strength(derivatives: Array, residuals: Array) -> Strength:
    """The strength by photographs with residuals (n, R) and their derivatives (n, R)."""
    scores, total = (derivatives * residuals).sum(axis=1), float((derivatives**2).sum())
    count = len(scores)
    variance = float((scores**2).sum()) / total**2 * count / (count - 1)
    return Strength(1 - float(scores.sum()) / total, variance**0.5, count)


def find_drifts(fitter: TrialFitter, trial: Trial) -> list[Term]:
    """The effects of a trial whose strengths differ between halves of the photographs."""
    rows = np.arange(len(fitter.flux_images))
    fit, parameters = Fitter(*fitter.forecasters(rows)), trial.parameters
    fit.take_off_grid(parameters, trial.values)
    residuals = fit.residuals(parameters, trial.values)
    halves, found = list(_halves(fitter)), []
    least = MIN_DRIFT_ESTIMATED if fitter.is_estimated else MIN_DRIFT
    for term in parameters.terms:
        own = np.array([u.term == term for u in parameters.all])
        away = np.where(own, trial.values - parameters.neutral, 0.0)
        step = -STEP  # towards neutral, so that no bound is crossed
        changed = fit.residuals(parameters, trial.values + step * away)
        derivatives = (changed - residuals) / step
        acting = (derivatives != 0).any(axis=1)
        pairs = [(half & acting, ~half & acting) for half in halves]
        pairs = [pair for pair in pairs if min(part.sum() for part in pair) >= MIN_HALF]
        tests = [
            p_equal(
                strength(derivatives[first], residuals[first]),
                strength(derivatives[second], residuals[second]),
                least,
            )
            for first, second in pairs
        ]
        if any(p < LEVEL / len(tests) / len(parameters.terms) for p in tests):
            found.append(term)
    return found


def p_equal(first: Strength, second: Strength, least: float = MIN_DRIFT) -> float:
    """Probability of such a difference of equal strengths; one for a difference below ``least``."""
    if abs(first.value - second.value) < least:
        return 1.0
    spread = (first.std * first.n_images**0.5, second.std * second.n_images**0.5)
    test = ttest_ind_from_stats(
        first.value,
        spread[0],
        first.n_images,
        second.value,
        spread[1],
        second.n_images,
        equal_var=False,
    )
    return float(test.pvalue)


def _halves(fitter: TrialFitter) -> Iterator[Mask]:
    """One half each of the photographs: by covariates, targets and heliostats."""
    setups = [p.setup for p in fitter.flux_images]
    for values in covariates_of(setups, fitter.model.site).values():
        if np.ptp(values) > 0:
            yield values > np.median(values)
    for name in sorted(set(fitter.heliostats.tolist())):
        yield fitter.heliostats == name
