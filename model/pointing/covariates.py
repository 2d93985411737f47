"""Explain the errors of forecast spots by time of day, season, wind and temperature.

Notes
-----
The error of a measurement is its leave-one-out residual. The terms of a covariate are fitted to the
errors of all heliostats but one, and judged by that one: the share of its squared errors that they
explain beyond a constant. Noise is not explained in this way. A negative share does not hold at
other heliostats.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap

from model.frames import solar_time
from model.pointing.calibration import Kind, calibrated_batches
from model.pointing.kinematics import Readings
from model.pointing.readings import Reading
from model.site import Site

Array = NDArray[np.float64]

DIRECTIONS = ("sidewards", "upwards")

# Smallest number of heliostats for a cross-validation.
_MIN_HELIOSTATS = 3

# Errors are clipped at this multiple of their heliostat's median: undetected foreign spots and
# steps.
_CLIP = 5.0

_DRAWS = 1000


@dataclass(frozen=True)
class ExplainedShare:
    """The share of squared errors that a covariate explains.

    Attributes
    ----------
    measurements : int
        Number of measurements with a stored value.
    share : dict of float
        By direction; empty if too few heliostats have the covariate.
    ci95 : dict of pair of float
        By a bootstrap over heliostats.
    """

    measurements: int
    share: Mapping[str, float]
    ci95: Mapping[str, tuple[float, float]]


def explain_errors(
    kinds: Sequence[Kind], readings: Readings, own: Sequence[Sequence[Reading]], site: Site
) -> dict[str, ExplainedShare]:
    """Judge each covariate on a field that was calibrated by ``readings``, padded from ``own``."""
    errors = np.full(readings.steps.shape, np.nan)
    for batch in calibrated_batches(kinds, readings):
        errors[batch.rows, : batch.readings.used.shape[1]] = batch.model.left_out_errors().residuals
    found: list[Array] = []
    taken: list[Reading] = []
    for error, series in zip(errors, own, strict=True):
        known = [place for place in range(len(series)) if np.isfinite(error[place]).all()]
        taken += [series[place] for place in known]
        limit = _CLIP * np.median(np.linalg.norm(error[known], axis=-1)) if known else 0.0
        found.append(np.clip(error[known], -limit, limit))
    if not taken:  # a single measurement has no leave-one-out residual
        return dict.fromkeys(COVARIATES, ExplainedShare(0, {}, {}))
    heliostat = np.repeat(np.arange(len(found)), [len(error) for error in found])
    clipped = np.concatenate(found)
    return {
        name: _explained(terms(taken, site), clipped, heliostat)
        for name, terms in COVARIATES.items()
    }


def _explained(terms: Array, errors: Array, heliostat: NDArray[np.intp]) -> ExplainedShare:
    """Judge terms (N, K), NaN if not stored, on errors (N, 2) of heliostats (N,)."""
    known = np.isfinite(terms).all(axis=1)
    names, number = np.unique(heliostat[known], return_inverse=True)
    if len(names) < _MIN_HELIOSTATS:
        return ExplainedShare(int(known.sum()), {}, {})
    terms, errors = terms[known], errors[known]
    spread = terms.std(axis=0)
    scaled = (terms - terms.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    constant = np.ones((len(errors), 1))
    without, left = (
        _residual_squares(columns, errors, number, len(names))
        for columns in (constant, np.concatenate([constant, scaled], axis=1))
    )
    drawn = bootstrap(
        (left, without), _share, axis=0, paired=True, n_resamples=_DRAWS, method="percentile", rng=0
    )
    share, (low, high) = _share(left, without, axis=0), drawn.confidence_interval
    return ExplainedShare(
        len(errors),
        dict(zip(DIRECTIONS, share.tolist(), strict=True)),
        dict(zip(DIRECTIONS, zip(low.tolist(), high.tolist(), strict=True), strict=True)),
    )


def _share(left: Array, without: Array, axis: int) -> Array:
    """Share of the squares ``without`` terms that the terms explain, of all heliostats."""
    return np.asarray(1 - left.sum(axis=axis) / without.sum(axis=axis))


def _residual_squares(columns: Array, errors: Array, number: NDArray[np.intp], count: int) -> Array:
    """Squares (H, 2) of each heliostat's residuals to columns (N, K) fitted to all others."""
    square, pull = np.zeros((count, *2 * columns.shape[1:])), np.zeros((count, columns.shape[1], 2))
    np.add.at(square, number, columns[:, :, None] * columns[:, None])
    np.add.at(pull, number, columns[:, :, None] * errors[:, None])
    fitted = np.linalg.pinv(square.sum(axis=0) - square, hermitian=True) @ (pull.sum(axis=0) - pull)
    left = np.zeros((count, 2))
    np.add.at(left, number, (errors - (columns[:, None] @ fitted[number])[:, 0]) ** 2)
    return left


def _time_of_day(taken: Sequence[Reading], site: Site) -> Array:
    """Two harmonics of the solar day."""
    return _harmonics(solar_time(np.array([one.sun for one in taken]), site.latitude_deg) / 24, 2)


def _season(taken: Sequence[Reading], _: Site) -> Array:
    """One harmonic of the year."""
    return _harmonics(np.array([one.day for one in taken]) / 365.2425, 1)


def _wind(taken: Sequence[Reading], _: Site) -> Array:
    """Wind pressure from east and north, and gusts: all grow with the square of the speed."""
    speed = np.array([one.weather.wind_speed_m_s for one in taken], dtype=np.float64)
    angle = np.radians(np.array([one.weather.wind_from_deg for one in taken], dtype=np.float64))
    return np.stack([speed**2 * np.sin(angle), speed**2 * np.cos(angle), speed**2], axis=-1)


def _temperature(taken: Sequence[Reading], _: Site) -> Array:
    return np.array([[one.weather.temperature_c] for one in taken], dtype=np.float64)


def _harmonics(turns: Array, count: int) -> Array:
    angles = 2 * np.pi * turns[:, None] * np.arange(1, count + 1)
    return np.concatenate([np.cos(angles), np.sin(angles)], axis=-1)


COVARIATES: dict[str, Callable[[Sequence[Reading], Site], Array]] = {
    "time_of_day": _time_of_day,
    "season": _season,
    "wind": _wind,
    "temperature": _temperature,
}
"""Functions that make the terms (N, K) of readings at a site."""
