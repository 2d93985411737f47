"""Mounts of a field calibrated from motors, sun and spots.

Each heliostat's parameters have a prior that is the field's: its mean and spreads come from all heliostats (empirical
Bayes), so that a mount with five measurements has those of its kind to lean on. Gauss and Newton's method goes from
PAINT's kinematics to the posterior, first by a robust fit that no foreign spot can pull away (Student's t), then with
drift, steps and foreign spots as `model.pointing.drives` believes in them.

Source of the prior: Dempster, Laird and Rubin 1977, doi:10.1111/j.2517-6161.1977.tb01600.x (expectation maximisation).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.pointing.drives import Believed, Noise, Posterior, believe
from model.pointing.kinematics import ANOTHER_KIND_M, PARAMETERS, SPREAD, ZEROS, Chain, Readings, residuals

Array = NDArray[np.float64]

# Rounds of Gauss and Newton: of the robust start, of the posterior, and the first of these, which each look at the
# field anew.
_ROBUST_ROUNDS = 15
_ROUNDS = 5
_FIELD_ROUNDS = 3

# Degrees of freedom of Student's t in the robust start.
_TAILS = 3.0

# The prior that spreads have before the field is seen weighs as much as so many heliostats.
_PRIOR_WEIGHT = 4.0

# Most numbers in a covariance of one batch: what a processor's caches bear, and memory on a small machine.
_BATCH = 4_000_000

# Heliostats that make a prior of their own kind; fewer take that of the largest kind.
_LEAST_OF_KIND = 5


@dataclass(frozen=True, eq=False)
class Field:
    """What heliostats with drives of one kind share.

    Attributes
    ----------
    mean, covariance : (P,), (P, P)
        Of their parameters.
    stroke, zero : (2,) [m, rad]
        Of their drives at the reference, as most property files have them.
    """

    mean: Array
    covariance: Array
    stroke: Array
    zero: Array

    @classmethod
    def unseen(cls, chain: Chain) -> "Field":
        """Before any of its spots was seen."""
        count = len(PARAMETERS)
        return cls(np.zeros(count), np.diag(SPREAD**2), np.median(chain.stroke, axis=0), np.median(chain.zero, axis=0))

    def of_kind(self, chain: Chain) -> "Field":
        """The same for heliostats of another kind, whose drives have references of their own."""
        own = Field.unseen(chain)
        return replace(self, stroke=own.stroke, zero=own.zero)

    def seen(self, believed: Believed) -> "Field":
        """By what is believed of its heliostats, each as far as its data tell; `SPREAD` weighs as a few of them."""
        count = len(believed.parameters) + _PRIOR_WEIGHT
        mean = believed.parameters.sum(axis=0) / count
        off = ((believed.parameters - mean) ** 2 + believed.spread**2).sum(axis=0)
        return replace(self, mean=mean, covariance=np.diag((off + _PRIOR_WEIGHT * SPREAD**2) / count))

    def is_odd(self, chain: Chain) -> NDArray[np.bool_]:
        """Heliostats (H,) whose spindles are not nearly as long at their references as those of the field."""
        return np.asarray((np.abs(chain.stroke - self.stroke) > ANOTHER_KIND_M).any(axis=1))

    def start(self, chain: Chain) -> Chain:
        """The chain to start from: odd drives are replaced by the field's.

        Some property files hold a default stroke, with a zero that goes with it, a radian from the others.
        """
        odd = self.is_odd(chain)[:, None]
        return replace(
            chain,
            stroke=np.where(odd, self.stroke, chain.stroke),
            zero=np.where(odd, self.zero, chain.zero),
        )


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Posteriors of H heliostats, the prior and the chain that they start from, ``residuals`` (H, M, 2) [rad]."""

    chain: Chain
    field: Field
    noise: Noise
    believed: Believed
    residuals: Array


Kind = tuple[NDArray[np.intp], Calibrated]
"""Rows of a field's heliostats, and their calibration."""


def calibrate(chain: Chain, readings: Readings, noise: Noise | None = None, field: Field | None = None) -> Calibrated:
    """Calibrate all mounts of one kind; with ``field`` by that prior, else by their own.

    The readings of a heliostat are in order of time. Heliostats without any get what the prior has.
    """
    noise, prior = noise or Noise(), field or Field.unseen(chain)
    chain = prior.start(chain)
    parameters = robust(chain, readings, prior, noise)
    zeros = np.zeros(readings.steps.shape)
    for turn in range(_ROUNDS):
        believed = _posterior(chain, readings, prior, noise, parameters, zeros)
        parameters, zeros = believed.parameters, believed.zeros
        if field is None and turn < _FIELD_ROUNDS:
            prior = prior.seen(believed)
    left = residuals(chain, readings, believed.parameters, believed.zeros)[0]
    return Calibrated(chain, prior, noise, believed, left)


def calibrate_kinds(chain: Chain, readings: Readings, noise: Noise | None = None) -> list[Kind]:
    """Mounts of a field by the priors that its kinds of drives make: each kind's with its rows, the largest first.

    A kind of few heliostats with readings takes the spreads of the largest kind.
    """
    done: list[Kind] = []
    for rows in chain.kinds():
        of_kind, own = chain.rows(rows), readings.of(rows)
        few = bool(done) and own.used.any(axis=1).sum() < _LEAST_OF_KIND
        done.append((rows, calibrate(of_kind, own, noise, done[0][1].field.of_kind(of_kind) if few else None)))
    return done


