"""What a sun shape is, and what the tracers make of it.

The convolution tracer needs a shape's transfer function (its Hankel transform over angular
frequency), the Monte Carlo tracer needs random angles; both come from the one profile that each
class states.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.errors import InvalidInputError
from model.frames import SOLAR_DISC as SOLAR_DISC

FREQUENCY_STEP = 2.0
"""Spacing of tabulated transfer functions [cycles/rad]."""

FREQUENCY_COUNT = 4096

SOFT_FROM = 0.9
"""Share of the angle at which a transfer function's light ends, from which on it fades."""


class SunShape(ABC):
    """Base of all sun shapes, which are frozen dataclasses of parameters: what the tracers ask of
    one.

    Attributes
    ----------
    units : mapping
        What ``twin.json`` calls the parameters, in their order, with the factors that make them SI.
    """

    units: ClassVar[Mapping[str, float]] = {}

    @property
    @abstractmethod
    def edges(self) -> Sequence[float]:
        """Angles [rad] between which the profile is smooth, from 0 to where it ends."""

    @abstractmethod
    def profile(self, angle: Tensor) -> Tensor:
        """Relative radiance (n,) at angles (n,) [rad] from the sun's centre."""


def check(name: str, value: float | Tensor, low: float, high: float) -> None:
    """Raise `InvalidInputError` unless a parameter lies within its bounds."""
    number = float(value.detach()) if isinstance(value, Tensor) else float(value)
    if not low <= number <= high:
        raise InvalidInputError(f"{name} must lie in [{low:g}, {high:g}], got {number:g}")


class _Quadrature(NamedTuple):
    """Gauss-Legendre angles [rad] and weights, each (n,)."""

    angles: NDArray[np.float64]
    weights: NDArray[np.float64]


@lru_cache(maxsize=16)
def _quadrature(edges: tuple[float, ...]) -> _Quadrature:
    """The quadrature over each smooth piece."""
    # Gauss and Legendre need pi nodes a cycle at a piece's middle, for the Bessel function's at the
    # highest frequency.
    densest = np.pi * FREQUENCY_STEP * FREQUENCY_COUNT
    pieces = [
        (low, high, *np.polynomial.legendre.leggauss(16 + math.ceil(densest * (high - low))))
        for low, high in pairwise(edges)
    ]
    angles = [low + (high - low) / 2 * (1 + nodes) for low, high, nodes, _ in pieces]
    weights = [(high - low) / 2 * weights for low, high, _, weights in pieces]
    return _Quadrature(np.concatenate(angles), np.concatenate(weights))


class _Hankel(NamedTuple):
    """Angles (n,), weights angle * d(angle) (n,) and Bessel kernel (K, n) of a Hankel transform."""

    angles: Tensor
    weights: Tensor
    kernel: Tensor


@lru_cache(maxsize=2)  # 19 or 38 MB each
def _hankel(edges: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> _Hankel:
    angles, weights = _quadrature(edges)
    frequency = FREQUENCY_STEP * torch.arange(FREQUENCY_COUNT, dtype=torch.float64)
    kernel = torch.special.bessel_j0(2 * np.pi * frequency[:, None] * torch.as_tensor(angles))
    tensors = (torch.as_tensor(angles), torch.as_tensor(weights * angles), kernel)
    return _Hankel(*(tensor.to(dtype=dtype, device=device) for tensor in tensors))


def transfer_table(
    shape: SunShape, dtype: torch.dtype, device: torch.device, ends: Sequence[float] | None = None
) -> Tensor:
    """The shape's transfer function (K,) at multiples of `FREQUENCY_STEP`, one at frequency zero.

    The two-dimensional Fourier transform of the normalised radiance in the small-angle plane, which
    for a profile that depends on the angle alone is its Hankel transform. Differentiable in the
    shape's tensor parameters.

    With ``ends`` (E,) [rad] it is that of the light up to each of these angles, (E, K), less than
    one at frequency zero by the light beyond.
    """
    angles, weights, kernel = _hankel(shape.edges, dtype, device)
    density = shape.profile(angles) * weights
    density = density / density.sum()
    if ends is None:
        return kernel @ density
    # A soft end leaves no ripples: all that is left of it lies where the light counts no more.
    past = angles / torch.as_tensor(ends, dtype=dtype, device=device)[:, None]
    kept = 0.5 + 0.5 * torch.cos(np.pi * ((past - SOFT_FROM) / (1 - SOFT_FROM)).clamp(0, 1))
    return (density * kept) @ kernel.T


def integral(shape: SunShape) -> Tensor:
    """Integral of radiance times angle over the whole shape, which normalises a profile."""
    angles, weights = (torch.as_tensor(values) for values in _quadrature(shape.edges))
    return (shape.profile(angles) * angles * weights).sum()


def half_angle(shape: SunShape, share: float) -> float:
    """Angle [rad] from the sun's centre within which ``share`` of its light lies."""
    angles, weights = _quadrature(shape.edges)
    with torch.no_grad():
        density = shape.profile(torch.as_tensor(angles)).double().cpu().numpy() * weights * angles
    cumulative = np.cumsum(density)
    return float(np.interp(share * cumulative[-1], cumulative, angles))


def random_angles(shape: SunShape, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random angles (count,) [rad] from the sun's centre, by radiance times sin(angle)."""
    edges = np.asarray(shape.edges)
    grid = np.concatenate([np.linspace(a, b, 2049)[:-1] for a, b in pairwise(edges)])
    grid = np.append(grid, edges[-1])
    middle = (grid[1:] + grid[:-1]) / 2
    density = (
        shape.profile(torch.as_tensor(middle)).detach().numpy() * np.sin(middle) * np.diff(grid)
    )
    cumulative = np.concatenate([[0.0], np.cumsum(density)])
    return np.asarray(np.interp(rng.random(count) * cumulative[-1], cumulative, grid))
