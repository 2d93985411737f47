"""Flux images as numbers, alike for numpy and torch."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Images = TypeVar("Images", NDArray[np.float64], Tensor)

FLUX_SUM = 100.0
"""What the pixels of a normalised flux image add up to (the paper's rule)."""


def normalized(images: Images) -> Images:
    """Images (..., R, C) scaled to a sum of `FLUX_SUM`; a black one stays black."""
    scaled: Images = FLUX_SUM * images / images.sum((-2, -1)).clip(1e-9)[..., None, None]
    return scaled


def binned(images: Images, resolution: int) -> Images:
    """Images (..., n R, n R) in R = ``resolution`` pixels a side, their sums kept."""
    size = images.shape[-1] // resolution
    coarse: Images = images.reshape(*images.shape[:-2], resolution, size, resolution, size).sum((-3, -1))
    return coarse
