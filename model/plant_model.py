"""The model of a plant: what forecasts need to know besides heliostats, surfaces and suns."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Self

from model.effects import Effect
from model.imaging.light import Camera
from model.site import JUELICH, Site
from model.tracing import Optics


@dataclass(frozen=True, eq=False)
class PlantModel:
    """The model that forecasts and predictions are computed with.

    Attributes
    ----------
    site : Site
    optics : Optics
        As declared, without the effects on optics.
    effects : tuple of Effect
        Declared and adopted ones.
    cameras : tuple of Camera
    """

    site: Site
    optics: Optics = field(default_factory=Optics)
    effects: tuple[Effect, ...] = ()
    cameras: tuple[Camera, ...] = ()

    def with_effects(self, effects: Iterable[Effect]) -> Self:
        """The model with more effects."""
        return replace(self, effects=(*self.effects, *effects))

    def with_dni(self, dni: float) -> Self:
        """The model under another direct normal irradiance [W/m2]."""
        return replace(self, optics=replace(self.optics, dni=dni))


JUELICH_MODEL = PlantModel(JUELICH)
"""Model of synthetic fields: the site of the Solar Tower Juelich, default optics, no effects."""
