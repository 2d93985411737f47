"""Convert the measurements of a field to the arrays of a calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from model.pointing.kinematics import Readings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weather:
    """Weather of a photograph, None if not stored; ``wind_from_deg`` from north over east."""

    wind_speed_m_s: float | None = None
    wind_from_deg: float | None = None
    temperature_c: float | None = None

    @classmethod
    def of(cls, known: object) -> "Weather":
        """The weather of an object with attributes of these names."""
        return cls(**{name.name: getattr(known, name.name) for name in fields(cls)})


@dataclass(frozen=True, eq=False)
class Reading:
    """One measurement of one heliostat: ``motors`` (2,) [steps], unit ``sun`` (3,), ``spot`` (3,)
    [m], ``day`` [d].

    ``day`` is NaN for a time that is not known.
    """

    name: str
    target: str
    motors: Array
    sun: Array
    spot: Array
    day: float
    weather: Weather = Weather()


def pad_readings(readings: Sequence[Sequence[Reading]]) -> Readings:
    """Pad the readings of H heliostats; each in order of time, those of an unknown time first."""
    most = max(1, *(len(own) for own in readings)) if readings else 1
    shape = (len(readings), most)
    steps, sun, spot = np.zeros((*shape, 2)), np.zeros((*shape, 3)), np.zeros((*shape, 3))
    days, used = np.zeros(shape), np.zeros(shape, dtype=bool)
    sun[...] = (0.0, 0.0, 1.0)
    spot[...] = (1e3, 1e3, 1e3)  # a place without a heliostat
    for row, own in enumerate(readings):
        for place, reading in enumerate(own):
            steps[row, place], sun[row, place] = reading.motors, reading.sun
            spot[row, place], days[row, place] = reading.spot, reading.day
            used[row, place] = True
    return Readings(steps, sun, spot, days, used)
