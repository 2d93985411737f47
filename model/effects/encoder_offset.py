"""Encoder offset: a heliostat's axes stand elsewhere than its motors say.

What it is
    A drive lost steps, was referenced anew, or its encoder was changed: from then on the axis stands an angle beside
    what its position says, the same wherever it stands. Each heliostat has two of its own.

Source
    Offsets of the axes in kinematic models: Baheti and Scott, *Design of self-calibrating controllers for heliostats in
    a solar power plant*, IEEE Transactions on Automatic Control 25 (1980); PAINT's ``initial_angle`` of an actuator.

In an image
    Nothing: the spot brought back to its place, the axes stand where they have to.

What it scales with
    The spot moves by twice the first offset times the slant range upwards or down, and sidewards by up to twice the
    second, less the farther the second axis leans towards the normal.

What it is confused with
    - Axis tilt about up: for a second axis that stands upright the same; it is every heliostat's alike, and the second
      axis leans as the first one turns.
    - Pylon bending: as the first drive's, but less under high suns, and alike for all.
    - Calibrated mounts have the offsets of their time in their zeros: only what came later is missing in them.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from model.effects.base import ByHeliostat, Effect, Factor, Stage, parameter
from model.mount import Mount


@dataclass(frozen=True, eq=False)
class EncoderOffset(Effect):
    """A heliostat's axes stand at ``first_deg`` and ``second_deg`` [deg] more than their motors say."""

    name: ClassVar[str] = "encoder_offset"
    about: ClassVar[str] = "Encoder offset: a heliostat's axes stand elsewhere than its motors say."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"heliostat", "roll"})
    of_heliostats: ClassVar[bool] = True
    only_moves: ClassVar[bool] = True

    first_deg: ByHeliostat = parameter(0.0, -6.0, 6.0, "deg", "heliostat")
    second_deg: ByHeliostat = parameter(0.0, -6.0, 6.0, "deg", "heliostat")

    def on_mount(self, mount: Mount, heliostat: str) -> Mount:
        """Add to what the motors' angles are counted from."""
        offsets = (float(by_name.get(heliostat, 0.0)) for by_name in (self.first_deg, self.second_deg))
        first, second = (zero + np.radians(offset) for zero, offset in zip(mount.axis_zero, offsets, strict=True))
        return replace(mount, axis_zero=(float(first), float(second)))
