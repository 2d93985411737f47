"""Camera response: counts that do not grow in proportion to the light."""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from model.effects.base import Effect, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class CameraResponse(Effect):
    """Light is cut at ``saturation`` of the peak, then raised to the power ``gamma``."""

    name: ClassVar[str] = "camera_response"
    stage: ClassVar[Stage] = "image"

    gamma: Scalar = parameter(1.0, 0.3, 3.0, "1", "camera")
    saturation: Scalar = parameter(1.0, 0.3, 1.0, "1", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Peak * min(image / peak, saturation)**gamma; what lies below zero counts as dark."""
        peak = images.amax(dim=(-2, -1), keepdim=True).clamp(min=1e-30)
        # The tiny share keeps the power's gradient finite where it is dark.
        share = (images / peak).clamp(min=1e-12)
        return peak * (share - (share - self.saturation).clamp(min=0)) ** self.gamma
