"""Judge fits by images that no fit has seen."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, spearmanr, t

from model.study.flux_images import FluxImage
from model.study.scopes import MIN_SPAN, days_of

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

FEW = 3
"""Fewest images of a heliostat that give an estimate of their scatter."""

SEVERAL = 3
"""Smallest number of heliostats of which one is excluded from the fits of shared effects."""


@dataclass(frozen=True, eq=False)
class Split:
    """Which photographs are fitted, and which judge.

    Attributes
    ----------
    fit : Rows
        Images that all unknowns are fitted to.
    own : Rows
        Images of the excluded heliostat, to which only unknowns of that heliostat are fitted.
    held_out : Rows
        Images of all heliostats that no fit sees.
    """

    fit: Rows
    own: Rows
    held_out: Rows

    @property
    def fitted(self) -> Rows:
        """All images that are fitted."""
        return np.sort(np.concatenate([self.fit, self.own]))


FRESH = 2
"""Smallest number of images without a surface predicted from them that judge alone."""


def split(flux_images: Sequence[FluxImage]) -> Split:
    """Split photographs: every second image of each heliostat judges.

    The images are in order of their days, if most have one, and of the sun's elevation. So fits and
    judges see the same days. One heliostat of several is excluded from the fits of shared effects:
    the one of median distance, within the range of the others. Images that surfaces were predicted
    from are fitted and do not judge, unless fewer than `FRESH` others are left; the report says so.
    Of the others, those of days before or after them are split: a change may have come between.
    """
    seen, known_days = [p.seen for p in flux_images], days_of(flux_images)
    dated = known_days is not None
    days = [day or date.min for day in known_days or [None] * len(flux_images)]
    judged_apart = any(seen) and seen.count(False) >= FRESH
    names = sorted({p.heliostat for p in flux_images})
    distance = {
        name: np.mean([p.slant_range for p in flux_images if p.heliostat == name]) for name in names
    }
    kept = (
        sorted(names, key=lambda name: distance[name])[len(names) // 2]
        if len(names) >= SEVERAL
        else None
    )
    parts: dict[str, list[int]] = {"fit": [], "own": [], "held_out": []}
    for number, name in enumerate(sorted(names, key=lambda name: name == kept)):
        rows = [row for row, p in enumerate(flux_images) if p.heliostat == name]
        rows.sort(key=lambda row: (days[row], flux_images[row].elevation_deg, flux_images[row].key))
        used = [row for row in rows if judged_apart and seen[row]]
        span = [days[row] for row in used]
        apart = [row for row in rows if not used or not min(span) <= days[row] <= max(span)]
        # Even on a day with one image per heliostat, some are fitted and some judge.
        fitted = used + apart[number % 2 if dated else 0 :: 2]
        parts["own" if name == kept else "fit"] += fitted
        parts["held_out"] += [row for row in rows if row not in fitted]
    return Split(
        *(np.array(sorted(parts[part]), dtype=np.int64) for part in ("fit", "own", "held_out"))
    )


@dataclass(frozen=True)
class Gain:
    """Mean of paired differences, its 95 % interval, and its ratio to the standard error."""

    mean: float
    low: float
    high: float
    score: float


class BeforeAfter(NamedTuple):
    """A figure without and with effects or corrections."""

    before: float
    after: float


def paired_gain(
    differences: Array, heliostats: NDArray[np.str_], rounds: int = 2000, seed: int = 0
) -> Gain:
    """Bootstrap of the mean of paired differences (N,), resampled within each heliostat.

    Heliostats with fewer than `FEW` images are pooled: a single one would seem to be certain. The
    gain of fewer than two differences is zero.

    Source: Efron and Tibshirani 1993, *An Introduction to the Bootstrap*, chapters 8 and 13.
    """
    if len(differences) < 2:
        return Gain(0.0, 0.0, 0.0, 0.0)
    names, members, counts = np.unique(heliostats, return_inverse=True, return_counts=True)
    groups = np.where(counts < FEW, -1, np.arange(len(names)))[members]
    if 0 < (groups == -1).sum() < FEW:
        groups[:] = 0
    own = [differences[groups == group] for group in np.unique(groups)]

    def mean_of(*drawn: Array, axis: int) -> Array:
        return np.asarray(sum(some.sum(axis=axis) for some in drawn) / len(differences))

    drawn = bootstrap(own, mean_of, n_resamples=rounds, method="percentile", rng=seed)
    low, high = drawn.confidence_interval
    mean = float(differences.mean())
    return Gain(
        mean, float(low), float(high), mean / max(float(drawn.bootstrap_distribution.std()), 1e-9)
    )


def gain_to_json(gain: Gain) -> dict[str, Any]:
    """A gain in a report."""
    return {"mean": round(gain.mean, 5), "ci95": [round(gain.low, 5), round(gain.high, 5)]}


USUAL, USUAL_SCATTER = 2, 0.01
"""Prior of the standard deviation of gains among images: as if from `USUAL` images."""


def few_gain(differences: Array, among: int = 1) -> Gain:
    """Mean of a few differences (N,) with its 95 % interval by a moderated t.

    It is zero for fewer than two. The interval holds for ``among`` gains together (Bonferroni).

    Source: Smyth, *Linear models and empirical Bayes methods*, Stat. Appl. Genet. Mol. Biol. 3
    (2004), section 4.
    """
    count = len(differences)
    if count < 2:
        return Gain(0.0, 0.0, 0.0, 0.0)
    mean, freedom = float(differences.mean()), count - 1 + USUAL
    variance = (((differences - mean) ** 2).sum() + USUAL * USUAL_SCATTER**2) / freedom
    error = float(variance / count) ** 0.5
    reach = float(t.ppf(1 - 0.025 / among, freedom)) * error
    return Gain(mean, mean - reach, mean + reach, mean / error)


def clustered_gain(by_mirror: Sequence[Array]) -> Gain:
    """`few_gain` of the differences (N,) of each mirror, where those of a mirror err together.

    `paired_gain` takes the mirrors as given. Here they represent others: their mean errors count.

    Source: the cluster-robust variance of a mean, Liang and Zeger 1986.
    """
    gain, n_images = few_gain(np.concatenate(by_mirror)), sum(map(len, by_mirror))
    if len(by_mirror) < 2 or gain.score == 0:
        return gain
    together = np.array([(one - gain.mean).sum() for one in by_mirror]) / n_images
    error = math.sqrt(len(by_mirror) / (len(by_mirror) - 1) * float(together @ together))
    wider = max(1.0, error * gain.score / gain.mean)
    reach = wider * (gain.high - gain.mean)
    return Gain(gain.mean, gain.mean - reach, gain.mean + reach, gain.score / wider)


WORSE = 0.002
"""Smallest mean loss of accuracy [1] for which an effect is contradicted."""


def is_worse(gain: Gain) -> bool:
    """Whether a gain is a significant loss of more than `WORSE`."""
    return gain.high < 0 and gain.mean < -WORSE


@dataclass(frozen=True)
class EffectEnd:
    """The day from which photographs are worse with an effect, and its gain on them."""

    day: date
    gain: Gain


def find_end(gains: Array, days: Sequence[date]) -> EffectEnd | None:
    """Return the day from which an effect makes photographs worse; None if it does not.

    ``gains`` (N,) are changes of accuracy by the effect on photographs of ``days``. They must be
    worse to the last one, on `MIN_SPAN` days at least, so that a single day ends nothing.
    """
    taken, known = np.array(days), sorted(set(days))
    if len(known) < MIN_SPAN:
        return None
    ends = known[: len(known) - MIN_SPAN + 1]
    day = min(ends, key=lambda day: gains[taken >= day].sum())
    gain = few_gain(gains[taken >= day], among=len(ends))
    return EffectEnd(day, gain) if is_worse(gain) else None


def rank_correlation(a: Array, b: Array) -> float:
    """Spearman's rank correlation, ties by their mean rank; zero if one of them does not vary."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:  # SciPy would warn, and return NaN
        return 0.0
    return float(spearmanr(a, b).statistic)
