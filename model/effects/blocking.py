"""Blocking: a neighbour in front hides the lower part of the mirror.

What it is
    In dense fields, light from the lower part of a mirror strikes the back of the heliostat in
    front. ``lower_fraction`` of the mirror's height, from its lower edge along its y, is lost. The
    line is assumed to be straight and parallel to the mirror's edge. Between neighbours of the same
    type this is nearly true.

Source
    Sassi, *Some notes on shadow and blockage effects*, Solar Energy 31 (1983); Lipps and Walzel,
    *An analytic evaluation of the flux density due to sunlight reflected from a flat mirror having
    a polygonal boundary*, Solar Energy 21 (1978). Cells of the surface on the line count in
    proportion, so that the flux is continuous in the fraction.

In an image
    The lower facets' light is missing. If the facets' images overlap, the spot is dimmer. If they
    do not, one side of the spot is missing along a soft line, and the centroid moves.

What it scales with
    It depends on a heliostat and its neighbours. It is strong for far heliostats behind others, for
    low targets and low suns. One fraction for all images of a heliostat is a mean over their suns.

What it is confused with
    - Soiling of both lower facets: dims whole facets, never parts of one, and never upper facets,
      which blocking of more than one half does.
    - Canting: keeps the energy.
    - A dim sun: normalised images do not show lost energy, only the shape.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from model.effects.base import ByHeliostat, Effect, Factor, Stage, parameter, stacked
from model.plant import Heliostat
from model.tracing.scene import Scene


@dataclass(frozen=True, eq=False)
class Blocking(Effect):
    """The lowest ``lower_fraction`` of the mirror's height, along its y, sends no light."""

    name: ClassVar[str] = "blocking"
    about: ClassVar[str] = "Blocking: a neighbour in front hides the lower part of the mirror."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"heliostat", "elevation"})
    of_heliostats: ClassVar[bool] = True

    lower_fraction: ByHeliostat = parameter(0.0, 0.0, 0.6, "1", "heliostat")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Raise the line below which mirrors are blocked."""
        # For a missing name, the line is half a height below the lower edge, so nothing is blocked.
        fraction = stacked(
            self.name, self.lower_fraction, heliostats, scene.control_points.new_tensor(-0.5)
        )
        height = fraction.new_tensor([heliostat.height for heliostat in heliostats])
        line = (fraction - 0.5) * height
        before = scene.blocked_below
        return scene.with_(blocked_below=line if before is None else torch.maximum(before, line))
