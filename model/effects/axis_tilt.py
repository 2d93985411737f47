"""Axis tilt: the mount's foundation does not stand as surveyed.

What it is
    Foundations settle and pylons lean. Both axes are turned with the ground, about north by ``north_deg``, then about
    up by ``up_deg``, right-handed: for a first axis that points east, a positive ``north_deg`` lowers its east end
    and a positive ``up_deg`` turns that end towards the north. A tilt about the first axis itself only shifts its
    zero.

Source
    Tilted axes in kinematic models: Baheti and Scott, *Design of self-calibrating controllers for heliostats in a
    solar power plant*, IEEE Transactions on Automatic Control 25 (1980); ARTIST's deviations ``first_joint_tilt_n``
    and ``first_joint_tilt_u``.

In an image
    With the spot brought back to its place the normal is where sun and target demand it, whatever the axes do. What
    is left of the tilt is that the mirror is rolled about its normal, by up to the tilt's size or a little more, and
    its image with it: a turn about the spot's middle.

What it scales with
    The roll is a function of the two axis angles: it grows as the normal comes near the first axis (low suns in east
    and west) and does not depend on distance. Round spots do not show it.

What it is confused with
    - Registration rotation: the same angle in every image, also in those of a mirror that stands square.
    - Wrong sun positions: roll the image too, and change the incidence; compare morning with afternoon, where a clock
      error changes its sense.
    - Canting: changes the image in the mirror's own frame.
    Where the motors are known, a tilt of a degree moves the spot by metres, by another way under each sun, which tells
    it from a clock, a pylon that leans and encoders that are off.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from model.effects.base import Effect, Factor, Stage, parameter
from model.mount import Mount, rotation


@dataclass(frozen=True, eq=False)
class AxisTilt(Effect):
    """The foundation is turned about north by ``north_deg``, then about up by ``up_deg`` [deg], right-handed."""

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
