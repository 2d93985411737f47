"""Flux images as arrays, for numpy and torch.

The flux image that everything compares, predicts from and reports is a square about the spot's
centre of mass, with the width, the pixels and the sum of Lewen et al. 2024 (iDLR).
"""

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # its sizes are read where nothing is traced
    from torch import Tensor

Images = TypeVar("Images", NDArray[np.float64], "Tensor")

FLUX_WINDOW = 4.0
"""Width [m] of a flux image about its centre of mass."""

FLUX_SIZE = 64
"""Pixels along a side of a flux image."""

FLUX_SHAPE = (FLUX_SIZE, FLUX_SIZE)

FLUX_SUM = 100.0
"""Sum of the pixels of a normalised flux image."""

COARSE_SIZE = 32
"""Pixels along a side of fitted images: the sun blurs all finer detail."""


def normalized(images: Images) -> Images:
    """Scale images (..., R, C) to a sum of `FLUX_SUM`; a black one stays black."""
    scaled: Images = FLUX_SUM * images / images.sum((-2, -1)).clip(1e-9)[..., None, None]
    return scaled


def clipped_alike(forecast: Images, measured: Images, clipped: Images) -> Images:
    """Saturate forecasts (..., R, C) as the camera saturated ``measured``, by the shares
    ``clipped`` [1] of pixels.

    Of a saturated pixel only a lower limit of the light is known. Forecasts are scaled to the light
    that is not saturated, and limited where they are brighter: the excess is no error.
    """
    free = 1 - clipped
    scale = (measured * free).sum((-2, -1)) / (forecast * free).sum((-2, -1)).clip(1e-9)
    seen = forecast * scale[..., None, None]
    cut: Images = seen - clipped * (seen - measured).clip(0)
    return cut


def binned(images: Images, resolution: int) -> Images:
    """Sum images (..., n R, n R) to R = ``resolution`` pixels along a side.

    Sums of every n-th line are several times faster than a sum over axes.
    """
    step = images.shape[-1] // resolution
    rows: Any = sum(images[..., first::step, :] for first in range(step))
    coarse: Images = sum(rows[..., first::step] for first in range(step))
    return coarse
