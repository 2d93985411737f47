"""Where the sun is seen at a time and place."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import InvalidInputError
from model.frames import SunAngles, sun_direction

Array = NDArray[np.float64]

TEMPERATURE_C = 12.0
"""Default temperature of the air [deg C]; 20 more move a sun at 10 degrees by 0.1 mrad."""

DELTA_T_S = 69.2
"""Terrestrial time less UT1 [s]: the IERS observed it within 0.6 s of this from 2017 to 2025.

In 1970 it was 29 s less, which moves the sun by 6 microradians.
"""

# Refraction [deg] at sunrise and sunset: SPA corrects elevations for refraction down to this and
# the sun's radius.
_AT_THE_HORIZON_DEG = 0.5667

# Altitude [m] up to which the standard atmosphere's formula of pressure holds.
_TOP_M = 11e3


def sun_positions(
    moments: Sequence[datetime], origin: ArrayLike, temperature_c: ArrayLike = TEMPERATURE_C
) -> Array:
    """Azimuth from north over east, and apparent elevation (N, 2) [deg], of the sun at N times.

    Both are of the sun's centre. The elevation is the refracted one, down to 0.83 degrees below the
    horizon. Pressure is that of the standard atmosphere at the place's altitude.

    Parameters
    ----------
    moments : sequence of datetime, (N,)
        With time zones.
    origin : array_like (3,)
        Latitude [deg], longitude [deg] and altitude [m] of the place.
    temperature_c : array_like () or (N,) [deg C]
        Of the air.

    Raises
    ------
    InvalidInputError
        For a moment without a time zone.

    Source: Reda and Andreas 2004, *Solar position algorithm for solar radiation applications*,
    doi:10.1016/j.solener.2003.12.003, good to 0.0003 degrees without refraction, as pvlib has it.
    """
    # It brings pandas with it, which takes a second to load.
    from pvlib import atmosphere, spa

    if any(moment.tzinfo is None for moment in moments):
        raise InvalidInputError("moment: give it a time zone")
    latitude_deg, longitude_deg, altitude_m = (
        float(value) for value in np.asarray(origin, dtype=np.float64)
    )
    _, _, elevation, _, azimuth, _ = spa.solar_position(
        np.array([moment.timestamp() for moment in moments]),
        latitude_deg,
        longitude_deg,
        altitude_m,
        atmosphere.alt2pres(min(altitude_m, _TOP_M)) / 100,  # hPa
        np.asarray(temperature_c, dtype=np.float64),
        DELTA_T_S,
        _AT_THE_HORIZON_DEG,
    )
    return np.stack([np.asarray(azimuth), np.asarray(elevation)], axis=-1)


def sun_angles_at(moment: datetime, origin: ArrayLike) -> SunAngles[float]:
    """Azimuth and apparent elevation of the sun at one time; see `sun_positions`."""
    return SunAngles(*sun_positions([moment], origin)[0].tolist())


TOLERANCE_DEG = 0.5
"""Angle [deg] that a recorded sun may lie from where it was seen at the recorded time: two minutes
of a clock.

A time that is cut to the minute explains 0.25, a sun that was recorded without refraction another
0.24 at an elevation of three degrees. Recorded times of PAINT explain 0.008, times between those of
neighbours 0.3.
"""


@dataclass(frozen=True)
class SunContradiction:
    """Angle [deg] between a recorded sun and that of its recorded time, with the likely cause.

    ``ahead_h`` [h] is how far a clock that explains it is ahead, if there is one.
    """

    angle_deg: float
    detail: str
    ahead_h: float | None = None


def clock_faults(
    suns: Array,
    moments: Sequence[datetime],
    origin: ArrayLike,
    temperatures_c: Sequence[float | None] | None = None,
) -> list[SunContradiction | None]:
    """What is wrong with N recorded times, by the suns (N, 3) that were recorded with them; None
    where both agree.

    A clock in another time zone is off by whole or half hours: the likeliest is named where one
    explains the sun. ``temperatures_c`` are those of the air [deg C], where they are known.
    """
    if not moments:
        return []
    known = [
        TEMPERATURE_C if one is None else one for one in temperatures_c or [None] * len(moments)
    ]
    apart = _apart_deg(suns, sun_positions(moments, origin, known))
    return [
        (
            None
            if angle <= TOLERANCE_DEG
            else _likely_fault(sun, moment, origin, temperature, float(angle))
        )
        for sun, moment, temperature, angle in zip(suns, moments, known, apart, strict=True)
    ]


def _apart_deg(suns: Array, angles: Array) -> Array:
    """Angles (N,) [deg] between suns (N, 3) or (3,) and azimuths and elevations (N, 2) [deg]."""
    cosines = (suns * sun_direction(angles[:, 0], angles[:, 1])).sum(axis=-1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1, 1))))


# By how far clocks are set wrong: to another time zone, or to summer [h].
_ZONES_H = np.arange(-28, 29) / 2


def _likely_fault(
    sun: Array, moment: datetime, origin: ArrayLike, temperature_c: float, apart_deg: float
) -> SunContradiction:
    """What is wrong with a time that a sun (3,) contradicts."""
    said = (
        f"the sun was recorded {apart_deg:.1f} degrees from its computed position at"
        f" {moment.isoformat(timespec='minutes')}"
    )
    shifted = [moment - timedelta(hours=hours) for hours in _ZONES_H]
    apart = _apart_deg(sun, sun_positions(shifted, origin, temperature_c))
    hours = float(_ZONES_H[apart.argmin()])
    if hours == 0 or apart.min() > TOLERANCE_DEG:
        return SunContradiction(apart_deg, f"{said}; check time, sun and place")
    direction = "ahead" if hours > 0 else "behind"
    detail = f"{said}; a clock {abs(hours):g} h {direction} explains it: check its time zone"
    return SunContradiction(apart_deg, detail, hours)
