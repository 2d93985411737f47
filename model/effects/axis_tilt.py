"""Axis tilt: the foundation of the mount differs from the survey.

What it is
    Foundations settle and pylons lean. Both axes turn with the ground: about north by
    ``north_deg``, then about up by ``up_deg``, right-handed. If the first axis points east, a
    positive ``north_deg`` lowers its east end, and a positive ``up_deg`` turns that end towards
    north. A tilt about the first axis itself only shifts its zero.

Source
    Tilted axes in kinematic models: Baheti and Scott, *Design of self-calibrating controllers for
    heliostats in a solar power plant*, IEEE Transactions on Automatic Control 25 (1980); ARTIST's
    deviations ``first_joint_tilt_n`` and ``first_joint_tilt_u``.

In an image
    The mirror is aligned to the spot, so sun and target fix its normal for any axes. What remains
    of the tilt is a roll of the mirror about its normal, by about the size of the tilt. The image
    turns with it about the spot's centre.

What it scales with
    The roll is a function of the two axis angles. It grows as the normal comes near the first axis
    (low suns in east and west), and it is independent of distance. Round spots do not show it.

What it is confused with
    - Registration rotation: the same angle in every image, also without a tilt.
    - Wrong sun positions: roll the image too, and change the incidence. Compare morning with
      afternoon, where a clock error has the opposite sign.
    - Canting: changes the image in the mirror's frame.
    If the motor positions are known, a tilt of a degree moves the spot by metres, differently for
    each sun. This distinguishes it from a clock error, pylon bending and encoder offsets.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from model.effects.base import Effect, Factor, Stage, parameter
from model.mount import Mount, rotation


@dataclass(frozen=True, eq=False)
class AxisTilt(Effect):
    """The foundation turns about north by ``north_deg``, then about up by ``up_deg`` [deg].

    Both turns are right-handed.
    """

    name: ClassVar[str] = "axis_tilt"
    about: ClassVar[str] = "Axis tilt: the mount's foundation does not stand as surveyed."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"roll"})
    of_heliostats: ClassVar[bool] = True

    north_deg: float = parameter(0.0, -3.0, 3.0, "deg")
    up_deg: float = parameter(0.0, -3.0, 3.0, "deg")

    def on_mount(self, mount: Mount, heliostat: str) -> Mount:
        """Turn both axes and the mirror with them."""
        about_north = rotation([0.0, 1.0, 0.0], np.radians(float(self.north_deg)))
        about_up = rotation([0.0, 0.0, 1.0], np.radians(float(self.up_deg)))
        return mount.tilted(about_up @ about_north)
