"""Calibrated mounts: parameters, and the zeros of the drives over time.

Notes
-----
Between two measurements drift and jitter are interpolated as Ornstein-Uhlenbeck processes. With the
correlations a and b of a time with the measurements before and after::

    mean      (a (1 - b^2) before + b (1 - a^2) after) / (1 - a^2 b^2)
    variance  1 - a a (1 - b^2) / (1 - a^2 b^2) - b b (1 - a^2) / (1 - a^2 b^2)
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import date, datetime, timedelta
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.mount import Mount
from model.plant import Heliostat
from model.pointing.calibration import Calibration
from model.pointing.drives import Noise, Posterior
from model.pointing.kinematics import (
    SPREAD,
    STROKES,
    ZEROS,
    KinematicChain,
    Readings,
    apply_parameters,
)

Array = NDArray[np.float64]

DETERMINED = 0.5
"""A parameter is determined if its standard deviation is below this share of the prior's."""

# Standard deviations of a significant movement of a drive.
_SIGNIFICANT = 3.0

_DRIVES = ("first", "second")


@dataclass(frozen=True, eq=False)
class Step:
    """A change of the drives' zeros between two measurements.

    Attributes
    ----------
    before, after : int
        Indices of the last measurement before it and the first after.
    zeros, std : (2,) [rad]
        Change of the zeros, and its standard deviation.
    motors : (2,) [steps]
        The same in motor steps, at the motor positions of that time.
    """

    before: int
    after: int
    zeros: Array
    std: Array
    motors: Array


@dataclass(frozen=True)
class PredictedError:
    """Pointing error that a next photograph will show: median and 90 % interval [rad].

    ``measurements`` is the number of measurements whose predictions it is based on.
    """

    median: float
    low: float
    high: float
    measurements: int


@dataclass(frozen=True)
class Cause:
    """Likely cause of a step: ``referenced`` or ``lost_steps``, and a ``detail`` in words."""

    code: str
    detail: str


class AdjacentMeasurements(NamedTuple):
    """Times (N,) [d], and indices (N,) of the last measurement before and the first after each."""

    when: Array
    before: NDArray[np.intp]
    after: NDArray[np.intp]


class ProcessShares(NamedTuple):
    """Shares (N,) of the values before and after, and the variance (N,) [1] that is left."""

    before: Array
    after: Array
    variance: Array


def process_shares(at: AdjacentMeasurements, days: Array, memory_days: float) -> ProcessShares:
    """Interpolate an Ornstein-Uhlenbeck process of variance one between measurements at ``days``.

    It is a Markov process: between two known values no other value matters.
    """
    first, second = (
        np.exp(-np.abs(at.when - days[place]) / memory_days) for place in (at.before, at.after)
    )
    both = np.maximum(1 - (first * second) ** 2, 1e-12)
    before, after = first * (1 - second**2) / both, second * (1 - first**2) / both
    is_end = at.before == at.after
    before, after = np.where(is_end, first, before), np.where(is_end, 0.0, after)
    is_same_time = ~is_end & (first * second > 1 - 1e-12)
    before = np.where(is_same_time, 1.0, before)
    return ProcessShares(before, after, np.clip(1 - before * first - after * second, 0, 1))


