"""Camera shoulder: counts that grow ever less the more light there is, long before the sensor's end.

What it is
    A sensor whose sites fill up, the knee of a camera of wide dynamic range, film: each further share of light adds
    less than the one before. Light is taken relative to the image's peak::

        seen = peak * (1 - exp(-compression * light / peak)) / (1 - exp(-compression))

    Faint light stays in proportion, with a slope of compression / (1 - exp(-compression)); at the peak the slope is
    exp(-compression) of that. No compression is a camera that counts photons.

Source
    The shoulder of the characteristic curve of Hurter and Driffield, *Photochemical investigations*, J. Soc. Chemical
    Industry 9 (1890), and of every response that Debevec and Malik, *Recovering high dynamic range radiance maps from
    photographs*, SIGGRAPH 1997, measured. It was put into the catalogue because the photographs of the real plant
    demand it (RESULTS.md): one number forecasts images that were left out better than gamma and saturation do.

In an image
    Contours keep their places; cores are flatter and flanks brighter than they should be, without a plateau. The
    residual is one of sign in the core and the other in a ring about it, and nothing farther out.

What it scales with
    Nothing of the plant: the same for all heliostats, distances and suns that one camera sees with one exposure.

What it is confused with
    - Camera response: a gamma below one lifts the faintest light most, without bound as light vanishes, and a
      saturation ends in a plateau with a sharp rim; a shoulder does neither. A scatter of measured against forecast
      brightness, pixel by pixel, tells them.
    - Sun shape, slope error, blur: make spots fat, too, but smooth contours instead of keeping them.
    - Facets canted outwards: flatten the core as well, differently for each heliostat and distance.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window

LEAST = 1e-3
"""Compression below which the curve is straight to a part in two thousand, and its formula zero over zero."""


@dataclass(frozen=True, eq=False)
class CameraShoulder(Effect):
    """Light is compressed by 1 - exp(-``compression`` * light / peak), the peak kept."""

    name: ClassVar[str] = "camera_shoulder"
    about: ClassVar[str] = (
        "Camera shoulder: counts that grow ever less the more light there is, long before the sensor's end."
    )
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"camera"})
    comes: ClassVar[frozenset[Arrival]] = frozenset({"since", "day"})

    compression: Scalar = parameter(0.0, 0.0, 5.0, "1", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Compress light above zero; what lies below zero counts as dark."""
        compression = torch.as_tensor(self.compression, dtype=images.dtype, device=images.device)
        peak = images.amax(dim=(-2, -1), keepdim=True).clamp(min=1e-30)
        share = (images / peak).clamp(min=0)
        # A parabola stands for the curve where both parts of the fraction vanish.
        steep = compression.clamp(min=LEAST)
        curve = torch.expm1(-steep * share) / torch.expm1(-steep)
        nearly_straight = share + compression / 2 * share * (1 - share)
        return peak * torch.where(compression < LEAST, nearly_straight, curve)
