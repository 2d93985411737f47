"""Sun shapes: the radiance of the sun and its aureole over the angle from the centre of the disc.

The convolution tracer needs a shape's transfer function (its Hankel transform over angular frequency), the Monte Carlo
tracer needs random angles; both come from the one profile that each class states.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.errors import InvalidInputError

SOLAR_DISC = 4.65e-3
"""Half angle of the solar disc [rad]."""

AUREOLE_EDGE = 43.6e-3
"""Where the circumsolar aureole ends in Buie's sun shape [rad]."""

FREQUENCY_STEP = 2.0
"""Spacing of tabulated transfer functions [cycles/rad]."""

FREQUENCY_COUNT = 4096


class SunShape(Protocol):
    """What the tracers ask of a sun shape."""

    @property
    def edges(self) -> tuple[float, ...]:
        """Angles [rad] between which the profile is smooth, from 0 to where it ends."""

    def profile(self, angle: Tensor) -> Tensor:
        """Relative radiance (n,) at angles (n,) [rad] from the sun's centre."""


def _check(name: str, value: float | Tensor, low: float, high: float) -> None:
    number = float(value.detach()) if isinstance(value, Tensor) else float(value)
    if not low <= number <= high:
        raise InvalidInputError(f"{name} must lie in [{low:g}, {high:g}], got {number:g}")


@dataclass(frozen=True)
class Pillbox:
    """A disc of even radiance with half angle ``half_angle`` [rad]."""

    half_angle: float = SOLAR_DISC

    def __post_init__(self) -> None:
        _check("pillbox half_angle [rad]", self.half_angle, 1e-6, 0.1)

    @property
    def edges(self) -> tuple[float, ...]:
        """The disc's centre and rim [rad]."""
        return (0.0, float(self.half_angle))

    def profile(self, angle: Tensor) -> Tensor:
        """One inside the disc."""
        return (angle <= self.half_angle).to(angle.dtype)


@dataclass(frozen=True)
class Gaussian:
    """A Gaussian of standard deviation ``sigma`` [rad] per axis."""

    sigma: float | Tensor = 2.73e-3

    def __post_init__(self) -> None:
        _check("gaussian sigma [rad]", self.sigma, 1e-6, 0.1)

    @property
    def edges(self) -> tuple[float, ...]:
        """Cut at six standard deviations [rad]."""
        return (0.0, 6 * float(self.sigma))

    def profile(self, angle: Tensor) -> Tensor:
        """exp(-angle^2 / 2 sigma^2)."""
        return torch.exp(-0.5 * (angle / self.sigma) ** 2)


@dataclass(frozen=True)
class Buie:
    """Buie's sun shape: a limb-darkened disc and an aureole that falls as a power of the angle.

    ``circumsolar_ratio`` is the chi of the formula, 0 (no aureole) to 0.5; it may be a tensor, for gradients.

    Source: Buie, Monger, Dey, *Sunshape distributions for terrestrial solar simulations*, Solar Energy 74 (2003),
    doi:10.1016/S0038-092X(03)00125-7, eqs. 6 to 9.
    """

    circumsolar_ratio: float | Tensor = 0.02

    def __post_init__(self) -> None:
        _check("circumsolar_ratio", self.circumsolar_ratio, 0.0, 0.5)

    @property
    def edges(self) -> tuple[float, ...]:
        """Centre, rim of the disc and end of the aureole [rad]."""
        return (0.0, SOLAR_DISC, AUREOLE_EDGE)

    def profile(self, angle: Tensor) -> Tensor:
        """Radiance relative to the centre's; the formula counts angles in milliradians."""
        theta = (angle * 1e3).clamp(min=1e-9)
        disc = torch.cos(0.326 * theta) / torch.cos(0.308 * theta)
        chi = torch.as_tensor(self.circumsolar_ratio, dtype=angle.dtype, device=angle.device).clamp(min=1e-9)
        kappa = 0.9 * torch.log(13.5 * chi) * chi**-0.3
        gamma = 2.2 * torch.log(0.52 * chi) * chi**0.43 - 0.1
        aureole = torch.exp(kappa + gamma * torch.log(theta))
        inside = angle <= SOLAR_DISC
        return torch.where(inside, disc, torch.where(angle <= AUREOLE_EDGE, aureole, torch.zeros_like(aureole)))


@dataclass(frozen=True)
class Tabulated:
    """A measured profile: radiances at increasing angles [rad] from 0, linear between, zero beyond."""

    angles: tuple[float, ...]
    radiances: tuple[float, ...]

    def __post_init__(self) -> None:
        a, r = np.asarray(self.angles), np.asarray(self.radiances)
        if a.shape != r.shape or a.ndim != 1 or len(a) < 2 or not (np.isfinite(a).all() and np.isfinite(r).all()):
            raise InvalidInputError("a tabulated sun shape needs as many finite radiances as angles, at least two")
        if a[0] != 0 or (np.diff(a) <= 0).any() or (r < 0).any() or not r.any():
            raise InvalidInputError(
                "a tabulated sun shape needs angles rising from 0 and radiances that are not negative"
            )

    @property
    def edges(self) -> tuple[float, ...]:
        """The table's angles [rad]."""
        return self.angles

    def profile(self, angle: Tensor) -> Tensor:
        """Linear interpolation."""
        table = np.interp(angle.detach().cpu().numpy(), self.angles, self.radiances, right=0.0)
        return torch.as_tensor(table, dtype=angle.dtype, device=angle.device)


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
