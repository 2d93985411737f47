"""Known neighbours: mirrors of the layout shade and block, as computed from where they stand.

What it is
    While one heliostat is photographed, its neighbours light the receiver. They stand between it
    and the sun, or between it and its target. Where they stand, and so what they hide, follows from
    the layout, the sun and their aims; nothing of it is fitted. ``share`` is the share of the light
    on them that they take: 1 if they stand as in operation, 0 if they are stowed or clear of it,
    in between if some are.

Source
    The outlines of `model.neighbours`: ray casting as in SolTrace; bounding spheres to exclude
    others as in Collado and Guallar, *Campo: Generation of regular heliostat fields*, Renewable
    Energy 46 (2012).

In an image
    Parts of the mirror send no light, others in each photograph. The spot loses one side, or it is
    dimmer, where the facets' images overlap.

What it scales with
    Low suns and dense rows hide much, high suns and the field's edge nothing. It needs a stored
    layout, and does nothing on a heliostat without neighbours.

What it is confused with
    - Blocking: one line across the mirror for all suns. Use it where the neighbours' positions are
      not known.
    - Soiling: the same facets at all suns.
    - A neighbour that was stowed: hides nothing, although the layout says so. Then ``share`` is
      small, and the effect is not found.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from model.effects.base import Effect, Factor, Scalar, Stage, parameter
from model.plant import Heliostat
from model.tracing.scene import Scene


@dataclass(frozen=True, eq=False)
class KnownNeighbours(Effect):
    """Neighbours take ``share`` of the light that they would hide in operation."""

    name: ClassVar[str] = "known_neighbours"
    about: ClassVar[str] = (
        "Known neighbours: mirrors of the layout shade and block, as in operation."
    )
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"elevation", "heliostat", "side"})
    of_heliostats: ClassVar[bool] = True
    needs_neighbours: ClassVar[bool] = True

    share: Scalar = parameter(0.0, 0.0, 1.0, "1")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Put the neighbours in the light's way."""
        if scene.neighbours is None:
            return scene
        share = torch.as_tensor(self.share).to(scene.sun).expand(scene.batch)
        return scene.with_(obstacles=scene.neighbours, obstacle_share=share)
