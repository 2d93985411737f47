"""Infer how a calibrated mount changes over time: drift, steps and foreign measurements.

Notes
-----
Around a guess of the parameters the residuals of a heliostat's M measurements are linear in all
unknowns::

    y = J x + Z (drift + jitter + steps) + foreign + noise

    x        parameters of the mount, N(prior_mean, prior_cov), the prior of the field
    drift    of each drive's zero over years: Ornstein-Uhlenbeck process (drift_rad, drift_days)
    jitter   of each drive's zero over hours: Ornstein-Uhlenbeck process (jitter_rad, jitter_days)
    steps    a sudden change of one zero or both, from one measurement on
    foreign  a spot that is not the heliostat's: anywhere on the target
    noise    of a measured spot, N(0, spot_rad^2)

``J`` (2 M, P) and ``Z`` (2 M, 2) are derivatives by parameters and by zeros. Without steps and
foreign spots ``y`` is Gaussian, with the precision ``A = (J prior_cov J' + Z K Z' + spot_rad^2
I)^-1``, ``K`` the covariance of drift and jitter. A step or a foreign spot adds a block of columns
``D`` with sizes of N(0, V), so that its Bayes factor has a closed form::

    g = D' A y,   H = D' A D,   log B = (g' (H + V^-1)^-1 g - log det(H + V^-1) - log det V) / 2

A measurement of an unknown time, ``day`` NaN, has a drift and a jitter that no other measurement
shares, and comes before all others. No step begins at it. Which steps lie before it is not known
either: the squares of all steps are added to the variance of its zeros (`unknown_steps`). So it
informs about parameters only, not about changes over time.

`infer_changes` adds the change with the highest odds, then the next, while the odds are above one.
It drops a change whose odds fall below one (the Savage-Dickey density ratio). Each action raises
the posterior probability, so it ends.

Sources: Rasmussen and Williams 2006, *Gaussian Processes for Machine Learning*, ch. 2; Dickey 1971,
doi:10.1214/aoms/1177693507.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.pointing.kinematics import ZEROS, Readings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of all that is not a parameter, and prior odds of changes.

    The values maximise the evidence on half of the heliostats of `benchmarks.pointing`. The
    second drive's jitter is the scatter of photographs within one hour beyond the noise of their
    spots: wind and backlash.

    Attributes
    ----------
    spot_rad : float [rad]
        Of a measured spot, per direction.
    drift_rad, jitter_rad : pair of float [rad]
        Of the drives' zeros.
    drift_days, jitter_days : float [d]
        Correlation times.
    step_rad, foreign_rad : pair of float [rad]
        Of the change of a zero by a step, and of the distance of a foreign spot: common ones, and
        rare large ones.
    step_odds, foreign_odds : float
        Prior odds of a step before a measurement, and of a foreign spot in it.
    """

    spot_rad: float = 0.27e-3
    drift_rad: tuple[float, float] = (0.5e-3, 1.0e-3)
    drift_days: float = 300.0
    jitter_rad: tuple[float, float] = (0.05e-3, 0.45e-3)
    jitter_days: float = 0.06
    step_rad: tuple[float, float] = (5e-3, 60e-3)
    foreign_rad: tuple[float, float] = (10e-3, 0.3)
    step_odds: float = 2e-2
    foreign_odds: float = 1e-2

    def drift(self, apart_days: Array) -> Array:
        """Return the autocovariance (2, ...) [rad2] of the drift at a time difference [d]."""
        return np.multiply.outer(np.square(self.drift_rad), np.exp(-apart_days / self.drift_days))

    def jitter(self, apart_days: Array) -> Array:
        """Return the autocovariance (2, ...) [rad2] of the jitter at a time difference [d]."""
        return np.multiply.outer(np.square(self.jitter_rad), np.exp(-apart_days / self.jitter_days))


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of H heliostats with up to M measurements each, in order of time.

    Attributes
    ----------
    parameters : (H, P)
        Means.
    covariance : (H, P, P)
        Of the parameters at the newest measurement; drift and steps are included in their zeros.
    drift, jitter, steps : (H, M, 2) [rad]
        Means of what is added to the zeros at each measurement; ``steps`` is the sum of all steps
        up to then.
    drifted_std : (H, 2) [rad]
        Standard deviation of the drift from the first measurement to the newest.
    steps_std : (H, M, 2) [rad]
        Standard deviation of the step that begins at a measurement; 0 without a step.
    stepped, foreign : (H, M) of bool
        Measurements at which a step begins, and those that are excluded as foreign.
    evidence : (H,)
        Log probability of the data and the changes, up to a constant.
    spread : (H, P)
        Standard deviations of the parameters alone.
    """

    parameters: Array
    covariance: Array
    drift: Array
    jitter: Array
    steps: Array
    drifted_std: Array
    steps_std: Array
    stepped: Mask
    foreign: Mask
    evidence: Array
    spread: Array

    @property
    def zeros(self) -> Array:
        """Sum of drift, jitter and steps at each measurement (H, M, 2) [rad]."""
        return self.drift + self.jitter + self.steps


def unknown_steps(posterior: Posterior) -> Array:
    """Return the variance (H, 2) [rad2] of zeros at an unknown time: the squares of all steps."""
    begun = np.diff(posterior.steps, axis=1, prepend=0.0) * posterior.stepped[..., None]
    return np.asarray((begun**2).sum(axis=1))


def _time_differences(days: Array, others: Array) -> Array:
    """Time differences (H, M, K) [d] of days (H, M) to others (H, K); infinite if unknown."""
    apart = np.abs(days[:, :, None] - others[:, None])
    return np.where(np.isnan(apart), np.inf, apart)


def _lags(days: Array) -> Array:
    """Time differences (H, M, M) [d] among days (H, M); 0 of each to itself."""
    apart = _time_differences(days, days)
    same = np.arange(days.shape[1])
    apart[:, same, same] = 0.0
    return apart


def infer_changes(
    y: Array,
    jacobian: Array,
    readings: Readings,
    prior_mean: Array,
    prior_cov: Array,
    noise: Noise,
    undated_variance: Array | None = None,
) -> Posterior:
    """Infer parameters, drift, steps and foreign spots from linear residuals.

    Parameters
    ----------
    y : (H, M, 2) [rad]
        What parameters and zeros explain, counted from zero; 0 in padding.
    jacobian : (H, M, 2, P)
        Derivatives of the residuals by the parameters; 0 in padding.
    readings : Readings
    prior_mean, prior_cov : (P,), (P, P)
        The field's.
    noise : Noise
    undated_variance : (H, 2) [rad2]
        Of the zeros of measurements of an unknown time, in addition to drift and jitter; 0 by
        default.
    """
    model = LinearModel.of(y, jacobian, readings, prior_mean, prior_cov, noise, undated_variance)
    changes = _Changes.empty(*readings.used.shape)
    active = np.arange(len(y))
    while len(active):
        part, chosen = model.rows(active), changes.rows(active)
        has_grown = chosen.add_best(part)
        chosen.drop_unsupported(part)
        changes.assign(active, chosen)
        active = active[has_grown]
    return model.posterior(changes)


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The Gaussian model without steps and foreign spots; N = 2 M.

    ``y`` (H, N) less the prior's mean; ``by_parameter`` (H, N, P) is J; ``by_zero`` (H, M, 2, 2) is
    Z, its last axis the drive; ``precision`` (H, N, N) is A; ``log_det`` (H,) is that of the
    covariance; ``undated_variance`` (H, 2).
    """

    y: Array
    by_parameter: Array
    by_zero: Array
    precision: Array
    log_det: Array
    readings: Readings
    prior_mean: Array
    prior_cov: Array
    noise: Noise
    undated_variance: Array

    @classmethod
    def of(
        cls,
        y: Array,
        jacobian: Array,
        readings: Readings,
        mean: Array,
        cov: Array,
        noise: Noise,
        undated_variance: Array | None = None,
    ) -> "LinearModel":
        """The model of `infer_changes`, with its arguments."""
        heliostats, most, _, count = jacobian.shape
        by_parameter = jacobian.reshape(heliostats, 2 * most, count)
        by_zero = jacobian[..., ZEROS]
        covariance = by_parameter @ cov @ by_parameter.swapaxes(1, 2)
        variance = np.zeros((heliostats, 2)) if undated_variance is None else undated_variance
        moving = noise.drift(_lags(readings.days)) + _quick(readings.days, noise, variance)
        for drive in (0, 1):
            along = by_zero[..., drive]
            covariance += np.einsum(
                "hia,hij,hjb->hiajb", along, moving[drive], along, optimize=True
            ).reshape(covariance.shape)
        # A variance of one in padding adds nothing to the evidence.
        diagonal = np.arange(2 * most)
        covariance[:, diagonal, diagonal] += np.repeat(
            np.where(readings.used, noise.spot_rad**2, 1.0), 2, axis=1
        )
        target = y.reshape(heliostats, -1) - by_parameter @ mean
        log_det = np.linalg.slogdet(covariance)[1]
        precision = np.asarray(np.linalg.inv(covariance))
        return cls(
            target, by_parameter, by_zero, precision, log_det, readings, mean, cov, noise, variance
        )

    def rows(self, rows: NDArray[np.intp]) -> "LinearModel":
        """Select some heliostats."""
        if len(rows) == len(self.y):
            return self
        return replace(
            self,
            y=self.y[rows],
            by_parameter=self.by_parameter[rows],
            by_zero=self.by_zero[rows],
            precision=self.precision[rows],
            log_det=self.log_det[rows],
            undated_variance=self.undated_variance[rows],
            readings=Readings(**{name: value[rows] for name, value in vars(self.readings).items()}),
        )

    def posterior(self, changes: "_Changes") -> Posterior:
        """Return means and covariances of all unknowns, given the changes."""
        heliostats, most = self.readings.used.shape
        noise, days = self.noise, self.readings.days
        solution = changes.solve(self)
        explained = solution.precision_y
        by_zeros = np.einsum("hmka,hmk->hma", self.by_zero, explained.reshape(heliostats, most, 2))
        drift = np.einsum("khij,hjk->hik", noise.drift(_lags(days)), by_zeros)
        jitter = np.einsum("khij,hjk->hik", _quick(days, noise, self.undated_variance), by_zeros)
        steps, steps_std = _step_sizes(changes, solution)
        last = np.maximum(self.readings.used.sum(axis=1) - 1, 0)
        newest = days[np.arange(heliostats), last]
        precision = solution.precision(self)
        covariance = self._newest_covariance(changes, precision, newest)
        used = self.readings.used[..., None]
        return Posterior(
            parameters=self.prior_mean
            + (explained[:, None] @ self.by_parameter)[:, 0] @ self.prior_cov,
            covariance=covariance,
            drift=drift * used,
            jitter=jitter * used,
            steps=steps.cumsum(axis=1) * used,
            drifted_std=self._drifted_std(precision, newest),
            steps_std=steps_std,
            stepped=changes.mask(*_STEPS),
            foreign=changes.mask(*_FOREIGN),
            evidence=solution.evidence - 0.5 * self.log_det,
            spread=self._spread(precision),
        )

    def _drift_at(self, day: Array) -> Array:
        """Covariances (H, 2, N) of the drift at a ``day`` (H,) with the data."""
        heliostats, most = self.readings.used.shape
        shared = self.noise.drift(_time_differences(self.readings.days, day[:, None])[..., 0])
        return np.asarray(
            np.einsum("hmka,ahm->hamk", self.by_zero, shared).reshape(heliostats, 2, 2 * most)
        )

    def _drifted_std(self, precision: Array, newest: Array) -> Array:
        """Standard deviations (H, 2) [rad] of the drift from the first to the newest known time."""
        used, days = self.readings.used, self.readings.days
        place = np.minimum(_undated(self.readings), np.maximum(used.sum(axis=1) - 1, 0))
        first = days[np.arange(len(days)), place]
        cross = self._drift_at(newest) - self._drift_at(first)
        explained = np.diagonal(cross @ precision @ cross.swapaxes(1, 2), axis1=1, axis2=2)
        free = 2 * (self.noise.drift(np.zeros(1)) - self.noise.drift(newest - first)).T
        return np.where(np.isnan(newest)[:, None], 0.0, np.sqrt(np.maximum(free - explained, 0)))

    def _spread(self, precision: Array) -> Array:
        """Standard deviations (H, P) of the parameters alone."""
        cross = np.swapaxes(self.by_parameter @ self.prior_cov, 1, 2)
        covariance = self.prior_cov - cross @ precision @ cross.swapaxes(1, 2)
        return np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0))

    def _newest_covariance(self, changes: "_Changes", precision: Array, newest: Array) -> Array:
        """Covariances (H, P, P) of the parameters with their zeros at the days ``newest`` (H,)."""
        cross = np.swapaxes(self.by_parameter @ self.prior_cov, 1, 2)
        at_zero = self._drift_at(newest)
        stepped = changes.stepped_variance(self.noise)  # shared by each measurement with the newest
        at_zero += np.einsum("hmka,hma->hamk", self.by_zero, stepped).reshape(at_zero.shape)
        cross[:, ZEROS] += at_zero
        prior = np.tile(self.prior_cov, (len(newest), 1, 1))
        zeros = np.arange(ZEROS.start, ZEROS.stop)
        prior[:, zeros, zeros] += np.square(self.noise.drift_rad) + stepped[:, -1]
        return np.asarray(prior - cross @ precision @ cross.swapaxes(1, 2))


