"""Axis tilt: the mount's foundation does not stand as surveyed."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from model.effects.base import Effect, Stage, parameter
from model.mount import Mount, rotation


@dataclass(frozen=True, eq=False)
class AxisTilt(Effect):
    """The foundation is turned about north by ``north_deg``, then about up by ``up_deg`` [deg], right-handed."""

    name: ClassVar[str] = "axis_tilt"
    stage: ClassVar[Stage] = "geometry"

    north_deg: float = parameter(0.0, -3.0, 3.0, "deg")
    up_deg: float = parameter(0.0, -3.0, 3.0, "deg")

    def on_mount(self, mount: Mount) -> Mount:
        """Turn both axes and the mirror with them."""
        about_north = rotation([0.0, 1.0, 0.0], np.radians(float(self.north_deg)))
        about_up = rotation([0.0, 0.0, 1.0], np.radians(float(self.up_deg)))
        return mount.tilted(about_up @ about_north)
