"""Blocking: a neighbour in front hides the lower part of the mirror."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from model.effects.base import ByHeliostat, Effect, Stage, parameter, stacked
from model.plant import Heliostat
from model.tracing.scene import Scene


@dataclass(frozen=True, eq=False)
class Blocking(Effect):
    """The lowest ``lower_fraction`` of the mirror's height, counted along its y, sends no light to the target."""

    name: ClassVar[str] = "blocking"
    stage: ClassVar[Stage] = "geometry"

    lower_fraction: ByHeliostat = parameter(0.0, 0.0, 0.6, "1", "heliostat")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Raise the line below which mirrors are blocked."""
        # A mirror that is not named is cut half its height below its edge: nowhere.
        fraction = stacked(self.name, self.lower_fraction, heliostats, scene.control_points.new_tensor(-0.5))
        height = fraction.new_tensor([heliostat.height for heliostat in heliostats])
        line = (fraction - 0.5) * height
        before = scene.blocked_below
        return scene.with_(blocked_below=line if before is None else torch.maximum(before, line))
