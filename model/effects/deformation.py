"""Height changes of mirrors, interpolated by their splines at the Greville abscissae.

This is exact if x and y are linear in the parameters, as on heliotwin's grid.
"""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from model.surface import basis, greville


def places_on(points: Tensor, degree: int) -> Tensor:
    """Places x and y (B, F, 2, I, J) [m] of control points (B, F, 3, I, J) at their abscissae."""
    u, v = (_collocation(size, degree, points) for size in points.shape[-2:])
    return u.values @ points[:, :, :2] @ v.values.T


def coefficients_of(heights: Tensor, degree: int) -> Tensor:
    """Spline coefficients (B, F, I, J) of heights (B, F, I, J) [m] at the abscissae."""
    u, v = (_collocation(size, degree, heights) for size in heights.shape[-2:])
    return u.inverse @ heights @ v.inverse.T


class _Collocation(NamedTuple):
    """Matrix (count, count) from coefficients to values at the Greville abscissae; its inverse."""

    values: Tensor
    inverse: Tensor


def _collocation(count: int, degree: int, like: Tensor) -> _Collocation:
    return _cached(count, degree, like.dtype, like.device)


@lru_cache(maxsize=16)
def _cached(count: int, degree: int, dtype: torch.dtype, device: torch.device) -> _Collocation:
    values = torch.as_tensor(basis(count, degree, greville(count, degree)).values)
    inverse = torch.linalg.inv(values)
    return _Collocation(*(m.to(dtype=dtype, device=device) for m in (values, inverse)))
