"""Canting error: facets whose orientation differs from the known one.

What it is
    A heliostat's facets are screwed to its frame and canted so that their images overlap. Screws
    settle, frames twist, and a replaced facet was never measured. Each facet turns rigidly about
    its centre, which adds ``x_mrad`` to its slope along the mirror's x and ``y_mrad`` along its y.

Source
    Rigid rotation to first order (`model.surface.canted`); ways to measure canting are reviewed by
    Ren et al., *A review of available methods for the alignment of mirror facets of solar
    concentrator in solar thermal power system*, Renewable and Sustainable Energy Reviews 32 (2014).

In an image
    The image of a facet moves as a whole by twice the angle times the slant range. One misaligned
    facet makes a second spot or a bulge; several make the spot astigmatic or hollow. The image of a
    single facet keeps its shape.

What it scales with
    In proportion to the slant range. It is fixed in the mirror's frame, so the bulges turn on the
    target as the mirror rolls. It stays with the heliostat and is independent of elevation.

What it is confused with
    - A common tilt of all facets: invisible, because the alignment to the spot compensates it. Only
      differences are found.
    - Waviness: has structure within each facet.
    - Gravity bending: moves facets outwards and inwards by the same rule for all heliostats, and
      depends on elevation.
    - Blocking and soiling: remove light without moving the rest.
    - A wrong clock or tilted axis: rolls the whole image instead of splitting it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from model.effects.base import ByHeliostat, Effect, Factor, Stage, parameter, stacked
from model.plant import Heliostat
from model.surface import canted
from model.tracing.scene import Scene


@dataclass(frozen=True, eq=False)
class FacetCanting(Effect):
    """Adds ``x_mrad`` to each facet's slope along the mirror's x, and ``y_mrad`` along its y."""

    name: ClassVar[str] = "facet_canting"
    about: ClassVar[str] = "Canting error: facets that lean against the pose they are known in."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"distance", "heliostat", "roll"})
    of_heliostats: ClassVar[bool] = True
    prior_std: ClassVar[float] = 0.1
    relative: ClassVar[bool] = True  # the mount compensates the common part of a mirror's facets

    x_mrad: ByHeliostat = parameter(0.0, -5.0, 5.0, "mrad", "facet")
    y_mrad: ByHeliostat = parameter(0.0, -5.0, 5.0, "mrad", "facet")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Turn the facets about their centres."""
        flat = scene.control_points.new_zeros(scene.control_points.shape[1])
        tilt = [
            stacked(self.name, values, heliostats, flat) for values in (self.x_mrad, self.y_mrad)
        ]
        return scene.with_(
            control_points=canted(scene.control_points, 1e-3 * torch.stack(tilt, dim=-1))
        )