def robust(chain: Chain, readings: Readings, prior: Field, noise: Noise) -> Array:
    """Parameters (H, P) that most measurements agree on: Student's t by reweighted least squares."""
    parameters = np.tile(prior.mean, (len(chain.pivot), 1))
    zeros = np.zeros(readings.steps.shape)
    precision = np.linalg.inv(prior.covariance)
    least = np.hypot(noise.spot_rad, max(noise.drift_rad))
    scale = np.full(len(parameters), 0.05)
    for _ in range(_ROBUST_ROUNDS):
        off, slope = residuals(chain, readings, parameters, zeros)
        square = (off**2).sum(axis=-1)
        counted = readings.used | ~readings.used.any(axis=1, keepdims=True)
        median = np.sqrt(np.nanmedian(np.where(counted, square, np.nan), axis=1))
        scale = np.clip(median, least, scale)
        weight = (_TAILS + 2) / (_TAILS * scale[:, None] ** 2 + square)
        rows = (slope * weight[..., None, None]).reshape(len(off), -1, slope.shape[-1]).swapaxes(1, 2)
        flat = slope.reshape(len(off), -1, slope.shape[-1])
        curvature = rows @ flat + precision
        gradient = (rows @ off.reshape(len(off), -1, 1))[..., 0] + (parameters - prior.mean) @ precision
        parameters = parameters - np.linalg.solve(curvature, gradient[..., None])[..., 0]
    return parameters


def _posterior(
    chain: Chain, readings: Readings, prior: Field, noise: Noise, parameters: Array, zeros: Array
) -> Believed:
    parts = [
        (rows, _linearised(chain.rows(rows), readings.of(rows), prior, noise, parameters[rows], zeros[rows]))
        for rows in batches(readings)
    ]
    return _joined(parts, *readings.used.shape)


def _linearised(
    chain: Chain, readings: Readings, prior: Field, noise: Noise, parameters: Array, zeros: Array
) -> Believed:
    y, slope = linearised(chain, readings, parameters, zeros)
    return believe(y, slope, readings, prior.mean, prior.covariance, noise)


@dataclass(frozen=True, eq=False)
class Part:
    """Some ``rows`` of a calibrated field: what their residuals come of, and the posterior about what is believed."""

    rows: NDArray[np.intp]
    chain: Chain
    readings: Readings
    parameters: Array
    zeros: Array
    posterior: Posterior


def parts(kinds: Sequence[Kind], readings: Readings) -> Iterator[Part]:
    """All heliostats of a calibrated field, in batches."""
    for rows, done in kinds:
        of_kind = readings.of(rows)
        for batch in batches(of_kind):
            chain, own = done.chain.rows(batch), of_kind.of(batch)
            believed = Believed(**{name: value[batch] for name, value in vars(done.believed).items()})
            parameters, zeros = believed.parameters, believed.zeros[:, : own.used.shape[1]]
            y, slope = linearised(chain, own, parameters, zeros)
            prior = done.field
            posterior = Posterior.of(y, slope, own, prior.mean, prior.covariance, done.noise, believed)
            yield Part(rows[batch], chain, own, parameters, zeros, posterior)


def linearised(chain: Chain, readings: Readings, parameters: Array, zeros: Array) -> tuple[Array, Array]:
    """What parameters and zeros shall explain (H, M, 2) [rad], counted from zero, and its slopes (H, M, 2, P)."""
    zeros = zeros[:, : readings.used.shape[1]]
    off, slope = residuals(chain, readings, parameters, zeros)
    slope = slope * readings.used[..., None, None]
    explained = (slope @ parameters[:, None, :, None])[..., 0] + (slope[..., ZEROS] @ zeros[..., None])[..., 0]
    return explained - off, slope


def batches(readings: Readings) -> Iterator[NDArray[np.intp]]:
    """Heliostats (n,) of about as many measurements each, as many as one batch bears."""
    counts = readings.used.sum(axis=1)
    order = np.argsort(counts, kind="stable")[::-1]
    while len(order):
        size = max(1, _BATCH // (2 * max(1, int(counts[order[0]]))) ** 2)
        yield order[:size]
        order = order[size:]


def _joined(parts: list[tuple[NDArray[np.intp], Believed]], heliostats: int, most: int) -> Believed:
    """Beliefs of batches in the heliostats' order, padded alike."""
    whole = {}
    for name, first in vars(parts[0][1]).items():
        per_measurement = name in ("drift", "jitter", "steps", "steps_std", "stepped", "foreign")
        shape = (heliostats, most, *first.shape[2:]) if per_measurement else (heliostats, *first.shape[1:])
        whole[name] = np.zeros(shape, first.dtype)
        for rows, part in parts:
            value = getattr(part, name)
            if per_measurement:
                whole[name][rows, : value.shape[1]] = value
            else:
                whole[name][rows] = value
    return Believed(**whole)
