"""Find a clock fault: from one day on the recorded suns of all heliostats are minutes off.

Notes
-----
A minute moves the sun by 4.4 mrad, and the light of every heliostat with it. In one heliostat it
looks like a step of the drives. In many at once, with the sign and size that each mirror makes of
the sun's motion, it is the clock. With g the derivative of the residuals by a minute, A their
precision with mount, drift, jitter and other steps unknown, and y the residuals, each heliostat
estimates ``g' A y / g' A g`` minutes with variance ``1 / g' A g``. All days are tried as the first.

A clock that was always wrong is hardly observable: rotations of the foundations compensate all but
a third of a minute, even with 16 foundations whose mean is straight. So only changes are sought. A
clock that is corrected is found by the opposite sign.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.pointing.calibration import Batch, Kind, calibrate, calibrated_batches
from model.pointing.drives import ChangePointScore
from model.pointing.kinematics import Readings, residuals
from model.site import Site

Array = NDArray[np.float64]

MIN_SIGNIFICANCE = 5.0
"""Smallest significance [standard deviations] without the most informative heliostat."""

MIN_MINUTES = 0.3
"""Smallest fault [min]: less may be a new target survey, or another solar ephemeris."""

# Smallest number of consistent heliostats, and their smallest share of all information: steps of a
# few are no clock.
_MIN_HELIOSTATS = 3
_MIN_INFORMATION_SHARE = 0.75

# Standard deviations within which a heliostat is consistent, and rounds of finding those.
_CONSISTENT = 3.0
_ROUNDS = 3

# Information below which a heliostat is ignored: a standard deviation above one minute [1/min2].
_MIN_INFORMATION = 1.0


@dataclass(frozen=True)
class ClockFault:
    """A clock that went wrong on a day.

    Attributes
    ----------
    minutes, std_minutes : float [min]
        The true sun is that of so many minutes after the recorded time: positive if the clock is
        slow. Both relative to the time before.
    since : float [d]
        The day of the first measurement with it.
    """

    minutes: float
    std_minutes: float
    since: float


def find_clock_fault(kinds: Sequence[Kind], readings: Readings, site: Site) -> ClockFault | None:
    """Find the clock fault that calibrations by ``readings`` took for steps; None if none is
    significant.

    It needs three heliostats that were measured before and after. Steps in its place have explained
    a part of it: a second calibration with corrected suns finds the remainder.
    """
    days = np.unique(np.floor(readings.days[readings.used & np.isfinite(readings.days)]))
    estimate = _combine(_score_by_day(kinds, readings, site, days))
    if not estimate.is_fault.any():
        return None
    significance = np.abs(estimate.minutes) / estimate.std
    best = int(np.where(estimate.is_fault, significance, 0.0).argmax())
    since, first = days[best], float(estimate.minutes[best])
    wrong = (readings.days >= since)[..., None]
    turned = replace(
        readings, sun=np.where(wrong, site.advance_sun(readings.sun, first), readings.sun)
    )
    again = [
        (rows, calibrate(done.chain, turned.of(rows), done.noise, done.prior))
        for rows, done in kinds
    ]
    left = _combine(_score_by_day(again, turned, site, days[best : best + 1]))
    return ClockFault(first + float(left.minutes[0]), float(left.std[0]), float(since))


class _ClockEstimate(NamedTuple):
    """Minutes and their standard deviations for D first days, and whether each is a fault (D,)."""

    minutes: Array
    std: Array
    is_fault: NDArray[np.bool_]


def _combine(scores: ChangePointScore) -> _ClockEstimate:
    """Combine the scores (H, D) of H heliostats.

    A scatter beyond the variances widens the standard deviation (Birge ratio). A fault is large
    enough, and significant without the most informative heliostat.
    """
    score, information = scores
    is_informative = information >= _MIN_INFORMATION
    weight = np.where(is_informative, information, 0.0)
    minutes = score / np.where(is_informative, information, np.inf)
    masked = np.ma.masked_array(minutes, ~is_informative)
    center = np.ma.median(masked, axis=0).filled(0.0)  # type: ignore[no-untyped-call]
    for _ in range(_ROUNDS):
        is_consistent = is_informative & (np.abs(minutes - center) * np.sqrt(weight) <= _CONSISTENT)
        consistent = np.where(is_consistent, weight, 0.0)
        total = np.maximum(consistent.sum(axis=0), _MIN_INFORMATION)
        center = (consistent * minutes).sum(axis=0) / total
    count = is_consistent.sum(axis=0)
    square = (consistent * (minutes - center) ** 2).sum(axis=0) / np.maximum(count - 1, 1)
    scatter = np.sqrt(np.maximum(1.0, square))
    weighted = consistent * minutes
    most = np.abs(weighted).argmax(axis=0)[None]
    other_scores, other_information = (
        value.sum(axis=0) - np.take_along_axis(value, most, axis=0)[0]
        for value in (weighted, consistent)
    )
    significance = np.abs(other_scores) / np.sqrt(np.maximum(other_information, _MIN_INFORMATION))
    is_common = (count >= _MIN_HELIOSTATS) & (
        consistent.sum(axis=0) >= _MIN_INFORMATION_SHARE * weight.sum(axis=0)
    )
    is_fault = (
        is_common & (significance >= MIN_SIGNIFICANCE * scatter) & (np.abs(center) >= MIN_MINUTES)
    )
    return _ClockEstimate(center, scatter / np.sqrt(total), is_fault)


def _score_by_day(
    kinds: Sequence[Kind], readings: Readings, site: Site, days: Array
) -> ChangePointScore:
    """Score minutes from each of ``days`` (D,) on; 0 before a heliostat's first measurement."""
    score, information = np.zeros((2, len(readings.days), len(days)))
    for batch in calibrated_batches(kinds, readings):
        scores = batch.model.change_point_score(_by_minute(batch, site))
        for row, when, used, *values in zip(
            batch.rows, batch.readings.days, batch.readings.used, *scores, strict=True
        ):
            undated = int(np.isnan(when[used]).sum())
            first = undated + np.searchsorted(when[used][undated:], days)
            inside = (first > undated) & (first < used.sum())
            score[row, inside], information[row, inside] = (
                value[first[inside]] for value in values
            )
    return ChangePointScore(score, information)


def _by_minute(batch: Batch, site: Site) -> Array:
    """Derivative (H, M, 2) [rad/min] of the residuals, which are linear in the sun, by its time."""
    ahead, behind = (
        residuals(
            batch.chain,
            replace(batch.readings, sun=site.advance_sun(batch.readings.sun, half)),
            batch.parameters,
            batch.zeros,
        ).values
        for half in (0.5, -0.5)
    )
    return np.asarray(ahead - behind)
