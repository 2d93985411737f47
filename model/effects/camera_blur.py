"""Camera blur: a defocused lens or shimmering air.

What it is
    Defocus, aberrations, the roughness of the target's paint, hot air between tower and camera, and
    the resampling of a rectified image blur it. The blur is a Gaussian of ``sigma_m`` on the
    target, the same in all directions.

Source
    The point spread function and its transfer function, as in Goodman, *Introduction to Fourier
    Optics*. Many small causes give a Gaussian by the central limit theorem. For targets of solar
    towers: Roeger et al., *Techniques to measure solar flux density distribution on large-scale
    receivers*, J. Solar Energy Engineering 136 (2014).

In an image
    All detail is smoothed, including the target's printed marks and edges. The spot's variance
    grows by sigma squared in each direction. Its energy and position stay the same.

What it scales with
    Nothing of the heliostat. It is the same in metres for near and far ones, for any sun and
    incidence, and for all images of a camera on one target.

What it is confused with
    - Slope error, sun shape, jitter: grow in proportion to the slant range. Images of heliostats at
      several distances distinguish them, images at a single distance do not.
    - A response with gamma below one: widens spots without smoothing fine detail.

The image is mirrored at its edges, as a substitute for the light beyond them; so no light is lost.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Tensor

from model.effects.base import Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class CameraBlur(Effect):
    """Blurs the image by a Gaussian of standard deviation ``sigma_m`` [m on the target]."""

    name: ClassVar[str] = "camera_blur"
    about: ClassVar[str] = "Camera blur: a lens out of focus, air that shimmers."
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"camera"})

    sigma_m: Scalar = parameter(0.0, 0.0, 0.5, "m", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Blur along rows and columns.

        Light is mirrored at the window's edges, so that none is lost.
        """
        pixel_x, pixel_y = window.pixel
        across = _blur(images.shape[-1], pixel_x, self.sigma_m, images)
        down = _blur(images.shape[-2], pixel_y, self.sigma_m, images)
        return down @ images @ across.T


def _blur(size: int, pixel: float, sigma: Scalar, like: Tensor) -> Tensor:
    """Gaussian blur of a line of pixels, as a matrix (size, size).

    The matrix is diagonal in the cosine transform, which mirrors at the edges.
    """
    cosines = _cosines(size, like.dtype, like.device)
    frequency = torch.arange(size, dtype=like.dtype, device=like.device) / (2 * size * pixel)
    transfer = torch.exp(-2 * math.pi**2 * sigma**2 * frequency**2)
    return (cosines.T * transfer) @ cosines


@lru_cache(maxsize=16)
def _cosines(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The orthonormal discrete cosine transform of type II (size, size), frequency first."""
    index = torch.arange(size, dtype=torch.float64)
    table = torch.cos(math.pi * index[:, None] * (index + 0.5) / size) * math.sqrt(2 / size)
    table[0] = 1 / math.sqrt(size)
    return table.to(dtype=dtype, device=device)
