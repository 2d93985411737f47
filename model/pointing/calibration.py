"""Calibrate the mounts of a field from motor positions, suns and spots.

Notes
-----
The parameters ``x_h`` of heliostat h have the field's prior N(mean, cov), which is estimated from
all heliostats (empirical Bayes by expectation maximisation). Five measurements of a mount are
enough with it. The stages:

1. `fit_robust`: maximum a posteriori with Student's t noise, by reweighted Gauss-Newton steps.
   Foreign spots have little weight.
2. `calibrate`: Gauss-Newton rounds. Each linearises the residuals (`linearise`) and infers
   parameters, drift, steps and foreign spots (`model.pointing.drives.infer_changes`); the first
   rounds also update the prior.
3. `calibrate_kinds`: both for each kind of drive separately.

Source of the prior: Dempster, Laird and Rubin 1977, doi:10.1111/j.2517-6161.1977.tb01600.x
(expectation maximisation).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.pointing.drives import (
    ConditionedModel,
    LinearModel,
    Noise,
    Posterior,
    infer_changes,
    unknown_steps,
)
from model.pointing.kinematics import (
    ANOTHER_KIND_M,
    PARAMETERS,
    SPREAD,
    ZEROS,
    KinematicChain,
    Readings,
    Residuals,
    residuals,
)

Array = NDArray[np.float64]

# Gauss-Newton rounds: of the robust fit, of the posterior, and the first of the latter that update
# the prior.
_ROBUST_ROUNDS = 15
_ROUNDS = 5
_FIELD_ROUNDS = 3

# Degrees of freedom of Student's t in the robust start.
_TAILS = 3.0

# The default spreads weigh as much as this number of heliostats.
_PRIOR_WEIGHT = 4.0

# Largest number of elements of one batch's covariances: limits memory, and fits a processor's
# caches.
_BATCH = 4_000_000

# Smallest number of heliostats for a separate prior; a smaller kind takes that of the largest kind.
_MIN_OF_KIND = 5


@dataclass(frozen=True, eq=False)
class FieldPrior:
    """The prior of heliostats with drives of one kind.

    Attributes
    ----------
    mean, covariance : (P,), (P, P)
        Of their parameters.
    stroke, zero : (2,) [m, rad]
        Median of their drives at the reference.
    """

    mean: Array
    covariance: Array
    stroke: Array
    zero: Array

    @classmethod
    def default(cls, chain: KinematicChain) -> "FieldPrior":
        """Make the prior without measurements."""
        count = len(PARAMETERS)
        return cls(
            np.zeros(count),
            np.diag(SPREAD**2),
            np.median(chain.stroke, axis=0),
            np.median(chain.zero, axis=0),
        )

    def for_kind(self, chain: KinematicChain) -> "FieldPrior":
        """Return the prior for another kind of drives, with their references."""
        default = FieldPrior.default(chain)
        return replace(self, stroke=default.stroke, zero=default.zero)

    def updated(self, posterior: Posterior) -> "FieldPrior":
        """Re-estimate mean and covariance from the posteriors of all heliostats."""
        count = len(posterior.parameters) + _PRIOR_WEIGHT
        mean = posterior.parameters.sum(axis=0) / count
        squares = ((posterior.parameters - mean) ** 2 + posterior.spread**2).sum(axis=0)
        return replace(
            self, mean=mean, covariance=np.diag((squares + _PRIOR_WEIGHT * SPREAD**2) / count)
        )

    def is_unusual(self, chain: KinematicChain) -> NDArray[np.bool_]:
        """Mark heliostats (H,) whose spindle lengths at the reference differ from the field's."""
        return np.asarray((np.abs(chain.stroke - self.stroke) > ANOTHER_KIND_M).any(axis=1))

    def starting_chain(self, chain: KinematicChain) -> KinematicChain:
        """Replace unusual drives by the field's.

        Some property files have a default stroke and the zero that belongs to it, a radian from all
        others.
        """
        unusual = self.is_unusual(chain)[:, None]
        return replace(
            chain,
            stroke=np.where(unusual, self.stroke, chain.stroke),
            zero=np.where(unusual, self.zero, chain.zero),
        )


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration of H heliostats with one kind of drives, and its ``residuals`` (H, M, 2)."""

    chain: KinematicChain
    prior: FieldPrior
    noise: Noise
    posterior: Posterior
    residuals: Array


Kind = tuple[NDArray[np.intp], Calibration]
"""Rows of a field's heliostats with one kind of drives, and their calibration."""


def calibrate(
    chain: KinematicChain,
    readings: Readings,
    noise: Noise | None = None,
    prior: FieldPrior | None = None,
) -> Calibration:
    """Calibrate all mounts of one kind, by a ``prior`` or by the one that they make together.

    The readings of a heliostat are in order of time. A heliostat without readings gets the prior's
    mean.
    """
    noise, current = noise or Noise(), prior or FieldPrior.default(chain)
    chain = current.starting_chain(chain)
    parameters = fit_robust(chain, readings, current, noise)
    zeros = np.zeros(readings.steps.shape)
    undated_variance = np.zeros((len(readings.used), 2))
    for iteration in range(_ROUNDS):
        posterior = _posterior(chain, readings, current, noise, parameters, zeros, undated_variance)
        parameters, zeros = posterior.parameters, posterior.zeros
        undated_variance = unknown_steps(posterior)
        if prior is None and iteration < _FIELD_ROUNDS:
            current = current.updated(posterior)
    left = residuals(chain, readings, posterior.parameters, posterior.zeros).values
    return Calibration(chain, current, noise, posterior, left)