@dataclass(frozen=True, eq=False)
class CalibratedMount:
    """The calibration of one mount.

    Attributes
    ----------
    parameters : (P,)
        In the order of `PARAMETERS`, added to the heliostat's properties.
    covariance : (P, P)
        Of the parameters at the newest measurement, with its drift.
    spread, prior_spread : (P,)
        Standard deviations of the parameters by posterior and prior.
    days : (M,) [d]
        Times of the measurements, ascending; first those that are not known, NaN.
    drift, jitter, stepped : (M, 2) [rad]
        Additions to the zeros at each measurement: slow, over hours, and the sum of all steps.
    drifted_std : (2,) [rad]
        Standard deviation of the drift from the first measurement to the newest.
    foreign : (M,) of bool
        Measurements that contradict all others.
    residuals : (M, 2) [rad]
        Of the measurements.
    steps : tuple of Step
    predicted : (M,) [rad]
        Errors of the measurements when other days predict them; NaN if they are not predicted.
    prediction : PredictedError or None
        None if too few measurements are predicted.
    noise : Noise
    """

    parameters: Array
    covariance: Array
    spread: Array
    prior_spread: Array
    days: Array
    drift: Array
    jitter: Array
    stepped: Array
    drifted_std: Array
    foreign: NDArray[np.bool_]
    residuals: Array
    steps: tuple[Step, ...]
    predicted: Array
    prediction: PredictedError | None = None
    noise: Noise = field(default_factory=Noise)

    @classmethod
    def uncalibrated(cls) -> "CalibratedMount":
        """Return the mount of a heliostat without measurements in a field without measurements."""
        none = np.zeros((0, 2))
        return cls(
            parameters=np.zeros(len(SPREAD)),
            covariance=np.diag(SPREAD**2),
            spread=SPREAD,
            prior_spread=SPREAD,
            days=np.zeros(0),
            drift=none,
            jitter=none,
            stepped=none,
            drifted_std=np.zeros(2),
            foreign=np.zeros(0, dtype=bool),
            residuals=none,
            steps=(),
            predicted=np.zeros(0),
        )

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Mark the parameters (P,) that the data determine."""
        return np.asarray(self.spread < DETERMINED * self.prior_spread)

    def zeros_at(self, days: ArrayLike) -> Array:
        """Return the additions to the zeros (N, 2) [rad] at ``days`` (N,); NaN means the newest.

        Drift and jitter are interpolated by their processes; a step is halfway between two
        measurements.
        """
        at = self._adjacent(days)
        if self.until is None:
            return np.zeros((len(at.when), 2))
        nearest = np.where(
            2 * at.when < self.days[at.before] + self.days[at.after], at.before, at.after
        )
        slow, quick = (
            share.before[:, None] * value[at.before] + share.after[:, None] * value[at.after]
            for value, share in zip((self.drift, self.jitter), self._shares(at), strict=True)
        )
        return np.asarray(self.stepped[nearest] + slow + quick)

    def zeros_variance_at(self, days: ArrayLike) -> Array:
        """Return the variances (N, 2) [rad2] that zeros at ``days`` (N,) have by interpolation."""
        at = self._adjacent(days)
        if self.until is None:
            jitter = np.square(self.noise.jitter_rad) if len(self.days) else np.zeros(2)
            return np.tile(jitter, (len(at.when), 1))
        spreads = (self.noise.drift_rad, self.noise.jitter_rad)
        left = [
            share.variance[:, None] * np.square(spread)
            for share, spread in zip(self._shares(at), spreads, strict=True)
        ]
        return np.asarray(np.sum(left, axis=0))

    def _adjacent(self, days: ArrayLike) -> AdjacentMeasurements:
        """Find the measurements before and after ``days`` (N,)."""
        when = np.atleast_1d(np.asarray(days, dtype=np.float64))
        if self.until is None:
            return AdjacentMeasurements(when, *np.zeros((2, len(when)), np.intp))
        when = np.where(np.isnan(when), self.days[-1], when)
        after = self.n_undated + np.searchsorted(self.days[self.n_undated :], when)
        last = len(self.days) - 1
        return AdjacentMeasurements(
            when, np.clip(after - 1, self.n_undated, last), np.clip(after, 0, last)
        )

    def _shares(self, at: AdjacentMeasurements) -> list[ProcessShares]:
        """Return the shares of drift and jitter."""
        memories = self.noise.drift_days, self.noise.jitter_days
        return [process_shares(at, self.days, memory) for memory in memories]

    def mount(self, nominal: Mount, day: float = np.nan) -> Mount:
        """Return the calibrated mount at a day, by default at the newest measurement."""
        parameters = self.parameters.copy()
        parameters[ZEROS] += self.zeros_at(day)[0]
        return replace(apply_parameters(nominal, parameters), calibrated_until=self.until)

    @property
    def until(self) -> date | None:
        """Day of the newest measurement; None if no time is known."""
        if np.isnan(self.days).all():
            return None
        return date(1970, 1, 1) + timedelta(days=float(self.days[-1]))

    def is_before(self, moment: datetime | None) -> bool:
        """Whether the whole calibration is of days before ``moment``; False if unknown."""
        return self.until is not None and moment is not None and moment.date() > self.until

    @property
    def n_undated(self) -> int:
        """The number of measurements of an unknown time: the first ones."""
        return int(np.isnan(self.days).sum())

    @property
    def residual_std_rad(self) -> float:
        """Robust standard deviation [rad] per direction of the residuals, from their median.

        The median angle of two equal normal components is sqrt(2 ln 2) standard deviations.
        """
        if self.foreign.all():
            return self.noise.spot_rad
        angles = np.linalg.norm(self.residuals[~self.foreign], axis=-1)
        return float(np.median(angles) / np.sqrt(2 * np.log(2)))


def cause_of(step: Step, mount: CalibratedMount) -> Cause:
    """Return the likely cause of a step of a mount.

    Lost steps move one drive. Referencing or repair moves both at once, or moves one back to its
    zero before an earlier step.
    """
    moved = np.abs(step.zeros) > _SIGNIFICANT * step.std
    moved |= np.abs(step.zeros) == np.abs(step.zeros).max()
    variance = step.std**2
    for earlier in reversed([other for other in mount.steps if other.after <= step.before]):
        variance = variance + earlier.std**2
        apart = np.abs(mount.stepped[step.after] - mount.stepped[earlier.before])
        if (apart < _SIGNIFICANT * np.sqrt(variance))[moved].all():
            detail = "back at its zero before an earlier step: referenced again"
            return Cause("referenced", detail)
    if moved.all():
        return Cause("referenced", "both drives at once: referenced again or repaired")
    drive = _DRIVES[int(moved.argmax())]
    return Cause("lost_steps", f"the {drive} drive alone: it likely lost steps")


def mounts_of(
    done: Calibration, heliostats: Sequence[Heliostat], readings: Readings
) -> list[CalibratedMount]:
    """Split a calibration of ``heliostats`` by ``readings`` into one mount for each."""
    nominal_chain, posterior = KinematicChain.of(heliostats), done.posterior
    parameters = posterior.parameters.copy()
    # Parameters count from the heliostat's properties, also if the calibration started from the
    # field's drives.
    parameters[:, ZEROS] += done.chain.zero - nominal_chain.zero
    parameters[:, STROKES] += done.chain.stroke - nominal_chain.stroke
    mounts = []
    for row, heliostat in enumerate(heliostats):
        known = slice(0, int(readings.used[row].sum()))
        nominal = apply_parameters(heliostat.mount, parameters[row])
        mounts.append(
            CalibratedMount(
                parameters=parameters[row],
                covariance=posterior.covariance[row],
                spread=posterior.spread[row],
                prior_spread=np.sqrt(np.diag(done.prior.covariance)),
                days=readings.days[row, known],
                drift=posterior.drift[row, known],
                jitter=posterior.jitter[row, known],
                stepped=posterior.steps[row, known],
                drifted_std=posterior.drifted_std[row],
                foreign=posterior.foreign[row, known],
                residuals=done.residuals[row, known],
                steps=tuple(_steps(posterior, row, nominal, readings)),
                predicted=np.full(known.stop, np.nan),
                noise=done.noise,
            )
        )
    return mounts


def _steps(posterior: Posterior, row: int, mount: Mount, readings: Readings) -> Iterator[Step]:
    """Iterate over the steps between measurements that are not foreign; several count as one."""
    is_good = readings.used[row] & ~posterior.foreign[row] & np.isfinite(readings.days[row])
    good = np.nonzero(is_good)[0]
    for before, after in pairwise(good):
        between = slice(before + 1, after + 1)
        if not posterior.stepped[row, between].any():
            continue
        zeros = posterior.steps[row, after] - posterior.steps[row, before]
        std = np.sqrt((posterior.steps_std[row, between] ** 2).sum(axis=0))
        motors = readings.steps[row, after]
        angle_of_a_step = (
            mount.angles_from_motors(motors + 1) - mount.angles_from_motors(motors - 1)
        ) / 2
        yield Step(int(before), int(after), zeros, std, zeros / angle_of_a_step)
