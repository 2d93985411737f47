"""What goes with the errors of forecast spots: time of day, season, wind and temperature, where they are stored.

Each measurement's error is that which it has when it alone is left out of its mount's calibration. A covariate's terms
are fitted to the errors of all heliostats but one, together, and judged by that one: the share of its squared errors
that they take away beyond a constant. Noise is not explained that way; a share below 0 is one that does not hold
elsewhere.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.frames import solar_time
from model.pointing.calibration import Kind, parts
from model.pointing.kinematics import Readings
from model.pointing.readings import Reading

Array = NDArray[np.float64]

DIRECTIONS = ("sidewards", "upwards")

# Fewer heliostats say nothing of one another.
_LEAST_HELIOSTATS = 3

# Errors beyond so many medians of their heliostat's are cut: foreign spots and steps that nothing else tells of.
_CUT = 5.0

_DRAWS = 1000


@dataclass(frozen=True)
class Explained:
    """What a covariate explains.

    Attributes
    ----------
    measurements : int
        Those that it is stored of.
    share : dict of float
        Of squared errors that it takes away, by direction; empty where too few heliostats have it.
    ci95 : dict of pair of float
        With heliostats drawn anew.
    """

    measurements: int
    share: Mapping[str, float]
    ci95: Mapping[str, tuple[float, float]]


def explain(
    kinds: Sequence[Kind], readings: Readings, own: Sequence[Sequence[Reading]], latitude_deg: float
) -> dict[str, Explained]:
    """What each covariate explains of a field that was calibrated by ``readings``, which are those of ``own``."""
    errors = np.full(readings.steps.shape, np.nan)
    for part in parts(kinds, readings):
        errors[part.rows, : part.readings.used.shape[1]] = part.posterior.left_out()
    found: list[Array] = []
    taken: list[Reading] = []
    for off, series in zip(errors, own, strict=True):
        told = [place for place in range(len(series)) if np.isfinite(off[place]).all()]
        taken += [series[place] for place in told]
        most = _CUT * np.median(np.linalg.norm(off[told], axis=-1)) if told else 0.0
        found.append(np.clip(off[told], -most, most))
    if not taken:  # one measurement, say, which leaves nothing to be left out of
        return dict.fromkeys(COVARIATES, Explained(0, {}, {}))
    heliostat = np.repeat(np.arange(len(found)), [len(off) for off in found])
    cut = np.concatenate(found)
    return {name: _explained(terms(taken, latitude_deg), cut, heliostat) for name, terms in COVARIATES.items()}


def _explained(terms: Array, errors: Array, heliostat: NDArray[np.intp]) -> Explained:
    """By terms (N, K) that are NaN where they are not stored, of errors (N, 2) of heliostats (N,)."""
    known = np.isfinite(terms).all(axis=1)
    names, number = np.unique(heliostat[known], return_inverse=True)
    if len(names) < _LEAST_HELIOSTATS:
        return Explained(int(known.sum()), {}, {})
    terms, errors = terms[known], errors[known]
    spread = terms.std(axis=0)
    scaled = (terms - terms.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    constant = np.ones((len(errors), 1))
    without, left = (
        _left(columns, errors, number, len(names)) for columns in (constant, np.concatenate([constant, scaled], axis=1))
    )
    drawn = np.random.default_rng(0).multinomial(len(names), np.full(len(names), 1 / len(names)), _DRAWS)
    share, shares = 1 - left.sum(axis=0) / without.sum(axis=0), 1 - (drawn @ left) / (drawn @ without)
    low, high = np.percentile(shares, [2.5, 97.5], axis=0)
    return Explained(
        len(errors),
        dict(zip(DIRECTIONS, share.tolist(), strict=True)),
        dict(zip(DIRECTIONS, zip(low.tolist(), high.tolist(), strict=True), strict=True)),
    )


def _left(columns: Array, errors: Array, number: NDArray[np.intp], count: int) -> Array:
    """Sums of squares (H, 2) that columns (N, K) leave of each heliostat's errors, fitted to those of all others."""
    square, pull = np.zeros((count, *2 * columns.shape[1:])), np.zeros((count, columns.shape[1], 2))
    np.add.at(square, number, columns[:, :, None] * columns[:, None])
    np.add.at(pull, number, columns[:, :, None] * errors[:, None])
    fitted = np.linalg.pinv(square.sum(axis=0) - square, hermitian=True) @ (pull.sum(axis=0) - pull)
    left = np.zeros((count, 2))
    np.add.at(left, number, (errors - (columns[:, None] @ fitted[number])[:, 0]) ** 2)
    return left


def _time_of_day(taken: Sequence[Reading], latitude_deg: float) -> Array:
    """Two harmonics of the solar day."""
    return _harmonics(solar_time(np.array([one.sun for one in taken]), latitude_deg) / 24, 2)


def _season(taken: Sequence[Reading], _: float) -> Array:
    """One harmonic of the year."""
    return _harmonics(np.array([one.day for one in taken]) / 365.2425, 1)


def _wind(taken: Sequence[Reading], _: float) -> Array:
    """What pushes from the east and the north grows with the square of the speed; so does what shakes."""
    speed = np.array([one.weather.wind_speed_m_s for one in taken], dtype=np.float64)
    angle = np.radians(np.array([one.weather.wind_from_deg for one in taken], dtype=np.float64))
    return np.stack([speed**2 * np.sin(angle), speed**2 * np.cos(angle), speed**2], axis=-1)


def _temperature(taken: Sequence[Reading], _: float) -> Array:
    return np.array([[one.weather.temperature_c] for one in taken], dtype=np.float64)


def _harmonics(turns: Array, count: int) -> Array:
    angles = 2 * np.pi * turns[:, None] * np.arange(1, count + 1)
    return np.concatenate([np.cos(angles), np.sin(angles)], axis=-1)


COVARIATES: dict[str, Callable[[Sequence[Reading], float], Array]] = {
    "time_of_day": _time_of_day,
    "season": _season,
    "wind": _wind,
    "temperature": _temperature,
}
"""The terms (N, K) of readings by each, at a latitude [deg]."""
