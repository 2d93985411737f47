"""A disc that darkens towards its rim by a cosine."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.sunshape.base import SunShape


@dataclass(frozen=True)
class Cosine(SunShape):
    """It ends at ``rim`` [rad]."""

    units: ClassVar[Mapping[str, float]] = {"rim_mrad": 1e-3}

    rim: float

    @property
    def edges(self) -> tuple[float, ...]:
        return (0.0, self.rim)

    def profile(self, angle: Tensor) -> Tensor:
        return torch.cos(angle / self.rim * torch.pi / 2).clamp(min=0)
