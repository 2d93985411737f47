"""A network that looks at the step of descent and nothing else."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class TinySizes:
    width: int = 8


class TinyNetwork(nn.Module):
    def __init__(self, sizes: TinySizes) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(256, sizes.width), nn.ReLU(), nn.Linear(sizes.width, 512))

    def forward(
        self, flux: Tensor, conditions: Tensor, mask: Tensor, guess_flux: Tensor, guess: Tensor, descent: Tensor
    ) -> tuple[Tensor, Tensor]:
        heights, log_spread = self.layers(descent.sum(dim=1).flatten(1)).view(-1, 8, 8, 8).chunk(2, dim=1)
        return guess + heights - heights.mean(dim=(2, 3), keepdim=True), torch.exp(log_spread.clamp(-6, 2))


SIZES, NETWORK = TinySizes, TinyNetwork
