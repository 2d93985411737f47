"""The location of a plant."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.mount import rotation

Array = NDArray[np.float64]

Origin = tuple[float, float, float]
"""Latitude [deg], longitude [deg] and altitude [m]."""

_DEGREES_PER_MINUTE = 0.25


@dataclass(frozen=True)
class Site:
    """Location of a plant's tower base in WGS84: latitude and longitude [deg], altitude [m]."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    @classmethod
    def from_origin(cls, origin: ArrayLike) -> "Site":
        """The site of an `Origin` (3,)."""
        return cls(*np.asarray(origin, dtype=np.float64).tolist())

    @property
    def origin(self) -> Origin:
        """The site as an origin."""
        return self.latitude_deg, self.longitude_deg, self.altitude_m

    def advance_sun(self, suns: Array, minutes: float) -> Array:
        """Unit vectors (..., 3) towards the sun some minutes later, further west if positive.

        The sun turns about the celestial pole by 15 degrees an hour (Duffie and Beckman, *Solar
        Engineering of Thermal Processes*, eq. 1.6.5). Its declination changes by 0.025 degrees at
        most in an hour and a half; this is neglected.
        """
        latitude = np.radians(self.latitude_deg)
        pole = [0.0, np.cos(latitude), np.sin(latitude)]
        return np.asarray(suns @ rotation(pole, -np.radians(_DEGREES_PER_MINUTE * minutes)).T)


JUELICH = Site(50.913, 6.388, 87.0)
"""Solar Tower Juelich: the site of synthetic fields, never a default of a plant."""
