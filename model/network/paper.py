"""The paper's network, to be measured beside ours: eight images stacked as channels, one encoder, one look.

Lewen et al. 2024 stack eight flux images as channels of one 256-channel convolutional encoder, let the scalars of the
geometry in by weight demodulation, map the features to styles w+ of 3 x 32 and grow the surface by a StyleGAN2 decoder,
about 3.5 million parameters in all. Images that are missing are zero, and a mask tells which. What the paper leaves
open (kernel sizes, where the resolution halves) is filled in as plainly as possible.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from model.network.architecture import CONDITIONS, MAX_IMAGES, Decoder, ModulatedConv, NetworkConfig, activate

STAGES = 4
"""Encoder convolutions, each of which halves the resolution: 64 pixels to 4."""


@dataclass(frozen=True)
class PaperConfig:
    """Sizes of the paper's network."""

    channels: int = 256
    style_layers: int = 3
    style_features: int = 32
    decoder_channels: int = 128


class PaperNetwork(nn.Module):
    """Flux images to control heights [mm] and the spread of their error [mm], with the call of `SurfaceNetwork`."""

    def __init__(self, config: PaperConfig, scale: float = 0.35) -> None:
        super().__init__()
        self.config, self.scale = config, scale
        self.style = nn.Sequential(
            nn.Linear(MAX_IMAGES * (CONDITIONS + 1), 256), nn.LeakyReLU(0.2), nn.Linear(256, 128), nn.LeakyReLU(0.2)
        )
        widths = [MAX_IMAGES, *[config.channels] * STAGES]
        self.convs = nn.ModuleList([ModulatedConv(widths[i], widths[i + 1], 128, stride=2) for i in range(STAGES)])
        self.to_styles = nn.Sequential(
            nn.Linear(config.channels * 16, config.channels),
            nn.LayerNorm(config.channels),
            nn.LeakyReLU(0.2),
            nn.Linear(config.channels, config.style_layers * config.style_features),
        )
        self.decoder = Decoder(
            NetworkConfig(
                style_layers=config.style_layers,
                style_features=config.style_features,
                decoder_channels=config.decoder_channels,
            )
        )

    def forward(
        self, flux: Tensor, conditions: Tensor, mask: Tensor, guess_flux: Tensor, guess: Tensor, descent: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Predict from 1 to 8 images (B, M, 64, 64) as `SurfaceNetwork` does; guess and descent are not looked at."""
        missing = MAX_IMAGES - flux.shape[1]
        x = nn.functional.pad(flux * mask[:, :, None, None], (0, 0, 0, 0, 0, missing)) * 8
        known = torch.cat([conditions * mask[:, :, None], mask[:, :, None]], dim=2)
        style = self.style(nn.functional.pad(known, (0, 0, 0, missing)).flatten(1))
        for conv in self.convs:
            x = activate(conv(x, style))
        styles = self.to_styles(x.flatten(1)).view(-1, self.config.style_layers, self.config.style_features)
        heights, log_spread = self.decoder(styles)
        heights = heights - heights.mean(dim=(2, 3), keepdim=True)
        return guess + self.scale * heights, self.scale * torch.exp(log_spread.clamp(-6, 2))


SIZES, NETWORK = PaperConfig, PaperNetwork
