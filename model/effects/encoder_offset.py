"""Encoder offset: the angles of a heliostat's axes differ from its motor positions.

What it is
    A drive lost steps, was referenced again, or its encoder was changed. From then on the axis
    angle differs from that of the motor position by a constant. Each heliostat has two offsets.

Source
    Offsets of the axes in kinematic models: Baheti and Scott, *Design of self-calibrating
    controllers for heliostats in a solar power plant*, IEEE Transactions on Automatic Control 25
    (1980); PAINT's ``initial_angle`` of an actuator.

In an image
    Nothing: the mirror is aligned to the spot, so its axes are at the right angles.

What it scales with
    The spot moves up or down by twice the first offset times the slant range. It moves sideways by
    up to twice the second offset times the slant range, and less if the second axis leans towards
    the normal.

What it is confused with
    - Axis tilt about up: the same if the second axis is vertical. It is the same for all
      heliostats, and the second axis leans as the first one turns.
    - Pylon bending: similar to the first drive's offset, but smaller for high suns, and the same
      for all heliostats.
    - Calibrated mounts include the offsets of their time in their zeros: only later offsets are
      missing in them.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from model.effects.base import ByHeliostat, Effect, Factor, Stage, parameter
from model.mount import Mount


@dataclass(frozen=True, eq=False)
class EncoderOffset(Effect):
    """Axis angles are larger by ``first_deg`` and ``second_deg`` [deg] than the motors show."""

    name: ClassVar[str] = "encoder_offset"
    about: ClassVar[str] = "Encoder offset: a heliostat's axes stand elsewhere than its motors say."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"heliostat", "roll"})
    of_heliostats: ClassVar[bool] = True
    only_moves: ClassVar[bool] = True

    first_deg: ByHeliostat = parameter(0.0, -6.0, 6.0, "deg", "heliostat")
    second_deg: ByHeliostat = parameter(0.0, -6.0, 6.0, "deg", "heliostat")

    def on_mount(self, mount: Mount, heliostat: str) -> Mount:
        """Add the offsets to the zeros of the axes."""
        offsets = (
            float(by_name.get(heliostat, 0.0)) for by_name in (self.first_deg, self.second_deg)
        )
        first, second = (
            zero + np.radians(offset) for zero, offset in zip(mount.axis_zero, offsets, strict=True)
        )
        return replace(mount, axis_zero=(float(first), float(second)))