def _undated(readings: Readings) -> NDArray[np.intp]:
    """Count the measurements of an unknown time of each heliostat (H,): its first ones."""
    return np.asarray((readings.used & np.isnan(readings.days)).sum(axis=1))


def _quick(days: Array, noise: Noise, undated_variance: Array) -> Array:
    """Covariance (2, H, M, M) [rad2] of the jitter, and of steps before unknown times."""
    covariance = noise.jitter(_lags(days))
    same = np.arange(days.shape[1])
    covariance[:, :, same, same] += undated_variance.T[..., None] * np.isnan(days)
    return covariance


class ChangePointScore(NamedTuple):
    """Score and information (H, M) of a number that is 0 before a measurement, then constant.

    Its estimate is ``score / information``, with variance ``1 / information``.
    """

    score: Array
    information: Array


class LeftOutErrors(NamedTuple):
    """Residuals (H, M, 2) [rad] to predictions by other measurements, and their standard deviations
    (H, M) per direction; NaN for foreign measurements and padding.
    """

    residuals: Array
    std: Array


@dataclass(frozen=True, eq=False)
class ConditionedModel:
    """The linear model with inferred changes, for further questions to the data."""

    model: LinearModel
    changes: "_Changes"

    @classmethod
    def of(cls, model: LinearModel, posterior: Posterior) -> "ConditionedModel":
        """The model with the changes of a ``posterior``, which may be padded further."""
        most = model.readings.used.shape[1]
        stepped, foreign = posterior.stepped[:, :most], posterior.foreign[:, :most]
        return cls(model, _Changes.from_masks(stepped, foreign))

    def left_out_errors(self, whole_days: bool = False) -> "LeftOutErrors":
        """Predict each measurement by all others, or by those of all other days.

        Measurements of a day share the jitter of the drives, so they say little about another day.
        Those of an unknown time count as a day each. Source: Rasmussen and Williams 2006, eq. 5.12,
        for blocks of measurements.
        """
        readings = self.model.readings
        heliostats, most = readings.used.shape
        solution, day = self.changes.solve(self.model), np.floor(readings.days)
        same = np.eye(most, dtype=bool) | (whole_days & (day[:, :, None] == day[:, None]))
        blocks = solution.precision(self.model) * same.repeat(2, axis=1).repeat(2, axis=2)
        covariance = np.linalg.inv(blocks)
        residuals = (covariance @ solution.precision_y[..., None]).reshape(heliostats, most, 2)
        variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(heliostats, most, 2)
        is_known = readings.used & ~self.changes.mask(*_FOREIGN)
        std = np.sqrt(variance.mean(axis=-1))
        return LeftOutErrors(
            np.where(is_known[..., None], residuals, np.nan), np.where(is_known, std, np.nan)
        )

    def change_point_score(self, by_change: Array) -> ChangePointScore:
        """Score a change at each measurement by the residuals' derivatives ``by_change`` (H, M, 2).

        Steps at the measurement or next to it are left out of the model: they would explain the
        same change.
        """
        model, changes = self.model, self.changes
        columns = (by_change * model.readings.used[..., None])[..., None]
        score, information = _change_point_terms(model, changes, columns)
        is_step = np.isin(changes.kind, _STEPS)
        for term in range(changes.kind.shape[1]):
            place = changes.place[:, term, None]
            is_adjacent = is_step & (np.abs(changes.place - place) <= 1)
            without = replace(changes, kind=np.where(is_adjacent, 0, changes.kind).astype(np.int8))
            near = is_step[:, term, None] & (np.abs(np.arange(changes.most) - place) <= 1)
            rows = np.nonzero(near.any(axis=1))[0]
            other = _change_point_terms(model.rows(rows), without.rows(rows), columns[rows])
            for old, new in zip((score, information), other, strict=True):
                old[rows] = np.where(near[rows], new, old[rows])
        return ChangePointScore(score, information)


