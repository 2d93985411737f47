"""Soiling: facets that reflect less than the best of their heliostat."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from model.effects.base import ByHeliostat, Effect, Stage, parameter, stacked
from model.plant import Heliostat
from model.tracing.scene import Scene


@dataclass(frozen=True, eq=False)
class Soiling(Effect):
    """Each facet reflects ``reflectivity_ratio`` of what a clean one does."""

    name: ClassVar[str] = "soiling"
    stage: ClassVar[Stage] = "geometry"

    reflectivity_ratio: ByHeliostat = parameter(1.0, 0.0, 1.0, "1", "facet")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Multiply the facets' reflectivities."""
        clean = scene.control_points.new_ones(scene.control_points.shape[1])
        ratio = stacked(self.name, self.reflectivity_ratio, heliostats, clean)
        before = scene.facet_reflectivity
        return scene.with_(facet_reflectivity=ratio if before is None else before * ratio)