def calibrate_kinds(
    chain: KinematicChain, readings: Readings, noise: Noise | None = None
) -> list[Kind]:
    """Calibrate each kind of drives by its prior, the largest kind first.

    A kind with few measured heliostats takes the spreads of the largest kind.
    """
    done: list[Kind] = []
    for rows in chain.kinds():
        of_kind, selected = chain.rows(rows), readings.of(rows)
        is_small = bool(done) and selected.used.any(axis=1).sum() < _MIN_OF_KIND
        prior = done[0][1].prior.for_kind(of_kind) if is_small else None
        done.append((rows, calibrate(of_kind, selected, noise, prior)))
    return done


def fit_robust(chain: KinematicChain, readings: Readings, prior: FieldPrior, noise: Noise) -> Array:
    """Fit parameters (H, P) with Student's t noise by iteratively reweighted least squares."""
    parameters = np.tile(prior.mean, (len(chain.pivot), 1))
    zeros = np.zeros(readings.steps.shape)
    precision = np.linalg.inv(prior.covariance)
    least = np.hypot(noise.spot_rad, max(noise.drift_rad))
    scale = np.full(len(parameters), 0.05)
    for _ in range(_ROBUST_ROUNDS):
        residual, slope = residuals(chain, readings, parameters, zeros)
        square = (residual**2).sum(axis=-1)
        counted = readings.used | ~readings.used.any(axis=1, keepdims=True)
        median = np.sqrt(np.nanmedian(np.where(counted, square, np.nan), axis=1))
        scale = np.clip(median, least, scale)
        weight = (_TAILS + 2) / (_TAILS * scale[:, None] ** 2 + square)
        shape = len(residual), -1, slope.shape[-1]
        rows = (slope * weight[..., None, None]).reshape(shape).swapaxes(1, 2)
        flat = slope.reshape(shape)
        curvature = rows @ flat + precision
        gradient = (rows @ residual.reshape(len(residual), -1, 1))[..., 0] + (
            parameters - prior.mean
        ) @ precision
        parameters = parameters - np.linalg.solve(curvature, gradient[..., None])[..., 0]
    return parameters


def _posterior(
    chain: KinematicChain,
    readings: Readings,
    prior: FieldPrior,
    noise: Noise,
    parameters: Array,
    zeros: Array,
    undated_variance: Array,
) -> Posterior:
    parts = []
    for rows in batches(readings):
        selected = readings.of(rows)
        y, slope = linearise(chain.rows(rows), selected, parameters[rows], zeros[rows])
        about = (prior.mean, prior.covariance, noise, undated_variance[rows])
        parts.append((rows, infer_changes(y, slope, selected, *about)))
    return _joined(parts, *readings.used.shape)


@dataclass(frozen=True, eq=False)
class Batch:
    """Some ``rows`` of a calibrated field, with the linear model about their posterior."""

    rows: NDArray[np.intp]
    chain: KinematicChain
    readings: Readings
    parameters: Array
    zeros: Array
    model: ConditionedModel


def calibrated_batches(kinds: Sequence[Kind], readings: Readings) -> Iterator[Batch]:
    """Iterate over all heliostats of a calibrated field in batches."""
    for rows, done in kinds:
        of_kind = readings.of(rows)
        for batch in batches(of_kind):
            chain, selected = done.chain.rows(batch), of_kind.of(batch)
            posterior = Posterior(
                **{name: value[batch] for name, value in vars(done.posterior).items()}
            )
            parameters, zeros = posterior.parameters, posterior.zeros[:, : selected.used.shape[1]]
            y, slope = linearise(chain, selected, parameters, zeros)
            mean, cov, steps = done.prior.mean, done.prior.covariance, unknown_steps(posterior)
            linear = LinearModel.of(y, slope, selected, mean, cov, done.noise, steps)
            model = ConditionedModel.of(linear, posterior)
            yield Batch(rows[batch], chain, selected, parameters, zeros, model)


def linearise(
    chain: KinematicChain, readings: Readings, parameters: Array, zeros: Array
) -> Residuals:
    """Return the residuals to zero parameters and zeros (H, M, 2) [rad], to first order."""
    zeros = zeros[:, : readings.used.shape[1]]
    residual, slope = residuals(chain, readings, parameters, zeros)
    slope = slope * readings.used[..., None, None]
    explained = (slope @ parameters[:, None, :, None])[..., 0]
    explained = explained + (slope[..., ZEROS] @ zeros[..., None])[..., 0]
    return Residuals(explained - residual, slope)


def batches(readings: Readings) -> Iterator[NDArray[np.intp]]:
    """Iterate over rows (n,) of heliostats with similar numbers of measurements."""
    counts = readings.used.sum(axis=1)
    order = np.argsort(counts, kind="stable")[::-1]
    while len(order):
        size = max(1, _BATCH // (2 * max(1, int(counts[order[0]]))) ** 2)
        yield order[:size]
        order = order[size:]


def _joined(
    parts: list[tuple[NDArray[np.intp], Posterior]], heliostats: int, most: int
) -> Posterior:
    """Join the posteriors of batches in the order of the heliostats, with equal padding."""
    whole = {}
    for name, first in vars(parts[0][1]).items():
        per_measurement = name in ("drift", "jitter", "steps", "steps_std", "stepped", "foreign")
        shape = (most, *first.shape[2:]) if per_measurement else first.shape[1:]
        whole[name] = np.zeros((heliostats, *shape), first.dtype)
        for rows, part in parts:
            value = getattr(part, name)
            if per_measurement:
                whole[name][rows, : value.shape[1]] = value
            else:
                whole[name][rows] = value
    return Posterior(**whole)
