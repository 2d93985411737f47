"""Background: light on the target, or counts in the camera, that the heliostat did not send."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.effects.base import Effect, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class Background(Effect):
    """A plane is added to the image, in shares of its peak: ``level + gradient_x * x + gradient_y * y``.

    x counts to the right and y upwards, from -1 to 1 over the image.
    """

    name: ClassVar[str] = "background"
    stage: ClassVar[Stage] = "image"

    level: Scalar = parameter(0.0, -0.2, 0.5, "1", "camera")
    gradient_x: Scalar = parameter(0.0, -0.3, 0.3, "1", "camera")
    gradient_y: Scalar = parameter(0.0, -0.3, 0.3, "1", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Add the plane."""
        peak = images.amax(dim=(-2, -1), keepdim=True)
        x, y = (_centers(size, images) for size in (images.shape[-1], images.shape[-2]))
        return images + peak * (self.level + self.gradient_x * x - self.gradient_y * y[:, None])


def _centers(size: int, like: Tensor) -> Tensor:
    """Centres (size,) of pixels on [-1, 1]; rows count downwards."""
    return (2 * torch.arange(size, dtype=like.dtype, device=like.device) + 1) / size - 1
