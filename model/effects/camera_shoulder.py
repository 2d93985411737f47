"""Camera shoulder: counts that grow less and less with more light, long before saturation.

What it is
    Causes are a sensor with filling wells, the knee of a camera with wide dynamic range, or film.
    Each further share of light adds less than the one before. Light is relative to the image's
    peak::

        seen = peak * (1 - exp(-compression * light / peak)) / (1 - exp(-compression))

    Faint light stays proportional, with a slope of compression / (1 - exp(-compression)). At the
    peak the slope is exp(-compression) times that. Without compression, the camera is linear.

Source
    The shoulder of the characteristic curve of Hurter and Driffield, *Photochemical
    investigations*, J. Soc. Chemical Industry 9 (1890), and of every response that Debevec and
    Malik, *Recovering high dynamic range radiance maps from photographs*, SIGGRAPH 1997, measured.
    The effect is in the catalogue because photographs of the real plant need it (RESULTS.md). With
    one number it forecasts held-out images better than gamma and saturation.

In an image
    Contours keep their positions. Cores are flatter and flanks brighter than they should be,
    without a plateau. The residual has one sign in the core and the other in a ring around it, and
    is zero further out.

What it scales with
    Nothing of the plant: the same for all heliostats, distances and suns of one camera with one
    exposure.

What it is confused with
    - Camera response: a gamma below one raises the faintest light most, with an infinite slope at
      zero, and saturation ends in a plateau with a sharp rim. A shoulder does neither. A scatter
      plot of measured against forecast brightness, pixel by pixel, distinguishes them.
    - Sun shape, slope error, blur: widen spots too, but smooth contours instead of keeping them.
    - Facets canted outwards: flatten the core as well, differently for each heliostat and distance.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window

LEAST = 1e-3
"""Least compression for the exact formula, which becomes 0 / 0.

Below it, the curve is straight to a part in two thousand.
"""


@dataclass(frozen=True, eq=False)
class CameraShoulder(Effect):
    """Compresses light by 1 - exp(-``compression`` * light / peak); the peak stays the same."""

    name: ClassVar[str] = "camera_shoulder"
    about: ClassVar[str] = (
        "Camera shoulder: counts that grow ever less the more light there is, long before the"
        " sensor's end."
    )
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"camera"})
    comes: ClassVar[frozenset[Arrival]] = frozenset({"since", "day"})

    compression: Scalar = parameter(0.0, 0.0, 5.0, "1", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Compress positive light; negative values count as dark."""
        compression = torch.as_tensor(self.compression, dtype=images.dtype, device=images.device)
        peak = images.amax(dim=(-2, -1), keepdim=True).clamp(min=1e-30)
        share = (images / peak).clamp(min=0)
        # A parabola replaces the curve if numerator and denominator vanish.
        steep = compression.clamp(min=LEAST)
        curve = torch.expm1(-steep * share) / torch.expm1(-steep)
        nearly_straight = share + compression / 2 * share * (1 - share)
        return peak * torch.where(compression < LEAST, nearly_straight, curve)
