"""Clock error: the sun's position differs from that of the recorded time.

What it is
    A camera's clock is wrong, local time was taken for universal time, or a photograph got the time
    of its storage. The sun's position is then computed for another minute than that of the image.
    Positive ``minutes`` mean that the true sun was further west, at its position so many minutes
    after the recorded time; the recording clock was slow.

Source
    The sun turns about the celestial pole by 15 degrees an hour (Duffie and Beckman, *Solar
    Engineering of Thermal Processes*, eq. 1.6.5). In an hour and a half its declination changes by
    at most 0.025 degrees, which is neglected.

In an image
    The heliostat is aligned to its spot, so the image stays in place. The mirror turns by half of
    the sun's angle. This changes the incidence, and with it the astigmatism, the projected area,
    and the roll of the mirror about its normal.

What it scales with
    The sun's path, so it acts on all heliostats in the same way at one time, and with opposite
    signs on mirrors east and west of the tower. The sign of its roll differs between morning and
    afternoon. It is independent of distance. A few minutes (a degree) are hardly visible in the
    shape; half an hour is.

What it is confused with
    - Axis tilt: belongs to a mount and does not follow the sun's path.
    - Canting and gravity: change astigmatism too, but stay with the mirror, or follow its
      elevation.
    If the motor positions are known, a minute moves the spot by 4 mrad times the slant range. This
    is the same for all heliostats, along the image of the sun's path, so spots show a minute
    immediately.
"""

from dataclasses import dataclass
from typing import ClassVar

from model.effects.base import Array, Effect, Factor, Stage, parameter
from model.site import Site


@dataclass(frozen=True, eq=False)
class SunPosition(Effect):
    """The sun's true position is that of ``minutes`` [min] after the recorded time.

    Positive values are further west.
    """

    name: ClassVar[str] = "sun_position"
    about: ClassVar[str] = "Clock error: the recorded time is wrong, so the sun was elsewhere."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"roll", "side"})

    minutes: float = parameter(0.0, -90.0, 90.0, "min")

    def on_sun(self, suns: Array, site: Site) -> Array:
        """Turn suns (B, 3) about the celestial pole, from east to west."""
        return site.advance_sun(suns, float(self.minutes))
