"""Gaussian: a sun shape that, convolved with Gaussian errors, gives another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.sunshape.base import SunShape, check


@dataclass(frozen=True)
class Gaussian(SunShape):
    """A Gaussian of standard deviation ``sigma`` [rad] per axis."""

    units: ClassVar[Mapping[str, float]] = {"sigma_mrad": 1e-3}

    sigma: float | Tensor = 2.73e-3

    def __post_init__(self) -> None:
        check("gaussian sigma [rad]", self.sigma, 1e-6, 0.1)

    @property
    def edges(self) -> Sequence[float]:
        """Cut at six standard deviations [rad]."""
        return (0.0, 6 * float(self.sigma))

    def profile(self, angle: Tensor) -> Tensor:
        """exp(-angle^2 / 2 sigma^2)."""
        return torch.exp(-0.5 * (angle / self.sigma) ** 2)