def _change_point_terms(
    model: LinearModel, changes: "_Changes", columns: Array
) -> ChangePointScore:
    heliostats, most = model.readings.used.shape
    solution = changes.solve(model)
    score = np.einsum("hmka,hmk->hm", columns, solution.precision_y.reshape(heliostats, most, 2))
    blocks = solution.precision(model).reshape(heliostats, most, 2, most, 2)
    information = _information_from_here(columns, blocks)[..., 0, 0]
    return ChangePointScore(_sum_from_here(score, 1), information)


# Kinds of changes; 0 is none. Steps of both drives, the first, the second: common ones, then large
# ones; foreign spots.
_STEPS, _FOREIGN = (1, 2, 3, 4, 5, 6), (7, 8)
_LARGE = 4  # of both drives

# A drive without a step moves by no more than this share of the one with a step.
_STILL = 1e-3


@dataclass(frozen=True, eq=False)
class _Solution:
    """The model solved for the sizes of T changes.

    ``weighted_design`` (H, N, 2 T) is A D; ``cov`` (H, 2 T, 2 T) and ``sizes`` (H, 2 T) are the
    posterior of the sizes; ``precision_y`` (H, N); ``evidence`` (H,).
    """

    weighted_design: Array
    cov: Array
    sizes: Array
    precision_y: Array
    evidence: Array

    def precision(self, model: LinearModel) -> Array:
        """Inverse covariance (H, N, N) of ``y`` given the changes."""
        if not self.cov.shape[-1]:
            return model.precision
        return model.precision - self.weighted_design @ self.cov @ self.weighted_design.swapaxes(
            1, 2
        )


