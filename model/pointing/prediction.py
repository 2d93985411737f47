"""Predict the pointing error of calibrated mounts, with an interval that unseen spots are in.

A fit's residuals are far smaller than the errors of its predictions. So each measurement is
predicted by all others, and by those of all other days (`ConditionedModel.left_out_errors`). A next
photograph may be like either.

Notes
-----
With the error e_i of measurement i, and s_i its standard deviation by the model, the ratios e_i /
s_i of all heliostats have one distribution. It has heavier tails than the model's. The error of a
heliostat has the distribution of products of the heliostat's s_i with all ratios. The interval is
from the 5 % quantile of predictions by all others to the 95 % quantile of those by other days. The
latter is 1 + 2 / n times larger for n measurements, because the field's prior and the changes over
time are of all measurements. Forward in time it is `_DRIFT` times larger at least: days on both
sides of a left-out day know its drift. `benchmarks.pointing --only forward` prints the share of
later spots that it holds. A heliostat that moves after its calibration is in no such interval. Its
move is reported (`service.twin.pointing_errors`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.pointing.calibration import Kind, calibrated_batches
from model.pointing.kinematics import Readings
from model.pointing.mounts import CalibratedMount, PredictedError

Array = NDArray[np.float64]

MIN_MEASUREMENTS = 3
"""Smallest number of predicted measurements for a pointing error."""

MAX_OUTLIERS = 0.25
"""Largest share of outliers for which the other measurements predict the next one."""

# A prediction with a larger standard deviation [rad] is none: its day is the only one since a step,
# or of the heliostat.
_UNKNOWN = 5e-3

_LEVELS = (np.arange(100) + 0.5) / 100
# Least factor of the upper end: from measurements that follow windows of 6 to 48 real ones.
_DRIFT = 1.4
# Rayleigh's distribution, the model's own: it counts as this number of measurements.
_N_EXPECTED = 20


class _Errors(NamedTuple):
    """Errors (H, M) [rad] of a field's measurements, and quantiles (H, M, K) of such errors.

    Both are NaN if a measurement is not predicted.
    """

    errors: Array
    quantiles: Array


def with_predictions(
    mounts: Sequence[CalibratedMount], kinds: Sequence[Kind], readings: Readings
) -> list[CalibratedMount]:
    """Return the mounts of a field that was calibrated by ``readings``, with their predictions."""
    by_others, by_days = (
        _left_out_errors(kinds, readings, whole_days) for whole_days in (False, True)
    )
    return [
        replace(
            mount,
            predicted=by_days.errors[row, : len(mount.days)],
            prediction=_predict(mount, by_others.quantiles[row], by_days.quantiles[row]),
        )
        for row, mount in enumerate(mounts)
    ]


def _left_out_errors(kinds: Sequence[Kind], readings: Readings, whole_days: bool) -> _Errors:
    errors, std = (np.full(readings.used.shape, np.nan) for _ in range(2))
    for batch in calibrated_batches(kinds, readings):
        found = batch.model.left_out_errors(whole_days)
        is_predicted = found.std < _UNKNOWN
        size, width = np.linalg.norm(found.residuals, axis=-1), found.std.shape[1]
        errors[batch.rows, :width] = np.where(is_predicted, size, np.nan)
        std[batch.rows, :width] = np.where(is_predicted, found.std, np.nan)
    ratios = (errors / std)[np.isfinite(std)]
    expected = np.sqrt(-2 * np.log(1 - (np.arange(_N_EXPECTED) + 0.5) / _N_EXPECTED))
    levels = np.quantile(np.concatenate([ratios, expected]), _LEVELS)
    return _Errors(errors, std[..., None] * levels)


def _predict(mount: CalibratedMount, by_others: Array, by_days: Array) -> PredictedError | None:
    """Predict the next error from quantiles (M, K), NaN if unknown; None for too few of them."""
    is_known = np.isfinite(by_days[:, 0])
    count = int(is_known.sum())
    if count < MIN_MEASUREMENTS or mount.foreign.mean() > MAX_OUTLIERS:
        return None
    near, far = by_others[is_known], by_days[is_known]
    return PredictedError(
        float(np.median([near, far])),
        float(np.quantile(near, 0.05)),
        float(np.quantile(far, 0.95)) * max(1 + 2 / count, _DRIFT),
        count,
    )
