"""Judging fits by images that they have not seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.study.flux_images import FluxImage

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


FRESH = 2
"""Images that no surface was predicted from, from which on they alone judge."""


def split(flux_images: Sequence[FluxImage]) -> Split:
    """Every second image of each heliostat, by the sun's elevation, judges; and one heliostat of several is kept apart.

    The one that is kept apart is at the median distance: the others span it. Images that surfaces were predicted from
    do not judge; where fewer than `FRESH` others are left they have to, which the report says.
    """
    seen = [p.seen for p in flux_images]
    judged_apart = any(seen) and seen.count(False) >= FRESH
    names = sorted({p.heliostat for p in flux_images})
    distance = {name: np.mean([p.slant_range for p in flux_images if p.heliostat == name]) for name in names}
    kept = sorted(names, key=lambda name: distance[name])[len(names) // 2] if len(names) >= SEVERAL else None
    parts: dict[str, list[int]] = {"fit": [], "own": [], "held_out": []}
    for name in names:
        rows = [row for row, p in enumerate(flux_images) if p.heliostat == name]
        rows.sort(key=lambda row: (flux_images[row].elevation_deg, flux_images[row].key))
        fitted = [row for row in rows if seen[row]] if judged_apart else rows[::2]
        if not fitted:  # a heliostat none of whose images is seen, beside others
            fitted = rows[::2]
        parts["own" if name == kept else "fit"] += fitted
        parts["held_out"] += [row for row in rows if row not in fitted]
    return Split(*(np.array(sorted(parts[part]), dtype=np.int64) for part in ("fit", "own", "held_out")))


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


def rank_correlation(a: Array, b: Array) -> float:
    """Spearman's rank correlation; zero where one of them does not vary."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return 0.0
    first, second = (np.argsort(np.argsort(values)).astype(np.float64) for values in (a, b))
    return float(np.corrcoef(first, second)[0, 1])
