"""An upper bound on the power of any aims under a limit.

For any multipliers l >= 0, areas A and limit L, no plan whose expected map is within the limit has
more power than::

    sum over mirrors of max(0, best aim's sum of K A (1 - l)) + sum of l L A

Source: Lagrangian duality, Boyd and Vandenberghe, *Convex Optimization*, section 5.1. The best aim
of each mirror is sought on a grid as fine as its image's pixels, by Fourier transform, with a
parabola through the best place and its neighbours. Multipliers of a good plan make the bound tight;
subgradient steps make it tighter.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from model.aiming.kernels import Kernels
from model.aiming.plan import AimPlan, mirror_values

_MIRRORS = 256
"""Mirrors whose aims are sought at once."""

_STEPS = 6
_STEP = 0.05

_LOOSE = 1.01
_SHARES = (1.0, 0.3, 0.1, 0.0)
"""Shares of the plan's multipliers that are tried if its bound is above `_LOOSE` of its power."""


def bound_power(plan: AimPlan, steps: int = _STEPS) -> float:
    """Upper bound [W] on the power of any aims of the plan's mirrors under its limit.

    ``steps`` are subgradient steps from the plan's multipliers; the smallest bound counts.
    """
    kernels, limit = plan.kernels, plan.limit
    multipliers, least = _scaled(plan), math.inf
    with torch.no_grad():
        for number in range(steps + 1):
            best = _best_aims(plan, multipliers)
            least = min(least, _bound(plan, multipliers, best))
            if number < steps:
                flux = kernels.flux(best.moved, (best.values > 0).to(best.moved))
                # The subgradient is the flux that is left; half of the way keeps what the plan
                # knows.
                left = 1 - (flux + plan.flux) / (2 * limit)
                multipliers = (multipliers - _STEP / (number + 1) * left).clamp(min=0)
    return least


def _scaled(plan: AimPlan) -> Tensor:
    """The plan's multipliers (P,), or others if they give a smaller bound.

    Those of a plan that began far away may be too large. Equal ones of 1 give the most that the
    limit lets through, which is the bound of a strong limit.
    """
    with torch.no_grad():
        least = _bound(plan, plan.multipliers, _best_aims(plan, plan.multipliers))
        if least < _LOOSE * plan.power:
            return plan.multipliers.clone()
        equal = torch.ones_like(plan.multipliers)
        tried = [share * some for some in (plan.multipliers, equal) for share in _SHARES]
        return min(tried, key=lambda some: _bound(plan, some, _best_aims(plan, some)))


def _bound(plan: AimPlan, multipliers: Tensor, best: "_Best") -> float:
    """The bound [W] of multipliers (P,) and their best aims."""
    priced = (multipliers.double() * plan.limit * plan.kernels.areas).sum()
    return float(best.values.double().clamp(min=0).sum() + priced)


@dataclass(frozen=True, eq=False)
class _Best:
    """Best aims (N, 2) [m] and what they are worth (N,) [W]."""

    moved: Tensor
    values: Tensor


def _best_aims(plan: AimPlan, multipliers: Tensor) -> _Best:
    """Best aims of the grid, or the plan's own where they are better."""
    kernels = plan.kernels
    weights = (1 - multipliers) * kernels.areas
    parts = [_best_of(part, weights) for part, _ in kernels.parts(_MIRRORS)]
    moved, values = (torch.cat([getattr(p, name) for p in parts]) for name in ("moved", "values"))
    own = mirror_values(replace(plan, multipliers=multipliers))
    is_better = own > values
    return _Best(
        torch.where(is_better[:, None], plan.moved, moved), torch.where(is_better, own, values)
    )


def _best_of(kernels: Kernels, weights: Tensor) -> _Best:
    """Best aims of some mirrors for what light is worth in each pixel (P,) [m2]."""
    worth, size = _on_planes(kernels, weights), kernels.size
    pixel, grid = kernels.sides / size, worth.shape[-1]
    images = torch.zeros_like(worth)
    images[:, :size, :size] = kernels.expected
    spectrum = torch.fft.rfft2(worth) * torch.fft.rfft2(images).conj()
    values = torch.fft.irfft2(spectrum, s=(grid, grid))
    flat = values.flatten(1).argmax(dim=1)
    row, column = flat // grid, flat % grid
    best = values[torch.arange(len(flat)), row, column]
    best = best + _beyond(values, row, column)
    # Places of the image's first pixel; those of the second half are before the grid's beginning.
    down, right = (
        torch.where(place > grid - size // 2, place - grid, place) for place in (row, column)
    )
    middle = grid / 2 - size / 2 + 0.5
    moved = torch.stack([(right - middle) * pixel, (middle - down) * pixel], dim=-1)
    return _Best(moved, best)


def _beyond(values: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """What the tops of parabolas through the best places are above them (N,)."""
    here, grid = torch.arange(len(values)), values.shape[-1]
    top = values[here, row, column]
    above = torch.zeros_like(top)
    for down, right in ((1, 0), (0, 1)):
        before = values[here, (row - down) % grid, (column - right) % grid]
        after = values[here, (row + down) % grid, (column + right) % grid]
        bend = (2 * top - before - after).clamp(min=1e-12)
        above = above + (after - before) ** 2 / (8 * bend)
    return above


def _on_planes(kernels: Kernels, weights: Tensor) -> Tensor:
    """What light is worth (N, G, G) on the pixels of the mirrors' planes.

    It is the adjoint of `Kernels.light`: bilinear shares of each place. The planes have twice the
    images' pixels, so that nothing wraps around.
    """
    grid = 2 * kernels.size
    worth = kernels.factors * weights[kernels.pixels]
    x, y = kernels.places.unbind(dim=1)
    x, y = x * (grid / 4) + grid / 2, y * (grid / 4) + grid / 2
    is_inside = (x >= 0) & (x < grid - 1) & (y >= 0) & (y < grid - 1)
    worth = worth * is_inside
    left, top = (place.floor().clamp(0, grid - 2) for place in (x, y))
    right, down = x - left, y - top
    index = (top * grid + left).long()
    planes = torch.zeros(len(kernels), grid**2)
    shares = (
        (0, (1 - right) * (1 - down)),
        (1, right * (1 - down)),
        (grid, (1 - right) * down),
        (grid + 1, right * down),
    )
    for offset, share in shares:
        planes.scatter_add_(1, index + offset, worth * share)
    return planes.view(-1, grid, grid)
