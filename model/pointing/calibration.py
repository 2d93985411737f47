"""Mounts of a field calibrated from motors, sun and spots.

Each heliostat's parameters have a prior that is the field's: its mean and spreads come from all heliostats (empirical
Bayes), so that a mount with five measurements has those of its kind to lean on. Gauss and Newton's method goes from
PAINT's kinematics to the posterior, first by a robust fit that no foreign spot can pull away (Student's t), then with
drift, steps and foreign spots as `model.pointing.drives` believes in them.

Source of the prior: Dempster, Laird and Rubin 1977, doi:10.1111/j.2517-6161.1977.tb01600.x (expectation maximisation).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.pointing.drives import Believed, Noise, believe
from model.pointing.kinematics import PARAMETERS, SPREAD, ZEROS, Chain, Readings, residuals

Array = NDArray[np.float64]

# Rounds of Gauss and Newton: of the robust start, and of the posterior between two looks at the field.
_ROBUST_ROUNDS = 15
_ROUNDS = 2
_FIELD_ROUNDS = 3

# Degrees of freedom of Student's t in the robust start.
_TAILS = 3.0

# The prior that spreads have before the field is seen weighs as much as so many heliostats.
_PRIOR_WEIGHT = 4.0

# Most numbers in a covariance of one batch: what a processor's caches bear, and memory on a small machine.
_BATCH = 4_000_000

# Strokes of drives of one kind differ by millimetres; a file with another kind's [m] is started by the field's median.
_ANOTHER_KIND_M = 0.02


@dataclass(frozen=True, eq=False)
class Field:
    """What heliostats of one kind share: means (P,) and covariance (P, P) of their parameters."""

    mean: Array
    covariance: Array

    @classmethod
    def unseen(cls) -> "Field":
        """Before any heliostat was seen."""
        return cls(np.zeros(len(PARAMETERS)), np.diag(SPREAD**2))

    @classmethod
    def of(cls, believed: Believed) -> "Field":
        """By what is believed of its heliostats, each as far as its data tell."""
        count, unseen = len(believed.parameters), cls.unseen()
        mean = believed.parameters.sum(axis=0) / (count + _PRIOR_WEIGHT)
        off = ((believed.parameters - mean) ** 2 + believed.spread**2).sum(axis=0)
        spread = (off + _PRIOR_WEIGHT * np.diag(unseen.covariance)) / (count + _PRIOR_WEIGHT)
        return cls(mean, np.diag(spread))


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Posteriors of H heliostats with the field's prior, ``residuals`` (H, M, 2) [rad], and the chain they start from."""

    chain: Chain
    field: Field
    noise: Noise
    believed: Believed
    residuals: Array


def start_chain(chain: Chain) -> Chain:
    """A chain to start from: drives of another kind than the field's are replaced by the field's median.

    Some property files hold a default stroke, with a zero that goes with it, a radian from the others.
    """
    odd = of_another_kind(chain)
    median = {name: np.median(getattr(chain, name)[~odd], axis=0) for name in ("stroke", "zero")}
    return replace(chain, **{name: np.where(odd[:, None], value, getattr(chain, name)) for name, value in median.items()})


def of_another_kind(chain: Chain) -> NDArray[np.bool_]:
    """Heliostats (H,) whose spindles are not as long at their references as those of most of the field."""
    odd = np.abs(chain.stroke - np.median(chain.stroke, axis=0)) > _ANOTHER_KIND_M
    return np.asarray(odd.any(axis=1)) if 2 * odd.any(axis=1).sum() < len(odd) else np.zeros(len(odd), dtype=bool)


def calibrate(chain: Chain, readings: Readings, noise: Noise | None = None, field: Field | None = None) -> Calibrated:
    """Calibrate all mounts of a field; with ``field`` by that prior, else by the field's own.

    The readings of a heliostat are in order of time. Heliostats without any get what the prior has.
    """
    noise, chain = noise or Noise(), start_chain(chain)
    prior = field or Field.unseen()
    parameters = robust(chain, readings, prior, noise)
    zeros = np.zeros(readings.steps.shape)
    for _ in range(_FIELD_ROUNDS if field is None else 1):
        believed = _posterior(chain, readings, prior, noise, parameters, zeros)
        parameters, zeros = believed.parameters, believed.zeros
        prior = field or Field.of(believed)
    believed = _posterior(chain, readings, prior, noise, parameters, zeros)
    left = residuals(chain, readings, believed.parameters, believed.zeros)[0]
    return Calibrated(chain, prior, noise, believed, left)


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
        median = np.sqrt(np.nanmedian(np.where(readings.used, square, np.nan), axis=1)) if off.size else scale
        scale = np.clip(np.nan_to_num(median, nan=least), least, scale)
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
    for _ in range(_ROUNDS):
        parts = [
            (rows, _linearised(chain.rows(rows), readings.of(rows), prior, noise, parameters[rows], zeros[rows]))
            for rows in batches(readings)
        ]
        believed = _joined(parts, *readings.used.shape)
        parameters, zeros = believed.parameters, believed.zeros
    return believed


def _linearised(
    chain: Chain, readings: Readings, prior: Field, noise: Noise, parameters: Array, zeros: Array
) -> Believed:
    zeros = zeros[:, : readings.used.shape[1]]
    off, slope = residuals(chain, readings, parameters, zeros)
    slope = slope * readings.used[..., None, None]
    explained = (slope @ parameters[:, None, :, None])[..., 0] + (slope[..., ZEROS] @ zeros[..., None])[..., 0]
    return believe(explained - off, slope, readings, prior.mean, prior.covariance, noise)


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
