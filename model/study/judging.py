"""Judging fits by images that they have not seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

from model.study.flux_images import FluxImage
from model.study.scopes import days_of

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

FEW = 3
"""Images of a heliostat from which on they tell how much they scatter."""

SEVERAL = 3
"""Heliostats from which on one of them is kept from the fits of what all have in common."""


@dataclass(frozen=True, eq=False)
class Split:
    """Which photographs are fitted and which judge.

    Attributes
    ----------
    fit : Rows
        Images of the heliostats that all unknowns are fitted to.
    own : Rows
        Images of the heliostats that are kept from the fit: only what belongs to one heliostat is fitted to them.
    held_out : Rows
        Images that no fit sees, of all heliostats.
    """

    fit: Rows
    own: Rows
    held_out: Rows

    @property
    def fitted(self) -> Rows:
        """All that are fitted in some way."""
        return np.sort(np.concatenate([self.fit, self.own]))


FRESH = 2
"""Images that no surface was predicted from, from which on they alone judge."""


def split(flux_images: Sequence[FluxImage]) -> Split:
    """Every second image of each heliostat judges; and one heliostat of several is kept apart.

    They are counted by the day, where most have one, and by the sun's elevation: what comes and goes shall be seen by
    fits and by judges alike.

    The one that is kept apart is at the median distance: the others span it. Images that surfaces were predicted from
    do not judge; where fewer than `FRESH` others are left they have to, which the report says.
    """
    seen, dated = [p.seen for p in flux_images], days_of(flux_images) is not None
    judged_apart = any(seen) and seen.count(False) >= FRESH
    names = sorted({p.heliostat for p in flux_images})
    distance = {name: np.mean([p.slant_range for p in flux_images if p.heliostat == name]) for name in names}
    kept = sorted(names, key=lambda name: distance[name])[len(names) // 2] if len(names) >= SEVERAL else None
    parts: dict[str, list[int]] = {"fit": [], "own": [], "held_out": []}
    for number, name in enumerate(sorted(names, key=lambda name: name == kept)):
        rows = [row for row, p in enumerate(flux_images) if p.heliostat == name]
        rows.sort(key=lambda row: _turn(flux_images[row], dated))
        # Of a day on which every heliostat was photographed once, some judge and some are fitted.
        fitted = [row for row in rows if seen[row]] if judged_apart else rows[number % 2 if dated else 0 :: 2]
        if not fitted:  # a heliostat none of whose images is seen, beside others
            fitted = rows[::2]
        parts["own" if name == kept else "fit"] += fitted
        parts["held_out"] += [row for row in rows if row not in fitted]
    return Split(*(np.array(sorted(parts[part]), dtype=np.int64) for part in ("fit", "own", "held_out")))


def _turn(flux_image: FluxImage, dated: bool) -> tuple[str, float, str]:
    day = flux_image.taken_at.date().isoformat() if dated and flux_image.taken_at is not None else ""
    return day, flux_image.elevation_deg, flux_image.key


@dataclass(frozen=True)
class Gain:
    """Mean of paired differences, its 95 % interval and how many standard errors it is worth."""

    mean: float
    low: float
    high: float
    score: float


def paired_gain(differences: Array, heliostats: NDArray[np.str_], rounds: int = 2000, seed: int = 0) -> Gain:
    """Bootstrap of the mean of paired differences (N,), images drawn anew within each heliostat.

    Heliostats with fewer than `FEW` images are drawn from together: one alone would seem to be certain.

    Source: Efron and Tibshirani 1993, *An Introduction to the Bootstrap*, chapters 8 and 13.
    """
    rng, total = np.random.default_rng(seed), np.zeros(rounds)
    names, members, counts = np.unique(heliostats, return_inverse=True, return_counts=True)
    groups = np.where(counts < FEW, -1, np.arange(len(names)))[members]
    if 0 < (groups == -1).sum() < FEW:
        groups[:] = 0
    for group in np.unique(groups):
        own = differences[groups == group]
        total += own[rng.integers(len(own), size=(rounds, len(own)))].sum(axis=1)
    means = total / len(differences)
    low, high = np.quantile(means, [0.025, 0.975])
    mean = float(differences.mean())
    return Gain(mean, float(low), float(high), mean / max(float(means.std()), 1e-9))


USUAL, USUAL_SCATTER = 2, 0.01
"""What is known beforehand of the standard deviation of gains from image to image, and from how many, as it were."""


def few_gain(differences: Array, among: int = 1) -> Gain:
    """The mean of a few differences (N,) with its 95 % interval by a moderated t; fewer than two gain nothing.

    How much few images scatter is hardly known from themselves, and counts as if `USUAL` images had shown their usual
    scatter besides. The interval holds for all ``among`` gains that are looked at at once (Bonferroni).

    Source: Smyth, *Linear models and empirical Bayes methods*, Stat. Appl. Genet. Mol. Biol. 3 (2004), section 4.
    """
    count = len(differences)
    if count < 2:
        return Gain(0.0, 0.0, 0.0, 0.0)
    mean, freedom = float(differences.mean()), count - 1 + USUAL
    variance = (((differences - mean) ** 2).sum() + USUAL * USUAL_SCATTER**2) / freedom
    error = float(variance / count) ** 0.5
    reach = float(t.ppf(1 - 0.025 / among, freedom)) * error
    return Gain(mean, mean - reach, mean + reach, mean / error)


def rank_correlation(a: Array, b: Array) -> float:
    """Spearman's rank correlation; zero where one of them does not vary."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return 0.0
    first, second = (np.argsort(np.argsort(values)).astype(np.float64) for values in (a, b))
    return float(np.corrcoef(first, second)[0, 1])
