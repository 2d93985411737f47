"""Sun shape: haze that spreads the sun's light into an aureole."""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Effect, Scalar, Stage, parameter
from model.sunshape import Buie
from model.tracing.scene import Optics


@dataclass(frozen=True, eq=False)
class SunShapeEffect(Effect):
    """The sun has Buie's shape with ``circumsolar_ratio``, whatever shape was declared.

    Neutral at the default sun's 0.02.
    """

    name: ClassVar[str] = "sun_shape"
    stage: ClassVar[Stage] = "optics"

    circumsolar_ratio: Scalar = parameter(0.02, 0.0, 0.5, "1")

    def on_optics(self, optics: Optics) -> Optics:
        """Replace the sun."""
        return replace(optics, sun_shape=Buie(self.circumsolar_ratio))
