"""Nuisance parameters of a camera: unknown changes of an image, to be marginalised."""

import torch
from torch import Tensor

from model.images import FLUX_WINDOW

SHIFT, BLUR = 0.03, 0.05
"""Standard deviations [m] of a shift and of a small blur."""

EXPOSURE, GAMMA = 0.1, 0.1
"""Standard deviations [1] of the exposure and of the gamma of the response."""

BACKGROUND = 0.02
"""Standard deviation [of the peak] of a background."""

BLACK = 0.01
"""Flux [of the peak] up to which noise that is truncated at black brightens pixels."""


def size_nuisance(images: Tensor) -> Tensor:
    """Change (..., R, R) of images (..., R, R) per relative change of their size [1], sum kept."""
    place = (torch.arange(images.shape[-1]) + 0.5).to(images) - images.shape[-1] / 2
    up, right = torch.gradient(images, dim=(-2, -1))
    return -(place[:, None] * up + place * right + 2 * images)


def nuisances(images: Tensor, side: float = FLUX_WINDOW) -> Tensor:
    """Changes (..., 7, R, R) of images (..., R, R) of ``side`` [m] by one standard deviation."""
    pixel, peak = side / images.shape[-1], images.amax(dim=(-2, -1), keepdim=True)
    up, right = torch.gradient(images, spacing=pixel, dim=(-2, -1))
    (up_twice,), (right_twice,) = (
        torch.gradient(g, spacing=pixel, dim=d) for g, d in ((up, -2), (right, -1))
    )
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
            # Noise that is truncated at black brightens dark pixels only.
            torch.exp(-relative / BLACK) * background,
        ],
        dim=-3,
    )
