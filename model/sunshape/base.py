"""What a sun shape is, and what the tracers make of it.

The convolution tracer needs a shape's transfer function (its Hankel transform over angular frequency), the Monte Carlo
tracer needs random angles; both come from the one profile that each class states.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.errors import InvalidInputError

SOLAR_DISC = 4.65e-3
"""Half angle of the solar disc [rad]."""

FREQUENCY_STEP = 2.0
"""Spacing of tabulated transfer functions [cycles/rad]."""

FREQUENCY_COUNT = 4096


class SunShape(ABC):
    """Base of all sun shapes, which are frozen dataclasses of parameters: what the tracers ask of one.

    Attributes
    ----------
    units : mapping
        What ``twin.json`` calls the parameters, in their order, with the factors that make them SI.
    """

    units: ClassVar[Mapping[str, float]] = {}

    @property
    @abstractmethod
    def edges(self) -> tuple[float, ...]:
        """Angles [rad] between which the profile is smooth, from 0 to where it ends."""

    @abstractmethod
    def profile(self, angle: Tensor) -> Tensor:
        """Relative radiance (n,) at angles (n,) [rad] from the sun's centre."""


def check(name: str, value: float | Tensor, low: float, high: float) -> None:
    """Raise `InvalidInputError` unless a parameter lies within its bounds."""
    number = float(value.detach()) if isinstance(value, Tensor) else float(value)
    if not low <= number <= high:
        raise InvalidInputError(f"{name} must lie in [{low:g}, {high:g}], got {number:g}")


@lru_cache(maxsize=16)
def _quadrature(edges: tuple[float, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gauss-Legendre angles and weights (n,) over each smooth piece."""
    # 320 nodes resolve the aureole's Bessel oscillations up to the highest tabulated frequency; few pieces get more.
    nodes, weights = np.polynomial.legendre.leggauss(max(16, 640 // (len(edges) - 1)))
    halves = np.diff(edges) / 2
    angles = (np.asarray(edges[:-1]) + halves)[:, None] + halves[:, None] * nodes
    return angles.ravel(), (halves[:, None] * weights).ravel()


@lru_cache(maxsize=8)
def _hankel(edges: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Angles (n,), weights angle * d(angle) (n,) and Bessel kernel (K, n) of the Hankel transform."""
    angles, weights = _quadrature(edges)
    frequency = FREQUENCY_STEP * torch.arange(FREQUENCY_COUNT, dtype=torch.float64)
    kernel = torch.special.bessel_j0(2 * np.pi * frequency[:, None] * torch.as_tensor(angles))
    tensors = (torch.as_tensor(angles), torch.as_tensor(weights * angles), kernel)
    on_angles, on_weights, on_kernel = (tensor.to(dtype=dtype, device=device) for tensor in tensors)
    return on_angles, on_weights, on_kernel


def transfer_table(shape: SunShape, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The shape's transfer function (K,) at multiples of `FREQUENCY_STEP`, one at frequency zero.

    The two-dimensional Fourier transform of the normalised radiance in the small-angle plane, which for a profile
    that depends on the angle alone is its Hankel transform. Differentiable in the shape's tensor parameters.
    """
    angles, weights, kernel = _hankel(shape.edges, dtype, device)
    density = shape.profile(angles) * weights
    return kernel @ (density / density.sum())


def random_angles(shape: SunShape, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random angles (count,) [rad] from the sun's centre, distributed as radiance times sin(angle)."""
    edges = np.asarray(shape.edges)
    grid = np.concatenate([np.linspace(a, b, 2049)[:-1] for a, b in pairwise(edges)])
    grid = np.append(grid, edges[-1])
    middle = (grid[1:] + grid[:-1]) / 2
    density = shape.profile(torch.as_tensor(middle)).detach().numpy() * np.sin(middle) * np.diff(grid)
    cumulative = np.concatenate([[0.0], np.cumsum(density)])
    return np.asarray(np.interp(rng.random(count) * cumulative[-1], cumulative, grid))
