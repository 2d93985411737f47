"""A clock that was set wrong: from one day on the suns of all heliostats stood minutes beside where they were recorded.

A minute turns the sun by 4.4 mrad, and the light of every heliostat with it. In one heliostat that looks like a step of
its drives, and is believed to be one; in many at once, in the sense and size that each one's mirror makes of the sun's
way, it is the clock. With g what a residual changes by a minute, P the inverse covariance of the residuals with mount,
drift, jitter and other steps unknown, and y what they shall explain, a heliostat says ``g' P y / g' P g`` minutes with
variance ``1 / g' P g``; all days are tried for the one that it began on.

A clock that was wrong all the time is hardly told: foundations that are turned make up for it, which leaves a third of
a minute even where 16 of them are believed to be straight in the mean. So it is looked for from some day on only; and
one that is put right is found as well, by the opposite sign.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.pointing.calibration import Kind, Part, calibrate, parts
from model.pointing.kinematics import Readings, residuals
from model.pointing.readings import later

Array = NDArray[np.float64]

SURE = 5.0
"""Standard deviations from none that a fault of the clock must lie, by all heliostats but the one that says most."""

LEAST_MINUTES = 0.3
"""Less than that [min] may be a target that was surveyed anew, or a sun's position by other formulae."""

# Heliostats that agree, and their share of all information: steps of a few on one day are no clock.
_LEAST_HELIOSTATS = 3
_MOST_AGREE = 0.75

# Standard deviations within which one agrees, and rounds of finding those.
_AGREES = 3.0
_ROUNDS = 3

# A heliostat whose own standard deviation is larger than a minute says nothing [1/min2].
_LEAST_INFORMATION = 1.0


@dataclass(frozen=True)
class Clock:
    """That a clock went wrong.

    Attributes
    ----------
    minutes, std_minutes : float [min]
        The sun really stood where it is so many minutes after the recorded time: the clock is slow where positive. Both
        against the time before.
    since : float [d]
        The day of the first measurement with it.
    """

    minutes: float
    std_minutes: float
    since: float


def find_clock(kinds: Sequence[Kind], readings: Readings, latitude_deg: float) -> Clock | None:
    """The fault of the clock that calibrations by ``readings`` took for steps; None where none is sure.

    It needs three heliostats that were measured before and after. Steps that were believed in its place have taken a
    part of it: with the suns that it makes likely they go, and what is left by then is added.
    """
    days = np.unique(np.floor(readings.days[readings.used]))
    minutes, std, is_fault = _agreed(*_by_day(kinds, readings, latitude_deg, days))
    if not is_fault.any():
        return None
    best = int(np.where(is_fault, np.abs(minutes) / std, 0.0).argmax())
    since, first = days[best], float(minutes[best])
    wrong = (readings.days >= since)[..., None]
    turned = replace(readings, sun=np.where(wrong, later(readings.sun, first, latitude_deg), readings.sun))
    again = [(rows, calibrate(done.chain, turned.of(rows), done.noise, done.field)) for rows, done in kinds]
    left, std, _ = _agreed(*_by_day(again, turned, latitude_deg, days[best : best + 1]))
    return Clock(first + float(left[0]), float(std[0]), float(since))


def _agreed(pull: Array, information: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Minutes (D,) that most of H heliostats agree on, their standard deviations, and whether that is a fault.

    ``pull`` and ``information`` (H, D) are each one's. Heliostats that differ by more than their variances make the
    deviation larger (Birge's ratio). A fault matters, and is sure without the heliostat that says most, too.
    """
    tells = information >= _LEAST_INFORMATION
    weight = np.where(tells, information, 0.0)
    own = pull / np.where(tells, information, np.inf)
    center = np.ma.median(np.ma.masked_array(own, ~tells), axis=0).filled(0.0)  # type: ignore[no-untyped-call]
    for _ in range(_ROUNDS):
        agrees = tells & (np.abs(own - center) * np.sqrt(weight) <= _AGREES)
        agreed = np.where(agrees, weight, 0.0)
        total = np.maximum(agreed.sum(axis=0), _LEAST_INFORMATION)
        center = (agreed * own).sum(axis=0) / total
    count = agrees.sum(axis=0)
    scatter = np.sqrt(np.maximum(1.0, (agreed * (own - center) ** 2).sum(axis=0) / np.maximum(count - 1, 1)))
    said = agreed * own
    most = np.abs(said).argmax(axis=0)[None]
    others, told = (value.sum(axis=0) - np.take_along_axis(value, most, axis=0)[0] for value in (said, agreed))
    of_others = np.abs(others) / np.sqrt(np.maximum(told, _LEAST_INFORMATION))
    is_common = (count >= _LEAST_HELIOSTATS) & (agreed.sum(axis=0) >= _MOST_AGREE * weight.sum(axis=0))
    is_fault = is_common & (of_others >= SURE * scatter) & (np.abs(center) >= LEAST_MINUTES)
    return center, scatter / np.sqrt(total), is_fault


def _by_day(kinds: Sequence[Kind], readings: Readings, latitude_deg: float, days: Array) -> tuple[Array, Array]:
    """Pull and information (H, D) on minutes from each of ``days`` (D,) on; none before a heliostat's first."""
    pull, information = np.zeros((2, len(readings.days), len(days)))
    for part in parts(kinds, readings):
        told = part.posterior.told_of_a_change(_by_minute(part, latitude_deg))
        for row, when, used, *own in zip(part.rows, part.readings.days, part.readings.used, *told, strict=True):
            first = np.searchsorted(when[used], days)
            inside = (first > 0) & (first < used.sum())
            pull[row, inside], information[row, inside] = (value[first[inside]] for value in own)
    return pull, information


def _by_minute(part: Part, latitude_deg: float) -> Array:
    """What residuals change (H, M, 2) [rad/min] by later suns; they are linear in the sun."""
    ahead, behind = (
        residuals(
            part.chain,
            replace(part.readings, sun=later(part.readings.sun, half, latitude_deg)),
            part.parameters,
            part.zeros,
        )[0]
        for half in (0.5, -0.5)
    )
    return np.asarray(ahead - behind)
