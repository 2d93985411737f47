"""Quality of predicted surfaces: outcomes of single cases, statistics, and tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from model.metrics import flux_accuracies, surface_error
from model.network.architecture import MAX_IMAGES
from model.observation import render_observations
from model.plant_model import JUELICH_MODEL
from training.cases import NEW_SUNS, Case
from training.methods import Method

Array = NDArray[np.float64]

WITHIN_90 = 1.645
"""Half width of a normal distribution's 90 % interval, in standard deviations."""


@dataclass(frozen=True)
class Outcome:
    """Quality of one predicted surface of one case.

    ``mae_mm`` is the error of its control heights. The accuracies are means over the new suns, on
    the source target and on `ELSEWHERE`. ``covered`` is the share of control heights within their
    90 % interval.
    """

    surface: str
    distance_m: float
    mae_mm: float
    accuracy: float
    accuracy_elsewhere: float
    covered: float | None


def judge(case: Case, z: Array, z_std: Array | None) -> Outcome:
    """Compare a predicted surface (4, 8, 8) [m], and its standard deviation, with the true one."""
    truth, forecast = (
        render_observations(case.heliostat, case.forecasts, s, JUELICH_MODEL).clip(min=0)
        for s in (case.truth, z)
    )
    accuracies = flux_accuracies(truth, forecast)
    return Outcome(
        surface=case.surface,
        distance_m=case.distance,
        mae_mm=surface_error(z, case.truth) * 1e3,
        accuracy=float(np.mean(accuracies[:NEW_SUNS])),
        accuracy_elsewhere=float(np.mean(accuracies[NEW_SUNS:])),
        covered=None
        if z_std is None
        else float((np.abs(z - case.truth) < WITHIN_90 * z_std).mean()),
    )


def outcomes_of(method: Method, cases: Sequence[Case], images: int = MAX_IMAGES) -> list[Outcome]:
    """The outcome of a method in each case."""
    return [judge(case, *method(case, images)) for case in cases]


def median_error(method: Method, cases: Sequence[Case], images: int) -> float:
    """Median error [mm] of control heights, predicted from ``images`` images."""
    return (
        float(np.median([surface_error(method(case, images)[0], case.truth) for case in cases]))
        * 1e3
    )


class BootstrapInterval(NamedTuple):
    """Ends of a 90 % interval."""

    low: float
    high: float


@dataclass(frozen=True)
class Figures:
    """Statistics of one method's outcomes.

    Accuracies are means, except ``flux_accuracy_median``. ``worse_than_ideal`` is the share of
    cases with a lower accuracy than the ideal surface. ``median_90`` and ``covered_90`` are
    bootstrap intervals over mirrors (`interval`).
    """

    cases: int
    mae_mm: dict[str, float]
    median_90: BootstrapInterval
    flux_accuracy: float
    flux_accuracy_median: float
    flux_accuracy_elsewhere: float
    worse_than_ideal: float
    covered: float | None
    covered_90: BootstrapInterval | None

    @classmethod
    def of(cls, outcomes: Sequence[Outcome], ideal: Sequence[Outcome]) -> "Figures":
        """Statistics of outcomes, compared with the ideal surface in the same cases.

        ``ideal`` may have more cases than ``outcomes``.
        """
        errors = np.array([o.mae_mm for o in outcomes])
        quantiles = dict(
            zip(
                ("min", "q1", "median", "q3", "max"),
                np.quantile(errors, np.arange(5) / 4),
                strict=True,
            )
        )
        accuracies = [o.accuracy for o in outcomes]
        worse = [o.accuracy < i.accuracy for o, i in zip(outcomes, ideal, strict=False)]
        covered = np.array([o.covered for o in outcomes if o.covered is not None])
        return cls(
            cases=len(outcomes),
            median_90=_over_mirrors(np.median, errors, outcomes),
            mae_mm={
                name: round(float(v), 4) for name, v in {**quantiles, "mean": errors.mean()}.items()
            },
            flux_accuracy=round(float(np.mean(accuracies)), 4),
            flux_accuracy_median=round(float(np.median(accuracies)), 4),
            flux_accuracy_elsewhere=round(
                float(np.mean([o.accuracy_elsewhere for o in outcomes])), 4
            ),
            worse_than_ideal=round(float(np.mean(worse)), 4),
            covered=round(float(np.mean(covered)), 4) if len(covered) else None,
            covered_90=_over_mirrors(np.mean, covered, outcomes) if len(covered) else None,
        )


def _over_mirrors(
    statistic: Callable[[Array], Any], values: Array, outcomes: Sequence[Outcome]
) -> BootstrapInterval:
    """`interval` of a statistic of the outcomes' values (N,)."""
    mirrors = np.array([o.surface for o in outcomes])
    groups = [values[mirrors == mirror] for mirror in np.unique(mirrors)]
    ends = interval(
        lambda drawn: float(statistic(np.concatenate([groups[i] for i in drawn]))), len(groups)
    )
    return BootstrapInterval(round(ends.low, 4), round(ends.high, 4))


def interval(
    statistic: Callable[[NDArray[np.int64]], float], mirrors: int, draws: int = 2000
) -> BootstrapInterval:
    """90 % bootstrap interval of a ``statistic`` over mirrors.

    The ``statistic`` takes indices of mirrors (mirrors,), which each draw samples again.
    """
    every = np.arange(mirrors)
    if mirrors < 2:  # one mirror cannot be resampled
        return BootstrapInterval(statistic(every), statistic(every))
    drawn = bootstrap(
        (every,),
        statistic,
        vectorized=False,
        n_resamples=draws,
        confidence_level=0.9,
        method="percentile",
        rng=0,
    )
    return BootstrapInterval(*map(float, drawn.confidence_interval))


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def shown(value: float | None, form: str = ".3f", between: BootstrapInterval | None = None) -> str:
    """Format a number for a table, with its interval if given; empty if it is unknown."""
    if value is None or np.isnan(value):
        return ""
    return format(value, form) + (
        "" if between is None else f" [{between[0]:{form}}, {between[1]:{form}}]"
    )
