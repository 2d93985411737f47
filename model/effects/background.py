"""Background: light on the target, or counts in the camera, that the heliostat did not send.

What it is
    The target is lit by sky and sun, by other heliostats' stray light, and the camera adds its black level. What is
    left after an imperfect subtraction is a plane in shares of the image's peak::

        seen = light + peak * (level + gradient_x * x + gradient_y * y)

    with x to the right and y upwards of the image's centre, in metres on the target. The level is negative where too
    much was subtracted.

Source
    Radiometry; the subtraction of an image of the empty target, and what it leaves, in Roeger et al., *Techniques to
    measure solar flux density distribution on large-scale receivers*, J. Solar Energy Engineering 136 (2014).

In an image
    Corners that ought to be dark are grey, brighter to one side. Normalised to the same energy, the spot itself looks
    too dim.

What it scales with
    The ratio of daylight to the spot: strongest for far and for blocked heliostats, whose spots are faint. It follows
    the target and the hour, not the heliostat.

What it is confused with
    - The sun's aureole: falls off with the distance from the spot and grows with the slant range.
    - A gamma below one: lifts faint light, but leaves black black.
    - A spot that is cut off by the window: spill has the spot's shape.
    Images whose background the separation has taken out (`model.imaging`) show little of it.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class Background(Effect):
    """A plane is added to the image, in shares of its peak: ``level + gradient_x * x + gradient_y * y``.

    x counts to the right and y upwards of the image's centre, in metres: the same plane in any window.
    """

    name: ClassVar[str] = "background"
    about: ClassVar[str] = "Background: light on the target, or counts in the camera, that the heliostat did not send."
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"weather", "camera"})
    comes: ClassVar[frozenset[Arrival]] = frozenset({"since", "day"})

    level: Scalar = parameter(0.0, -0.2, 0.5, "1", "camera")
    gradient_x: Scalar = parameter(0.0, -0.1, 0.1, "1/m", "camera")
    gradient_y: Scalar = parameter(0.0, -0.1, 0.1, "1/m", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Add the plane."""
        peak = images.amax(dim=(-2, -1), keepdim=True)
        x, y = _centers(images.shape[-1], window.width, images), _centers(images.shape[-2], window.height, images)
        return images + peak * (self.level + self.gradient_x * x - self.gradient_y * y[:, None])


def _centers(size: int, extent: float, like: Tensor) -> Tensor:
    """Centres (size,) [m] of pixels off the middle of ``extent`` [m]; rows count downwards."""
    return extent * ((torch.arange(size, dtype=like.dtype, device=like.device) + 0.5) / size - 0.5)
