"""Axis tilt: the foundation of the mount differs from the survey.

What it is
    Foundations settle and pylons lean. Both axes turn with the ground: about east by
    ``east_deg``, then about north by ``north_deg``, then about up by ``up_deg``, right-handed. If
    the first axis points east, a positive ``north_deg`` lowers its east end, and a positive
    ``up_deg`` turns that end towards north. If the first axis is vertical, a positive ``north_deg``
    leans it to the east, and a positive ``east_deg`` leans it to the south. A tilt about the first
    axis itself only shifts its zero, as `encoder_offset` does, so studies do not fit it.

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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from model.effects.base import Effect, Factor, Stage, parameter
from model.mirror_kind import first_axis_of
from model.mount import Mount, rotation

# The tilt that only shifts the first axis' zero, by where that axis points.
_ABOUT_FIRST_AXIS = {"east": "east_deg", "vertical": "up_deg"}


@dataclass(frozen=True, eq=False)
class AxisTilt(Effect):
    """The foundation turns by ``east_deg``, then ``north_deg``, then ``up_deg`` [deg].

    Each turn is right-handed, about the axis of its name.
    """

    name: ClassVar[str] = "axis_tilt"
    about: ClassVar[str] = "Axis tilt: the mount's foundation does not stand as surveyed."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"roll"})
    of_heliostats: ClassVar[bool] = True

    north_deg: float = parameter(0.0, -3.0, 3.0, "deg")
    up_deg: float = parameter(0.0, -3.0, 3.0, "deg")
    east_deg: float = parameter(0.0, -3.0, 3.0, "deg")

    @classmethod
    def unseen(cls, mounts: Sequence[Mount]) -> frozenset[str]:
        """The tilt about the first axis, if that axis points alike on all mounts."""
        names = {_ABOUT_FIRST_AXIS.get(first_axis_of(mount)) for mount in mounts}
        return frozenset(name for name in names if name is not None and len(names) == 1)

    def on_mount(self, mount: Mount, heliostat: str) -> Mount:
        """Turn both axes and the mirror with them."""
        about_east = rotation([1.0, 0.0, 0.0], np.radians(float(self.east_deg)))
        about_north = rotation([0.0, 1.0, 0.0], np.radians(float(self.north_deg)))
        about_up = rotation([0.0, 0.0, 1.0], np.radians(float(self.up_deg)))
        return mount.tilted(about_up @ about_north @ about_east)
