"""Clock error: the sun stood elsewhere than the recorded time says.

What it is
    A camera whose clock runs wrong, local time taken for universal time, or an exposure that was stamped when it was
    stored: the sun's position is computed for another minute than that of the image. Positive ``minutes`` mean that
    the sun really stood where it is that many minutes after the recorded time, further west; the recording clock was
    slow.

Source
    The sun turns about the celestial pole by 15 degrees an hour (Duffie and Beckman, *Solar Engineering of Thermal
    Processes*, eq. 1.6.5); in an hour and a half its declination changes by 0.025 degrees at most, which is left out.

In an image
    The heliostat is aligned by its spot, so the image stays in place. The mirror turns by half of the sun's way: the
    incidence changes, and with it astigmatism, the area seen by the sun, and the roll of the mirror about its normal.

What it scales with
    The sun's path, so it acts on all heliostats alike at one time, and in opposite senses on mirrors east and west of
    the tower; its sense of roll differs between morning and afternoon. It does not depend on the distance. A few
    minutes (a degree) are hardly visible in the shape; half an hour is.

What it is confused with
    - Axis tilt: belongs to a mount and does not follow the sun's path.
    - Canting and gravity: change astigmatism too, but stay with the mirror, or follow its elevation.
    Where the motors are known, a minute moves the spot by 4 mrad times the slant range, as far for all heliostats,
    along the image of the sun's path: spots tell a minute at once.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from model.effects.base import Array, Effect, Factor, Stage, parameter
from model.mount import rotation

DEGREES_PER_MINUTE = 0.25


@dataclass(frozen=True, eq=False)
class SunPosition(Effect):
    """The sun stood where it is ``minutes`` [min] after the recorded time, further west where positive."""

    name: ClassVar[str] = "sun_position"
    about: ClassVar[str] = "Clock error: the sun stood elsewhere than the recorded time says."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"roll", "side"})

    minutes: float = parameter(0.0, -90.0, 90.0, "min")

    def on_sun(self, suns: Array, latitude_deg: float) -> Array:
        """Turn suns (B, 3) about the celestial pole, from east to west."""
        latitude = np.radians(latitude_deg)
        pole = [0.0, np.cos(latitude), np.sin(latitude)]
        return np.asarray(suns @ rotation(pole, -np.radians(DEGREES_PER_MINUTE * float(self.minutes))).T)
