"""Background: light on the target or counts in the camera from other sources than the heliostat.

What it is
    Sky and sun and stray light from other heliostats illuminate the target, and the camera adds its
    black level. An imperfect subtraction leaves a plane, relative to the image's peak::

        seen = light + peak * (level + gradient_x * x + gradient_y * y)

    with x to the right and y upwards from the image's centre, in metres on the target. The level is
    negative if too much was subtracted.

Source
    Radiometry; the subtraction of an image of the empty target, and its residual, in Roeger et al.,
    *Techniques to measure solar flux density distribution on large-scale receivers*, J. Solar
    Energy Engineering 136 (2014).

In an image
    Corners that should be dark are gray, and brighter on one side. After normalisation to the same
    energy, the spot itself looks too dim.

What it scales with
    The ratio of daylight to the spot. It is strongest for far and for blocked heliostats, whose
    spots are faint. It depends on the target and the hour, not on the heliostat.

What it is confused with
    - The sun's aureole: decreases with the distance from the spot and grows with the slant range.
    - A gamma below one: raises faint light, but leaves black black.
    - A spot that is truncated by the window: spillage has the spot's shape.
    Images whose background was separated (`model.imaging`) show little of it.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class Background(Effect):
    """Adds a plane to the image, relative to its peak.

    The plane is ``level + gradient_x * x + gradient_y * y``, with x to the right and y upwards from
    the image's centre, in metres. It is the same plane in any window.
    """

    name: ClassVar[str] = "background"
    about: ClassVar[str] = (
        "Background: light on the target, or counts in the camera, that the heliostat did not send."
    )
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"weather", "camera"})
    comes: ClassVar[frozenset[Arrival]] = frozenset({"since", "day"})

    level: Scalar = parameter(0.0, -0.2, 0.5, "1", "camera")
    gradient_x: Scalar = parameter(0.0, -0.1, 0.1, "1/m", "camera")
    gradient_y: Scalar = parameter(0.0, -0.1, 0.1, "1/m", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Add the plane."""
        peak = images.amax(dim=(-2, -1), keepdim=True)
        x, y = (
            _centers(images.shape[-1], window.width, images),
            _centers(images.shape[-2], window.height, images),
        )
        return images + peak * (self.level + self.gradient_x * x - self.gradient_y * y[:, None])


def _centers(size: int, extent: float, like: Tensor) -> Tensor:
    """Pixel centres (size,) [m], relative to the centre of ``extent`` [m]; rows count downwards."""
    return extent * ((torch.arange(size, dtype=like.dtype, device=like.device) + 0.5) / size - 0.5)
