"""Clock error: the sun stood elsewhere than the recorded time says."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from model.effects.base import Array, Effect, Stage, parameter
from model.mount import rotation

DEGREES_PER_MINUTE = 0.25


@dataclass(frozen=True, eq=False)
class SunPosition(Effect):
    """The sun stood where it is ``minutes`` [min] after the recorded time, further west where positive."""

    name: ClassVar[str] = "sun_position"
    stage: ClassVar[Stage] = "geometry"

    minutes: float = parameter(0.0, -90.0, 90.0, "min")

    def on_sun(self, suns: Array, latitude_deg: float) -> Array:
        """Turn suns (B, 3) about the celestial pole, from east to west."""
        latitude = np.radians(latitude_deg)
        pole = [0.0, np.cos(latitude), np.sin(latitude)]
        return np.asarray(suns @ rotation(pole, -np.radians(DEGREES_PER_MINUTE * float(self.minutes))).T)
