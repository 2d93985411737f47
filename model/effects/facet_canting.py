"""Canting error: facets that lean against the pose they are known in."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from model.effects.base import ByHeliostat, Effect, Stage, parameter, stacked
from model.plant import Heliostat
from model.surface import canted
from model.tracing.scene import Scene


@dataclass(frozen=True, eq=False)
class FacetCanting(Effect):
    """Each facet's slope grows by ``x_mrad`` along the mirror's x and by ``y_mrad`` along its y [mrad]."""

    name: ClassVar[str] = "facet_canting"
    stage: ClassVar[Stage] = "geometry"

    x_mrad: ByHeliostat = parameter(0.0, -5.0, 5.0, "mrad", "facet")
    y_mrad: ByHeliostat = parameter(0.0, -5.0, 5.0, "mrad", "facet")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Turn the facets about their own centres."""
        flat = scene.control_points.new_zeros(scene.control_points.shape[1])
        tilt = [stacked(self.name, values, heliostats, flat) for values in (self.x_mrad, self.y_mrad)]
        return scene.with_(control_points=canted(scene.control_points, 1e-3 * torch.stack(tilt, dim=-1)))
