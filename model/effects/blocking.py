"""Blocking: a neighbour in front hides the lower part of the mirror.

What it is
    In dense fields light that the lower part of a mirror reflects strikes the back of the heliostat in front.
    ``lower_fraction`` of the mirror's height, counted from its lower edge along its y, is lost. The line is taken
    as straight and parallel to the mirror's edge, which it nearly is between neighbours of the same build.

Source
    Sassi, *Some notes on shadow and blockage effects*, Solar Energy 31 (1983); Lipps and Walzel, *An analytic
    evaluation of the flux density due to sunlight reflected from a flat mirror having a polygonal boundary*, Solar
    Energy 21 (1978). Cells of the surface that the line crosses are cut in proportion, so that the flux is continuous
    in the fraction.

In an image
    The lower facets' light is missing. Where the facets' images fall together, the spot is dimmer;
    where they do not, one side of it is cut off along a soft line and the centre of mass moves.

What it scales with
    It belongs to a heliostat and its neighbours: strong for far heliostats behind others, for low targets and low
    suns. Taken as one fraction for all images of a heliostat, it is a mean over the suns that were seen.

What it is confused with
    - Soiling of both lower facets: cuts whole facets, never parts of one, and not upper facets at all beyond one
      half.
    - Canting: keeps the energy.
    - A dim sun: normalised images cannot see the energy that is lost, only the shape.
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
    """The lowest ``lower_fraction`` of the mirror's height, counted along its y, sends no light to the target."""

    name: ClassVar[str] = "blocking"
    about: ClassVar[str] = "Blocking: a neighbour in front hides the lower part of the mirror."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"heliostat", "elevation"})
    of_heliostats: ClassVar[bool] = True

    lower_fraction: ByHeliostat = parameter(0.0, 0.0, 0.6, "1", "heliostat")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Raise the line below which mirrors are blocked."""
        # A mirror that is not named is cut half its height below its edge: nowhere.
        fraction = stacked(self.name, self.lower_fraction, heliostats, scene.control_points.new_tensor(-0.5))
        height = fraction.new_tensor([heliostat.height for heliostat in heliostats])
        line = (fraction - 0.5) * height
        before = scene.blocked_below
        return scene.with_(blocked_below=line if before is None else torch.maximum(before, line))
