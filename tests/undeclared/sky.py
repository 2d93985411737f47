"""Position of the sun at a time, seen from the Solar Tower Juelich.

Fourier series of declination and equation of time, accurate to 0.15 degrees (Spencer, *Fourier
series representation of the position of the sun*, Search 2 (1971) 172). The model uses a different
algorithm.
"""

from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PLACE = np.array([50.913421, 6.387825, 87.0])
"""Latitude, longitude [deg] and altitude [m] of the tower's base."""

_NEW_YEAR, _YEAR_DAYS = datetime(2001, 1, 1, tzinfo=UTC), 365.2422

_DRIFT_DAYS = 0.7
"""The equinox of 2001 came so much earlier by the calendar than when the series was made."""


def sun(moment: datetime) -> Array:
    """Direction (3,) east, north, up of the sun at a moment with time zone."""
    days = (moment - _NEW_YEAR).total_seconds() / 86400
    turns = 2 * np.pi * (days + _DRIFT_DAYS) / _YEAR_DAYS * np.arange(4)
    cosines, sines = np.cos(turns), np.sin(turns)
    declination = cosines @ [0.006918, -0.399912, -0.006758, -0.002697] + sines @ [
        0,
        0.070257,
        0.000907,
        0.00148,
    ]
    minutes = 229.18 * (
        cosines @ [7.5e-5, 0.001868, -0.014615, 0] - sines @ [0, 0.032077, 0.040849, 0]
    )
    # A turn a day and a degree of longitude each; at noon the hour angle is zero.
    hour = 2 * np.pi * (days % 1 - 0.5) + np.radians(PLACE[1] + minutes / 4)
    east, equator = -np.cos(declination) * np.sin(hour), np.cos(declination) * np.cos(hour)
    pole, latitude = np.sin(declination), np.radians(PLACE[0])
    return np.array(
        [
            east,
            pole * np.cos(latitude) - equator * np.sin(latitude),
            pole * np.sin(latitude) + equator * np.cos(latitude),
        ]
    )
