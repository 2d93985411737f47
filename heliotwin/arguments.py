"""Checks of arguments; each error names the argument and the remedy."""

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError
from service.base.fields import Sun, parse_moment

SunLike: TypeAlias = datetime | Sequence[float]
"""A time with a zone, or azimuth from north over east and elevation [deg]."""

# Heights of a mirror [m] beyond which they are surely in another unit.
_MAX_HEIGHT_M = 0.1
_SIDES = range(8, 1025)


def require_folder(folder: str | Path) -> Path:
    """The folder as a path."""
    path = Path(folder)
    if not path.is_dir():
        raise InvalidInputError(
            f"folder: there is no folder {path}; give the root of a measurement folder, or make"
            " one by make_demo"
        )
    return path


def require_known(argument: str, name: object, known: Iterable[str]) -> str:
    """A name among ``known`` ones."""
    names = list(known)
    if not isinstance(name, str) or name not in names:
        shown = ", ".join(names[:10]) + (", .." if len(names) > 10 else "")
        raise InvalidInputError(f"{argument}: there is no {name!r}; give one of {shown}")
    return name


def resolve_sun(sun: SunLike, origin: ArrayLike) -> tuple[Sun, datetime | None]:
    """Position of the sun over ``origin``, and the time if one is given."""
    if isinstance(sun, datetime):
        return _sun_at(sun, origin), sun
    angles = _numbers(sun)
    if angles.shape != (2,) or not np.isfinite(angles).all():
        raise InvalidInputError(
            "sun: give azimuth from north over east and elevation, two numbers in degrees, or a"
            f" datetime with a zone; got {sun!r}"
        )
    azimuth, elevation = angles.tolist()
    if not 0 <= azimuth < 360:
        raise InvalidInputError(
            f"sun: the azimuth {azimuth:g} must lie in 0 to 360 degrees, from north over east;"
            f" give {azimuth % 360:g} if it is so counted"
        )
    if not 0 < elevation <= 90:
        raise InvalidInputError(
            f"sun: the elevation {elevation:g} must be above the horizon, up to 90 degrees; give"
            " azimuth first, then elevation"
        )
    return Sun(azimuth_deg=azimuth, elevation_deg=elevation), None


def _sun_at(at: datetime, origin: ArrayLike) -> Sun:
    if at.tzinfo is None:
        raise InvalidInputError(
            f"sun: the time {at.isoformat()} has no zone; give one, such as tzinfo=timezone.utc"
        )
    try:
        azimuth, elevation = sun_angles_at(parse_moment(at), origin)
    except ValueError as error:
        raise InvalidInputError(f"sun: {error}") from None
    if elevation <= 0:
        raise InvalidInputError(
            f"sun: at {at.isoformat()} it is {-elevation:.1f} degrees below the horizon; give a"
            " time by day"
        )
    return Sun(azimuth_deg=azimuth, elevation_deg=elevation)


def moment_of(at: datetime | None) -> datetime | None:
    """The time of ``--at`` in UTC; `InvalidInputError` for an implausible year."""
    try:
        return None if at is None else parse_moment(at)
    except ValueError as error:
        raise InvalidInputError(f"--at: {error}") from None


def require_heights(z: ArrayLike, facets: int) -> NDArray[np.float64]:
    """Control heights (facets, 8, 8) [m]."""
    heights = _numbers(z)
    if heights.shape != (facets, 8, 8) or not np.isfinite(heights).all():
        raise InvalidInputError(
            f"z: give finite control heights of the shape ({facets}, 8, 8); got {heights.shape}"
        )
    if np.abs(heights).max() > _MAX_HEIGHT_M:
        raise InvalidInputError(
            f"z: heights are in metres and at most {_MAX_HEIGHT_M:g}; got up to"
            f" {np.abs(heights).max():g}"
        )
    return heights


def require_resolution(resolution: Sequence[int]) -> tuple[int, int]:
    """Rows and columns of a map."""
    sides = tuple(resolution) if isinstance(resolution, Sequence) else ()
    if len(sides) != 2 or any(side not in _SIDES for side in sides):
        raise InvalidInputError(
            f"resolution: give rows and columns, two integers from {_SIDES.start} to"
            f" {_SIDES.stop - 1}; got {resolution!r}"
        )
    return int(sides[0]), int(sides[1])


def require_point(argument: str, point: ArrayLike) -> tuple[float, float, float]:
    """East, north and up, as a point [m] or a direction."""
    place = _numbers(point)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise InvalidInputError(
            f"{argument}: give three numbers, east, north and up of the tower base; got {point!r}"
        )
    east, north, up = place.tolist()
    return east, north, up


def _numbers(value: ArrayLike) -> NDArray[np.float64]:
    """The value as an array, which is empty if it has other things than numbers."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)


def require_positive(argument: str, value: float, unit: str) -> float:
    """A finite number above zero."""
    if not isinstance(value, int | float | np.number) or not 0 < float(value) < np.inf:
        raise InvalidInputError(f"{argument}: give a number above 0 [{unit}]; got {value!r}")
    return float(value)