@dataclass(eq=False)
class _Changes:
    """Up to T steps and foreign spots of each heliostat.

    ``kind`` (H, T); ``place`` (H, T) is the index of the measurement; ``most`` is M.
    """

    kind: NDArray[np.int8]
    place: NDArray[np.intp]
    most: int

    @classmethod
    def empty(cls, heliostats: int, most: int) -> "_Changes":
        return cls(np.zeros((heliostats, 0), np.int8), np.zeros((heliostats, 0), np.intp), most)

    @classmethod
    def from_masks(cls, stepped: Mask, foreign: Mask) -> "_Changes":
        """Make changes of the largest kinds from masks (H, M) of steps and foreign spots."""
        kinds = np.concatenate([stepped * _LARGE, foreign * _FOREIGN[-1]], axis=1).astype(np.int8)
        count = int((kinds > 0).sum(axis=1).max(initial=0))
        first = np.argsort(kinds == 0, axis=1, kind="stable")[:, :count]
        most = stepped.shape[1]
        return cls(np.take_along_axis(kinds, first, axis=1), first % most, most)

    def rows(self, rows: NDArray[np.intp]) -> "_Changes":
        return _Changes(self.kind[rows], self.place[rows], self.most)

    def assign(self, rows: NDArray[np.intp], other: "_Changes") -> None:
        """Replace the changes of some heliostats."""
        more = other.kind.shape[1] - self.kind.shape[1]
        if more > 0:
            self.kind = np.pad(self.kind, ((0, 0), (0, more)))
            self.place = np.pad(self.place, ((0, 0), (0, more)))
        self.kind[rows], self.place[rows] = 0, 0
        self.kind[rows, : other.kind.shape[1]] = other.kind
        self.place[rows, : other.kind.shape[1]] = other.place

    def mask(self, *kinds: int) -> Mask:
        """Mark the measurements (H, M) with a change of one of ``kinds``."""
        mask = np.zeros((len(self.kind), self.most), dtype=bool)
        rows, terms = np.nonzero(np.isin(self.kind, kinds))
        mask[rows, self.place[rows, terms]] = True
        return mask

    def stepped_variance(self, noise: Noise) -> Array:
        """Prior variances (H, M, 2) [rad2] of the sum of all steps up to each measurement."""
        variance = np.zeros((len(self.kind), self.most, 2))
        rows, terms = np.nonzero(np.isin(self.kind, _STEPS))
        variance[rows, self.place[rows, terms]] = _variances(noise)[self.kind[rows, terms]]
        return variance.cumsum(axis=1)

    def solve(self, model: LinearModel) -> _Solution:
        """Solve the linear model for the sizes of the changes."""
        heliostats, count = self.kind.shape
        after = np.arange(self.most) >= self.place[..., None]
        at = np.arange(self.most) == self.place[..., None]
        is_step, is_foreign = (np.isin(self.kind, kinds) for kinds in (_STEPS, _FOREIGN))
        from_here, here = (
            (places & kinds[..., None]).swapaxes(1, 2)[:, :, None, :, None]
            for places, kinds in ((after, is_step), (at, is_foreign))
        )
        design = from_here * model.by_zero[:, :, :, None] + here * np.eye(2)[:, None]
        design = design.reshape(heliostats, 2 * self.most, 2 * count)
        variance = _variances(model.noise)[self.kind].reshape(heliostats, 2 * count)
        weighted_design = model.precision @ design
        inverse = design.swapaxes(1, 2) @ weighted_design
        diagonal = np.arange(2 * count)
        inverse[:, diagonal, diagonal] += 1 / variance
        cov = np.linalg.inv(inverse)
        alpha = (model.precision @ model.y[..., None])[..., 0]
        score = (weighted_design.swapaxes(1, 2) @ model.y[..., None])[..., 0]
        sizes = (cov @ score[..., None])[..., 0]
        odds = np.log(_odds(model.noise))[self.kind].sum(axis=1)
        evidence = odds + 0.5 * (
            (score * sizes).sum(axis=1)
            - (alpha * model.y).sum(axis=1)
            - np.linalg.slogdet(inverse)[1]
            - np.log(variance).sum(axis=1)
        )
        precision_y = alpha - (weighted_design @ sizes[..., None])[..., 0]
        return _Solution(weighted_design, cov, sizes, precision_y, evidence)

    def add_best(self, model: LinearModel) -> Mask:
        """Add the change with the highest odds, if above one; mark the heliostats (H,) with one."""
        log_odds = self._log_odds(model, self.solve(model))
        best = log_odds.reshape(len(log_odds), -1).argmax(axis=1)
        kinds, places = np.divmod(best, self.most)
        is_likely = log_odds[np.arange(len(log_odds)), kinds, places] > 0
        self.kind = np.column_stack([self.kind, np.where(is_likely, kinds + 1, 0)]).astype(np.int8)
        self.place = np.column_stack([self.place, np.where(is_likely, places, 0)])
        return is_likely

    def _log_odds(self, model: LinearModel, solution: _Solution) -> Array:
        """Log odds (H, K, M) of a step before each measurement, or a foreign spot, by kind."""
        heliostats = len(self.kind)
        score = solution.precision_y.reshape(heliostats, self.most, 2)
        blocks = solution.precision(model).reshape(heliostats, self.most, 2, self.most, 2)
        foreign_information = np.einsum("hiaib->hiab", blocks)
        step_score = _sum_from_here(np.einsum("hmka,hmk->hma", model.by_zero, score), 1)
        step_information = _information_from_here(model.by_zero, blocks)
        noise, used = model.noise, model.readings.used
        variances = _variances(noise)
        of_steps = [
            _log_bayes_factor(step_score, step_information, variances[kind]) for kind in _STEPS
        ]
        of_foreign = [
            _log_bayes_factor(score, foreign_information, variances[kind]) for kind in _FOREIGN
        ]
        log_odds = np.stack([*of_steps, *of_foreign], axis=1)
        log_odds += np.log(_odds(noise))[1:, None]
        steps = slice(0, len(_STEPS))
        # A step before the first measurement is the zero itself, and none is known before an
        # unknown time.
        is_first = np.arange(self.most) <= _undated(model.readings)[:, None]
        log_odds[:, steps] = np.where(is_first[:, None], -np.inf, log_odds[:, steps])
        log_odds[:, steps] = np.where(self.mask(*_STEPS)[:, None], -np.inf, log_odds[:, steps])
        foreign = slice(len(_STEPS), None)
        log_odds[:, foreign] = np.where(
            self.mask(*_FOREIGN)[:, None], -np.inf, log_odds[:, foreign]
        )
        return np.where(used[:, None], log_odds, -np.inf)

    def drop_unsupported(self, model: LinearModel) -> None:
        """Drop changes with odds below one, the least likely of each heliostat first."""
        while self.kind.any():
            solution = self.solve(model)
            heliostats, count = self.kind.shape
            cov = np.einsum("htatb->htab", solution.cov.reshape(heliostats, count, 2, count, 2))
            size = solution.sizes.reshape(heliostats, count, 2)
            chi_square = (size * np.linalg.solve(cov, size[..., None])[..., 0]).sum(axis=-1)
            variance = _variances(model.noise)[self.kind]
            log_odds = 0.5 * (
                chi_square + np.linalg.slogdet(cov)[1] - np.log(variance).sum(axis=-1)
            )
            log_odds += np.log(_odds(model.noise))[self.kind]
            log_odds[self.kind == 0] = np.inf
            worst = log_odds.argmin(axis=1)
            rows = np.nonzero(log_odds[np.arange(heliostats), worst] < 0)[0]
            if not len(rows):
                return
            self.kind[rows, worst[rows]] = 0


