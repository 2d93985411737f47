"""Measurements of a field, as they come, to arrays that a calibration takes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.mount import rotation
from model.pointing.kinematics import Readings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weather:
    """The air while a photograph was taken, None where it is not stored; ``wind_from_deg`` from north, over east."""

    wind_speed_m_s: float | None = None
    wind_from_deg: float | None = None
    temperature_c: float | None = None


@dataclass(frozen=True, eq=False)
class Reading:
    """One measurement of one heliostat: ``motors`` (2,) [steps], unit ``sun`` (3,), ``spot`` (3,) [m], ``day`` [d]."""

    name: str
    target: str
    motors: Array
    sun: Array
    spot: Array
    day: float
    weather: Weather = Weather()


def padded(readings: Sequence[Sequence[Reading]]) -> Readings:
    """Readings of H heliostats, each in order of time, padded to as many as any of them has."""
    most = max(1, *(len(own) for own in readings)) if readings else 1
    shape = (len(readings), most)
    steps, sun, spot = np.zeros((*shape, 2)), np.zeros((*shape, 3)), np.zeros((*shape, 3))
    days, used = np.zeros(shape), np.zeros(shape, dtype=bool)
    sun[...] = (0.0, 0.0, 1.0)
    spot[...] = (1e3, 1e3, 1e3)  # anywhere but where a heliostat stands
    for row, own in enumerate(readings):
        for place, reading in enumerate(own):
            steps[row, place], sun[row, place], spot[row, place] = reading.motors, reading.sun, reading.spot
            days[row, place], used[row, place] = reading.day, True
    return Readings(steps, sun, spot, days, used)


def days_by_order(days: ArrayLike, order: ArrayLike) -> Array:
    """Days (N,) with those that are NaN read off others, by numbers ``order`` (N,) that grow with time.

    All stay NaN where none is known.
    """
    when, number = np.asarray(days, dtype=np.float64), np.asarray(order, dtype=np.float64)
    known = np.isfinite(when)
    if not known.any():
        return when
    by_number = np.argsort(number[known])
    return np.where(known, when, np.interp(number, number[known][by_number], when[known][by_number]))


def later(suns: Array, minutes: float, latitude_deg: float) -> Array:
    """Suns (..., 3) that stand where they are some minutes after: they turn about the pole, 15 degrees an hour."""
    latitude = np.radians(latitude_deg)
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    return np.asarray(suns @ rotation(pole, -np.radians(minutes / 4)).T)
