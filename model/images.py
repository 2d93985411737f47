"""Flux images as numbers, alike for numpy and torch.

The flux image that everything compares, predicts from and reports is a square about the spot's centre of mass, of the
side, the pixels and the sum that Lewen et al. 2024 (iDLR) chose.
"""

from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # its sizes are read where nothing is traced
    from torch import Tensor

Images = TypeVar("Images", NDArray[np.float64], "Tensor")

FLUX_WINDOW = 4.0
"""Side [m] of a flux image about its centre of mass."""

FLUX_SIZE = 64
"""Pixels along a side of a flux image."""

FLUX_SHAPE = (FLUX_SIZE, FLUX_SIZE)

FLUX_SUM = 100.0
"""What the pixels of a normalised flux image add up to."""

COARSE_SIZE = 32
"""Pixels along a side of images that are fitted: the sun has blurred all that is finer."""


def normalized(images: Images) -> Images:
    """Images (..., R, C) scaled to a sum of `FLUX_SUM`; a black one stays black."""
    scaled: Images = FLUX_SUM * images / images.sum((-2, -1)).clip(1e-9)[..., None, None]
    return scaled


def clipped_alike(forecast: Images, measured: Images, clipped: Images) -> Images:
    """Forecasts (..., R, C) as a camera shows them whose range cut off ``measured`` by the shares ``clipped`` [1].

    Of such a pixel only this is known: that the light was at least so much. Forecasts are brought to the scale of what
    was not cut off, and cut off where they are brighter; what lies above is no error.
    """
    free = 1 - clipped
    scale = (measured * free).sum((-2, -1)) / (forecast * free).sum((-2, -1)).clip(1e-9)
    seen = forecast * scale[..., None, None]
    cut: Images = seen - clipped * (seen - measured).clip(0)
    return cut


def binned(images: Images, resolution: int) -> Images:
    """Images (..., n R, n R) in R = ``resolution`` pixels a side, their sums kept."""
    size = images.shape[-1] // resolution
    coarse: Images = images.reshape(*images.shape[:-2], resolution, size, resolution, size).sum((-3, -1))
    return coarse