class _StepSizes(NamedTuple):
    """Each step (H, M, 2) [rad] at the measurement where it begins, and its deviation [rad]."""

    sizes: Array
    std: Array


def _step_sizes(changes: _Changes, solution: _Solution) -> _StepSizes:
    heliostats, count = changes.kind.shape
    size, std = np.zeros((2, heliostats, changes.most, 2))
    rows, terms = np.nonzero(np.isin(changes.kind, _STEPS))
    places = changes.place[rows, terms]
    size[rows, places] = solution.sizes.reshape(heliostats, count, 2)[rows, terms]
    variance = np.diagonal(solution.cov, axis1=1, axis2=2).reshape(heliostats, count, 2)
    std[rows, places] = np.sqrt(variance[rows, terms])
    return _StepSizes(size, std)


def _information_from_here(columns: Array, blocks: Array) -> Array:
    """Information (H, M, A, A) on a change from each measurement on.

    It is the sum over all pairs of later measurements. ``columns`` (H, M, 2, A) are the
    derivatives, ``blocks`` (H, M, 2, M, 2) the precision. From one
    measurement to the next the sum gains the measurement's pair with itself and, twice, its pairs
    with all later ones.
    """
    heliostats, most, _, count = columns.shape
    half = columns.swapaxes(2, 3) @ blocks.reshape(heliostats, most, 2, 2 * most)
    with_itself = np.einsum("hiail->hial", half.reshape(heliostats, most, count, most, 2)) @ columns
    half *= (np.arange(2 * most) // 2 > np.arange(most)[:, None])[:, None]
    later = half.reshape(heliostats, count * most, 2 * most) @ columns.reshape(
        heliostats, 2 * most, count
    )
    later = later.reshape(heliostats, most, count, count)
    return _sum_from_here(with_itself + later + later.swapaxes(2, 3), 1)


def _odds(noise: Noise) -> Array:
    """Prior odds of each kind of change (K,); 1 for none."""
    step, foreign = noise.step_odds / len(_STEPS), noise.foreign_odds / len(_FOREIGN)
    return np.array([1.0] + [step] * len(_STEPS) + [foreign] * len(_FOREIGN))


def _variances(noise: Noise) -> Array:
    """Prior variances of the two sizes of each kind of change (K, 2) [rad2]."""
    of_steps = [
        [size * first, size * second]
        for size in noise.step_rad
        for first, second in ((1.0, 1.0), (1.0, _STILL), (_STILL, 1.0))
    ]
    return np.square([[1.0, 1.0], *of_steps, *([size, size] for size in noise.foreign_rad)])


def _log_bayes_factor(score: Array, information: Array, variance: Array) -> Array:
    """Log Bayes factor (...) of a change, by score (..., 2) and information (..., 2, 2)."""
    precision = information + np.diag(1 / variance)
    size = np.linalg.solve(precision, score[..., None])[..., 0]
    return np.asarray(
        0.5
        * ((score * size).sum(axis=-1) - np.linalg.slogdet(precision)[1] - np.log(variance).sum())
    )


def _sum_from_here(values: Array, axis: int) -> Array:
    """Sum from each place to the end."""
    return np.flip(np.flip(values, axis).cumsum(axis), axis)
