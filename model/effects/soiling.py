"""Soiling: facets that reflect less than the best of their heliostat.

What it is
    Dust, bird droppings, corroded silver, a cracked facet. Each facet reflects ``reflectivity_ratio`` of what a clean
    one does, the same all over.

Source
    Picotti et al., *Soiling of solar collectors - Modelling approaches for airborne dust and its interactions with
    surfaces*, Renewable and Sustainable Energy Reviews 81 (2018). That a facet's share of the light scales with it is
    radiometry.

In an image
    The light of one facet is dimmer. Where the facets' images fall together, that only changes the spot's height;
    where they do not, with a heliostat that is near or out of focus, a quarter of the image is darker and the centre
    of mass moves away from it.

What it scales with
    Nothing: not the distance, not the sun. The darker part is fixed in the mirror's frame, and its shape on the
    target is that of the facet's own image. It changes over weeks, and at once by washing.

What it is confused with
    - Even soiling of all facets: invisible in images that are normalised, and in any image whose exposure is not
      known. Only ratios to the best facet are meant.
    - Blocking: always dims the mirror's lower edge, in part, and comes and goes with the sun and the aim.
    - Canting: moves a facet's light and takes none.
    - A gradient of the background: goes on where there is no light.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from model.effects.base import ByHeliostat, Effect, Factor, Stage, parameter, stacked
from model.plant import Heliostat
from model.tracing.scene import Scene


@dataclass(frozen=True, eq=False)
class Soiling(Effect):
    """Each facet reflects ``reflectivity_ratio`` of what a clean one does."""

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
