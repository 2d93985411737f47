"""What a camera may have done to an image without anybody's knowing: directions to be marginalised."""

import torch
from torch import Tensor

from model.images import FLUX_WINDOW

SHIFT, BLUR = 0.03, 0.05
"""Standard deviations [m] of a shift, and of a little blur."""

EXPOSURE, GAMMA = 0.1, 0.1
"""Standard deviations [1] of another exposure, and of another response."""

BACKGROUND = 0.02
"""Standard deviation [of the peak] of a background."""

BLACK = 0.01
"""Noise that cannot go below black lifts pixels up to this flux [of the peak]."""


def nuisances(images: Tensor, side: float = FLUX_WINDOW) -> Tensor:
    """Directions (..., 7, R, R) in which cameras may change images (..., R, R) of ``side`` [m], of standard length."""
    pixel, peak = side / images.shape[-1], images.amax(dim=(-2, -1), keepdim=True)
    up, right = torch.gradient(images, spacing=pixel, dim=(-2, -1))
    (up_twice,), (right_twice,) = (torch.gradient(g, spacing=pixel, dim=d) for g, d in ((up, -2), (right, -1)))
    relative = (images / peak).clamp(min=1e-4)
    background = (peak * BACKGROUND).expand_as(images)
    return torch.stack(
        [
            right * SHIFT,
            up * SHIFT,
            images * EXPOSURE,
            background,
            (up_twice + right_twice) * BLUR**2 / 2,
            images * relative.log() * GAMMA,
            # Noise that is cut at black lifts the dark, and only the dark.
            torch.exp(-relative / BLACK) * background,
        ],
        dim=-3,
    )
