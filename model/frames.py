"""Frames: WGS84 to local east-north-up, and directions to the sun.

Everything inside heliotwin is in east-north-up (ENU) metres from the tower base. PAINT stores
positions in WGS84; this module is the only place that converts them. Azimuths are from north over
east.
"""

from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import InvalidInputError

Angle = TypeVar("Angle", float, NDArray[np.float64])

# WGS84 defining constants (NIMA TR8350.2): semi-major axis [m] and flattening.
_SEMI_MAJOR_AXIS = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_SQUARED = _FLATTENING * (2 - _FLATTENING)


def _ecef(wgs84: NDArray[np.float64]) -> NDArray[np.float64]:
    """Earth-centred coordinates (..., 3) [m] of latitude [deg], longitude [deg], altitude [m]."""
    latitude, longitude = np.radians(wgs84[..., 0]), np.radians(wgs84[..., 1])
    altitude = wgs84[..., 2]
    prime_vertical = _SEMI_MAJOR_AXIS / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    horizontal = (prime_vertical + altitude) * np.cos(latitude)
    vertical = (prime_vertical * (1 - _ECCENTRICITY_SQUARED) + altitude) * np.sin(latitude)
    return np.stack(
        [horizontal * np.cos(longitude), horizontal * np.sin(longitude), vertical], axis=-1
    )


def _enu_axes(origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """East, north, up at ``origin`` as rows (3, 3), in earth-centred coordinates."""
    latitude, longitude = np.radians(origin[:2])
    sin_lat, cos_lat, sin_lon, cos_lon = (
        np.sin(latitude),
        np.cos(latitude),
        np.sin(longitude),
        np.cos(longitude),
    )
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def _as_wgs84(name: str, value: ArrayLike) -> NDArray[np.float64]:
    wgs84 = np.asarray(value, dtype=np.float64)
    if wgs84.shape[-1:] != (3,) or not np.isfinite(wgs84).all():
        raise InvalidInputError(
            f"{name} must be finite (latitude, longitude, altitude), got {value!r}"
        )
    if (np.abs(wgs84[..., 0]) > 90).any() or (np.abs(wgs84[..., 1]) > 180).any():
        raise InvalidInputError(
            f"{name}: latitude must lie in [-90, 90] and longitude in [-180, 180] degrees"
        )
    return wgs84


def wgs84_to_enu(wgs84: ArrayLike, origin: ArrayLike) -> NDArray[np.float64]:
    """East-north-up coordinates of WGS84 positions.

    Parameters
    ----------
    wgs84 : array_like (..., 3)
        Latitude [deg], longitude [deg], altitude [m].
    origin : array_like (3,)
        The tower base, likewise.

    Returns
    -------
    ndarray (..., 3)
        East, north, up [m] on the tangent plane at ``origin``.

    Raises
    ------
    InvalidInputError
        Where a coordinate is not finite or outside its range.
    """
    position, base = _as_wgs84("position", wgs84), _as_wgs84("origin", origin)
    return np.asarray((_ecef(position) - _ecef(base)) @ _enu_axes(base).T)


def enu_to_wgs84(enu: ArrayLike, origin: ArrayLike) -> NDArray[np.float64]:
    """WGS84 positions (..., 3) [deg, deg, m] of east-north-up coordinates (..., 3) [m]; inverts
    `wgs84_to_enu`.

    Bowring's fixed-point iteration on the latitude; five rounds reach the rounding of a double near
    the surface.
    """
    base = _as_wgs84("origin", origin)
    x, y, z = np.moveaxis(np.asarray(enu, dtype=np.float64) @ _enu_axes(base) + _ecef(base), -1, 0)
    horizontal = np.hypot(x, y)
    latitude = np.arctan2(z, horizontal * (1 - _ECCENTRICITY_SQUARED))
    for _ in range(5):
        prime_vertical = _SEMI_MAJOR_AXIS / np.sqrt(
            1 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
        )
        latitude = np.arctan2(
            z + _ECCENTRICITY_SQUARED * prime_vertical * np.sin(latitude), horizontal
        )
    prime_vertical = _SEMI_MAJOR_AXIS / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    altitude = (
        horizontal * np.cos(latitude)
        + z * np.sin(latitude)
        - prime_vertical * (1 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    )
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude], axis=-1)


def sun_direction(azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors (..., 3) in ENU towards the sun; the azimuth is from north over east."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.stack(
        np.broadcast_arrays(
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ),
        axis=-1,
    )


SOLAR_DISC = 4.65e-3
"""Half angle of the solar disc [rad]."""


class SunAngles(NamedTuple, Generic[Angle]):
    """Azimuth from north over east, and elevation, of the sun [deg]."""

    azimuth: Angle
    elevation: Angle


def sun_angles(direction: ArrayLike) -> SunAngles[NDArray[np.float64]]:
    """Angles of unit vectors (..., 3) towards the sun; inverts `sun_direction`.

    The azimuth lies in [0, 360).
    """
    east, north, up = np.moveaxis(np.asarray(direction, dtype=np.float64), -1, 0)
    azimuth = np.degrees(np.arctan2(east, north)) % 360 % 360  # a tiny negative one rounds to 360
    return SunAngles(azimuth, np.degrees(np.arcsin(np.clip(up, -1, 1))))


def sun_direction_at(
    declination_deg: ArrayLike, hour_angle_deg: ArrayLike, latitude_deg: float
) -> NDArray[np.float64]:
    """Unit vectors (..., 3) in ENU towards a sun of given declination and hour angle (positive in
    the afternoon).

    Duffie and Beckman, *Solar Engineering of Thermal Processes*, eq. 1.6.5, as a vector. It is all
    that sampling the year's sun positions needs; no ephemeris is involved.
    """
    declination, hour_angle = np.radians(declination_deg), np.radians(hour_angle_deg)
    latitude = np.radians(latitude_deg)
    toward_equator = np.cos(declination) * np.cos(hour_angle)
    toward_pole = np.sin(declination)
    return np.stack(
        np.broadcast_arrays(
            -np.cos(declination) * np.sin(hour_angle),
            toward_pole * np.cos(latitude) - toward_equator * np.sin(latitude),
            toward_pole * np.sin(latitude) + toward_equator * np.cos(latitude),
        ),
        axis=-1,
    )


def solar_time(direction: ArrayLike, latitude_deg: float) -> NDArray[np.float64]:
    """Apparent solar time [h], noon at 12, of unit vectors (..., 3) in ENU towards the sun.

    Inverts the hour angle of `sun_direction_at`: the sun turns by 15 degrees an hour.
    """
    east, north, up = np.moveaxis(np.asarray(direction, dtype=np.float64), -1, 0)
    latitude = np.radians(latitude_deg)
    toward_equator = up * np.cos(latitude) - north * np.sin(latitude)
    return np.asarray(12 + np.degrees(np.arctan2(-east, toward_equator)) / 15)
