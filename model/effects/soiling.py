"""Soiling: facets that reflect less than the best one of their heliostat.

What it is
    Causes are dust, bird droppings, corroded silver or a cracked facet. Each facet reflects
    ``reflectivity_ratio`` of the light that a clean one reflects, uniformly.

Source
    Picotti et al., *Soiling of solar collectors - Modelling approaches for airborne dust and its
    interactions with surfaces*, Renewable and Sustainable Energy Reviews 81 (2018). By radiometry,
    a facet's light is proportional to its reflectivity.

In an image
    The light of one facet is dimmer. If the facets' images overlap, only the spot's peak changes.
    If they do not, as for a heliostat that is near or out of focus, the facet's part of the image
    is darker, and the centroid moves away from it.

What it scales with
    Nothing, neither distance nor sun. The darker part is fixed in the mirror's frame, and has the
    shape of the facet's image on the target. It changes over weeks, and at once by washing.

What it is confused with
    - Uniform soiling of all facets: invisible in normalised images, and in any image of unknown
      exposure. The ratios are relative to the best facet.
    - Blocking: always dims the mirror's lower edge, in part, and changes with the sun and the aim.
    - Canting: moves a facet's light and keeps its energy.
    - A gradient of the background: continues outside of the spot.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from model.effects.base import ByHeliostat, Effect, Factor, Stage, parameter, stacked
from model.plant import Heliostat
from model.tracing.scene import Scene


@dataclass(frozen=True, eq=False)
class Soiling(Effect):
    """Each facet reflects ``reflectivity_ratio`` of the light that a clean one reflects."""

    name: ClassVar[str] = "soiling"
    about: ClassVar[str] = "Soiling: facets that reflect less than the best of their heliostat."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"heliostat"})
    of_heliostats: ClassVar[bool] = True

    reflectivity_ratio: ByHeliostat = parameter(1.0, 0.0, 1.0, "1", "facet")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Multiply the facets' reflectivities."""
        clean = scene.control_points.new_ones(scene.control_points.shape[1])
        ratio = stacked(self.name, self.reflectivity_ratio, heliostats, clean)
        before = scene.facet_reflectivity
        return scene.with_(facet_reflectivity=ratio if before is None else before * ratio)
