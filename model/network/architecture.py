"""The network: from flux images of one heliostat to its mirror surface.

With each measured image it gets the image traced from a guess of the surface, and a step of the
guess that would explain the difference. It predicts the correction. The first guess is the mean
surface; each prediction is the next guess.

One convolutional encoder turns each pair of images, with geometry and step, into a vector. A
weighted mean pools the vectors of any number of images in any order. A perceptron decodes the
result into the control heights of the facets.

Source: Lewen et al. 2024, *Inverse Deep Learning Ray Tracing for Heliostat Surface Prediction* (the
idea); Zaheer et al. 2017, *Deep Sets* (encode one by one, pool, decode); Adler and Oktem 2017,
*Solving ill-posed inverse problems using iterative deep neural networks* (a learnt iteration with
the gradient as an input).
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from model.surface import COLUMNS, FACETS, ROWS

MAX_IMAGES = 8
"""Largest number of images of a prediction."""

CONDITIONS = 12
"""Numbers that describe the geometry of one image (`model.network.inputs.conditions`)."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network; the names are those used below."""

    channels: tuple[int, int, int] = (32, 64, 128)
    features: int = 256
    hidden: int = 512
    depth: int = 2


class EncoderBlock(nn.Module):
    """Two convolutions with a skip connection, conditioned on the geometry."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.skip = nn.Conv2d(inputs, outputs, kernel_size=stride, stride=stride)
        self.from_conditions = nn.Linear(CONDITIONS, outputs)
        for layer in (self.first, self.second, self.skip):
            nn.init.kaiming_normal_(layer.weight, a=0.2)

    def forward(self, x: Tensor, conditions: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        y = self.first(x) + self.from_conditions(conditions)[:, :, None, None]
        y = self.second(functional.leaky_relu(y, 0.2))
        return functional.leaky_relu((y + self.skip(x)) * 0.5**0.5, 0.2)


class Encoder(nn.Module):
    """Encodes a flux image, the guess's image and the geometry as a feature vector."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        fine, middle, coarse = config.channels
        self.fold = nn.PixelUnshuffle(4)
        self.blocks = nn.ModuleList(
            [
                EncoderBlock(4 * 16, fine, 1),
                EncoderBlock(fine, middle, 2),
                EncoderBlock(middle, coarse, 2),
            ]
        )
        self.to_features = nn.Linear(coarse * 16, config.features)

    def forward(self, flux: Tensor, guess_flux: Tensor, conditions: Tensor) -> Tensor:
        """Fluxes (N, 64, 64) of sum 100 and conditions (N, 12) to features (N, features)."""
        x = torch.stack([flux, guess_flux], dim=1)  # (N, 2, 64, 64)
        # The root amplifies the faint wings, in which the mirror's edges appear.
        x = torch.cat([x * 8, torch.sqrt(x.clamp(min=0) * 8)], dim=1)  # (N, 4, 64, 64)
        x = self.fold(x)  # (N, 64, 16, 16)
        for block in self.blocks:
            x = block(x, conditions)  # (N, fine, 16, 16), (N, middle, 8, 8), (N, coarse, 4, 4)
        features: Tensor = self.to_features(x.flatten(1))  # (N, features)
        return features


class Perceptron(nn.Module):
    """A residual block of a hidden layer."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(..., width) to the same."""
        y: Tensor = x + self.layers(x)
        return y


class Pooling(nn.Module):
    """Weighted mean of the images' vectors, independent of their order.

    Each feature has separate weights: one image may be informative about one facet, another about
    the next.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.to_weights = nn.Linear(config.features, config.features)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        """(B, M, features) and mask (B, M), one where there is an image, to (B, features)."""
        hidden = (mask - 1)[..., None] * 1e4  # (B, M, 1)
        weights = (self.to_weights(features) + hidden).softmax(dim=1)  # (B, M, features)
        pooled: Tensor = (features * weights).sum(dim=1)  # (B, features)
        return pooled


class SurfaceNetwork(nn.Module):
    """Flux images and a guess to control heights [mm] and the spread of their error [mm].

    ``scale`` [mm] is the unit of heights inside the network; mirrors have F ``facets``.
    """

    def __init__(self, config: NetworkConfig, scale: float = 0.35, facets: int = FACETS) -> None:
        super().__init__()
        self.config, self.scale, self.facets = config, scale, facets
        points = facets * ROWS * COLUMNS
        self.encoder = Encoder(config)
        self.from_geometry = nn.Linear(CONDITIONS + points, config.features)
        self.blocks = nn.Sequential(*[Perceptron(config.features) for _ in range(config.depth)])
        self.pooling = Pooling(config)
        self.norm = nn.LayerNorm(config.features)
        to_heights = nn.Linear(config.hidden, 2 * points)
        self.decoder = nn.Sequential(
            nn.Linear(config.features + 2 * points, config.hidden), nn.GELU(), to_heights
        )
        # A linear path for the part that is nearly linear in the images.
        self.bypass = nn.Linear(config.features + points, points)
        for last in (to_heights, self.bypass):  # the initial prediction is the guess
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(
        self,
        flux: Tensor,
        conditions: Tensor,
        mask: Tensor,
        guess_flux: Tensor,
        guess: Tensor,
        descent: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Predict.

        Parameters
        ----------
        flux : Tensor (B, M, 64, 64)
            4 m x 4 m about the centre of mass, sum 100; any values without an image.
        conditions : Tensor (B, M, 12)
        mask : Tensor (B, M)
            One with an image, zero without.
        guess_flux : Tensor (B, M, 64, 64)
            Traced from the guess, likewise.
        guess : Tensor (B, F, 8, 8) [mm]
        descent : Tensor (B, M, F, 8, 8) [mm]
            Each image's share of a step from the guess
            (`model.network.inputs.conjugate_gradient_steps`), zero without an image.

        Returns
        -------
        heights, spread : Tensor (B, F, 8, 8) [mm]
            Facet mean zero; the spread is the scale of a Laplace distribution of the error.
        """
        shares = descent.flatten(2) / self.scale  # (B, M, points)
        step = shares.sum(dim=1)  # (B, points)
        scaled = shares * mask.sum(dim=1)[:, None, None]  # (B, M, points)
        each = (images.flatten(0, 1) for images in (flux, guess_flux, conditions))  # (B M, ...)
        features = self.encoder(*each).view(*mask.shape, -1)  # (B, M, features)
        features = features + self.from_geometry(
            torch.cat([conditions, scaled], dim=2)
        )  # (B, M, features)
        pooled = self.norm(self.pooling(self.blocks(features), mask))  # (B, features)
        known = torch.cat(
            [pooled, guess.flatten(1) / self.scale, step], dim=1
        )  # (B, features + 2 points)
        heights, log_spread = (
            self.decoder(known).view(-1, 2, *guess.shape[1:]).unbind(1)
        )  # (B, F, 8, 8) each
        heights = heights + self.bypass(torch.cat([pooled, step], dim=1)).view_as(
            heights
        )  # (B, F, 8, 8)
        heights = heights - heights.mean(dim=(2, 3), keepdim=True)
        return guess + self.scale * heights, self.scale * torch.exp(log_spread.clamp(-6, 2))
