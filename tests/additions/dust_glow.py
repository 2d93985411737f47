"""Dust before the target that glows as bright as the spot's peak allows."""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from model.effects.base import Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class DustGlow(Effect):
    """``share`` of the peak is added everywhere."""

    name: ClassVar[str] = "dust_glow"
    about: ClassVar[str] = "Dust before the target that glows as bright as the spot's peak allows."
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"weather"})

    share: Scalar = parameter(0.0, 0.0, 0.5, "1", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        return images + self.share * images.amax(dim=(-2, -1), keepdim=True)
