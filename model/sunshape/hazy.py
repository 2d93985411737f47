"""A declared sun behind more or less haze than that of a clear sky.

It is not declared in ``twin.json``: an effect creates it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from model.sunshape.base import SunShape, integral
from model.sunshape.buie import Buie

CLEAR_SKY = 0.02
"""Circumsolar ratio of the haze that is in any sun already."""


@dataclass(frozen=True)
class Hazy(SunShape):
    """``sun`` with what Buie's sun of ``circumsolar_ratio`` has, share by share of its light, over
    that of a clear sky.

    At `CLEAR_SKY` it is ``sun`` itself, whatever its shape. The ratio may be a tensor, for
    gradients.
    """

    sun: SunShape
    circumsolar_ratio: float | Tensor = CLEAR_SKY

    @property
    def edges(self) -> Sequence[float]:
        """Those of the sun and of Buie's [rad]."""
        return tuple(sorted({*self.sun.edges, *Buie().edges}))

    def profile(self, angle: Tensor) -> Tensor:
        """Shares of the light per solid angle; haze takes at most what there is."""
        suns = self.sun, Buie(self.circumsolar_ratio), Buie(CLEAR_SKY)
        own, hazy, clear = (sun.profile(angle) / integral(sun).to(angle) for sun in suns)
        within = angle <= self.sun.edges[-1]
        return (torch.where(within, own, torch.zeros_like(own)) + hazy - clear).clamp(min=0)
