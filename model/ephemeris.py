"""Where the sun stands at a time and place."""

from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.frames import sun_angles, sun_direction, sun_direction_at

_NOON_OF_2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)


def sun_angles_at(moment: datetime, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Azimuth, from south and positive to the east, and elevation [deg] of the sun's centre, without refraction.

    The Astronomical Almanac's low-precision formulae, good to 0.01 degrees from 1950 to 2050. Source: Michalsky 1988,
    *The Astronomical Almanac's algorithm for approximate solar position*, doi 10.1016/0038-092X(88)90045-X.

    Raises
    ------
    InvalidInputError
        For a moment without a time zone.
    """
    if moment.tzinfo is None:
        raise InvalidInputError("moment: give it a time zone")
    days = (moment - _NOON_OF_2000).total_seconds() / 86400
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly))
    obliquity = np.radians(23.439 - 4e-7 * days)
    right_ascension = np.degrees(np.arctan2(np.cos(obliquity) * np.sin(longitude), np.cos(longitude)))
    declination = np.degrees(np.arcsin(np.sin(obliquity) * np.sin(longitude)))
    # Greenwich's mean sidereal time; a day of the sun is 360.9856 degrees of the stars.
    sidereal = 280.46062 + 360.98564737 * days
    hour_angle = sidereal + longitude_deg - right_ascension
    azimuth, elevation = sun_angles(sun_direction_at(declination, hour_angle, latitude_deg))
    return float(azimuth), float(elevation)


TOLERANCE_DEG = 1.0
"""Angle [deg] that a recorded sun may lie from where it stood at the recorded time: four minutes of a clock."""


def clock_fault(sun: NDArray[np.float64], moment: datetime, latitude_deg: float, longitude_deg: float) -> str | None:
    """What is wrong with a recorded time, by the sun (3,) that was recorded with it; None where both agree.

    A clock in another time zone is off by whole or half hours: the likeliest is named where one explains the sun.
    """

    def apart_deg(hours: float) -> float:
        stood = sun_angles_at(moment - timedelta(hours=hours), latitude_deg, longitude_deg)
        return float(np.degrees(np.arccos(np.clip(sun @ sun_direction(*stood), -1, 1))))

    apart = apart_deg(0.0)
    if apart <= TOLERANCE_DEG:
        return None
    said = f"the sun was recorded {apart:.1f} degrees from where it stood at {moment.isoformat(timespec='minutes')}"
    hours = min((half / 2 for half in range(-28, 29)), key=apart_deg)
    if hours == 0 or apart_deg(hours) > TOLERANCE_DEG:
        return f"{said}; check time, sun and place"
    return f"{said}; a clock {abs(hours):g} h {'ahead' if hours > 0 else 'behind'} explains it: check its time zone"
