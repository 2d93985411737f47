"""Parts of a network that were tried and do not pay (`training.ablate`).

`PartsNetwork` is the one that was shipped before, and may be had without each of its parts: convolutions whose weights
are modulated by the geometry and demodulated as in StyleGAN2, attention among images, a StyleGAN2 decoder of narrow
styles. With a vision transformer in place of the convolutions it is built as the network of Lewen et al. 2025.
`coarse` and `blind` take something away from today's; `steepest_descents` show it a shorter step.

Source: Lewen et al. 2024, *Inverse Deep Learning Ray Tracing for Heliostat Surface Prediction*; Lewen et al. 2025,
arXiv 2504.03712 (vision transformer before a StyleGAN2 decoder); Karras et al. 2020, *Analyzing and Improving the Image
Quality of StyleGAN* (modulation and demodulation).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from model.images import binned
from model.network.architecture import CONDITIONS, SurfaceNetwork
from model.network.inputs import DESCENT_NOISE, STEP_HEIGHT
from model.surface import COLUMNS, FACETS, ROWS


@dataclass(frozen=True)
class PartsConfig:
    """Sizes of the network, and which of its parts it has; the names are those used below."""

    modulation: bool = True
    attention: bool = True
    vision_transformer: bool = False
    style_decoder: bool = True
    encoder_channels: tuple[int, int, int] = (64, 128, 256)
    features: int = 256
    heads: int = 4
    depth: int = 3
    tokens: int = 128
    encoder_depth: int = 4
    style_layers: int = 3
    style_features: int = 32
    decoder_channels: int = 128


def activate(x: Tensor) -> Tensor:
    """Leaky rectifier with the gain that keeps the variance (Karras et al. 2020)."""
    return functional.leaky_relu(x, 0.2) * 2**0.5


class ModulatedConv(nn.Module):
    """A 3x3 convolution whose weights are scaled per sample by a style and normalised again.

    Scaling the input channels by s and the output by 1/sqrt(sum (w s)^2) equals convolving with the modulated and
    demodulated weights (Karras et al. 2020, eqs. 1 and 3), and needs no grouped convolution.
    """

    def __init__(
        self, inputs: int, outputs: int, style: int, stride: int = 1, demodulate: bool = True, modulate: bool = True
    ) -> None:
        super().__init__()
        self.shift = None if modulate else nn.Linear(style, outputs)
        self.weight = nn.Parameter(torch.randn(outputs, inputs, 3, 3) / (3 * inputs**0.5))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.to_scale = nn.Linear(style, inputs)
        nn.init.ones_(self.to_scale.bias)
        self.stride, self.demodulate = stride, demodulate

    def forward(self, x: Tensor, style: Tensor) -> Tensor:
        """(N, inputs, H, W) and (N, style) to (N, outputs, H / stride, W / stride)."""
        scale = self.to_scale(style)  # (N, inputs)
        if self.shift is not None:
            scale = torch.ones_like(scale)
        x = functional.conv2d(x * scale[:, :, None, None], self.weight, stride=self.stride, padding=1)
        if self.demodulate:
            energy = scale.square() @ self.weight.square().sum(dim=(2, 3)).T  # (N, outputs)
            x = x * torch.rsqrt(energy + 1e-8)[:, :, None, None]
        if self.shift is not None:
            x = x + self.shift(style)[:, :, None, None]
        return x + self.bias[:, None, None]


class EncoderBlock(nn.Module):
    """Two modulated convolutions with a skip; the first halves the resolution where ``stride`` is two."""

    def __init__(self, inputs: int, outputs: int, style: int, stride: int, modulate: bool) -> None:
        super().__init__()
        self.first = ModulatedConv(inputs, outputs, style, stride, modulate=modulate)
        self.second = ModulatedConv(outputs, outputs, style, modulate=modulate)
        self.skip = nn.Conv2d(inputs, outputs, kernel_size=stride, stride=stride)

    def forward(self, x: Tensor, style: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        y = activate(self.first(x, style))  # (N, outputs, H / stride, W / stride)
        return activate((self.second(y, style) + self.skip(x)) * 0.5**0.5)


class Encoder(nn.Module):
    """One flux image, that of the guess and their geometry to a feature vector."""

    def __init__(self, config: PartsConfig) -> None:
        super().__init__()
        fine, middle, coarse = config.encoder_channels
        self.style = nn.Sequential(
            nn.Linear(CONDITIONS, 128), nn.LeakyReLU(0.2), nn.Linear(128, 128), nn.LeakyReLU(0.2)
        )
        self.fold = nn.PixelUnshuffle(4)
        self.blocks = nn.ModuleList(
            [
                EncoderBlock(4 * 16, fine, 128, 1, config.modulation),
                EncoderBlock(fine, middle, 128, 2, config.modulation),
                EncoderBlock(middle, coarse, 128, 2, config.modulation),
            ]
        )
        self.to_features = nn.Sequential(nn.Linear(coarse * 16 + 128, config.features), nn.LayerNorm(config.features))

    def forward(self, flux: Tensor, guess_flux: Tensor, conditions: Tensor) -> Tensor:
        """Fluxes (N, 64, 64) of sum 100 and conditions (N, 12) to features (N, features)."""
        style = self.style(conditions)  # (N, 128)
        x = torch.cat([_channels(flux), _channels(guess_flux)], dim=1)  # (N, 4, 64, 64)
        x = self.fold(x)  # (N, 64, 16, 16)
        for block in self.blocks:
            x = block(x, style)  # (N, fine, 16, 16), (N, middle, 8, 8), (N, coarse, 4, 4)
        features: Tensor = self.to_features(torch.cat([x.flatten(1), style], dim=1))  # (N, features)
        return features


def _channels(flux: Tensor) -> Tensor:
    """Flux (N, 64, 64) and its root (N, 2, 64, 64), which brings out the faint wings, where the mirror's edges show."""
    return torch.stack([flux * 8, torch.sqrt(flux.clamp(min=0) * 8)], dim=1)


class Attention(nn.Module):
    """A heliostat's images look at one another: a transformer's block, masked for missing images."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.to_qkv = nn.Linear(width, 3 * width)
        self.mix = nn.Linear(width, width)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, features: Tensor, hidden: Tensor) -> Tensor:
        """(B, M, width) to the same; ``hidden`` (B, M) is zero, very negative where there is no image."""
        batch, images, width = features.shape
        if not self.heads:
            return torch.as_tensor(features + self.mlp(features))
        qkv = self.to_qkv(self.norm(features)).view(batch, images, 3, self.heads, width // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)  # (B, heads, M, width / heads) each
        scores = q @ k.transpose(-1, -2) * (width // self.heads) ** -0.5  # (B, heads, M, M)
        scores = scores + hidden[:, None, None, :]
        mixed = (scores.softmax(dim=-1) @ v).transpose(1, 2).reshape(batch, images, width)  # (B, M, width)
        features = features + self.mix(mixed)
        features = features + self.mlp(features)  # (B, M, width)
        return features


class VisionTransformer(nn.Module):
    """As `Encoder`, by a transformer of patches of 8 x 8 pixels beside a token of the geometry."""

    def __init__(self, config: PartsConfig) -> None:
        super().__init__()
        width = config.tokens
        self.fold = nn.PixelUnshuffle(8)
        self.from_patch = nn.Linear(4 * 64, width)
        self.place = nn.Parameter(torch.randn(64, width) * 0.02)
        self.from_conditions = nn.Linear(CONDITIONS, width)
        self.blocks = nn.ModuleList([Attention(width, config.heads) for _ in range(config.encoder_depth)])
        self.to_features = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, config.features))

    def forward(self, flux: Tensor, guess_flux: Tensor, conditions: Tensor) -> Tensor:
        """Fluxes (N, 64, 64) of sum 100 and conditions (N, 12) to features (N, features)."""
        x = torch.cat([_channels(flux), _channels(guess_flux)], dim=1)  # (N, 4, 64, 64)
        patches = self.from_patch(self.fold(x).flatten(2).transpose(1, 2)) + self.place  # (N, 64, width)
        x = torch.cat([self.from_conditions(conditions)[:, None], patches], dim=1)  # (N, 65, width)
        nothing_hidden = x.new_zeros(x.shape[:2])  # (N, 65)
        for block in self.blocks:
            x = block(x, nothing_hidden)  # (N, 65, width)
        features: Tensor = self.to_features(x.mean(dim=1))  # (N, features)
        return features


class Pooling(nn.Module):
    """Attention among a heliostat's images, then one vector for all; blind to order.

    Each feature has its own weights: one image may tell most of one facet, another of the next.
    """

    def __init__(self, config: PartsConfig) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            [Attention(config.features, config.heads if config.attention else 0) for _ in range(config.depth)]
        )
        self.to_weights = nn.Linear(config.features, config.features)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        """(B, M, features) and mask (B, M), one where there is an image, to (B, features)."""
        hidden = (mask - 1) * 1e4  # (B, M)
        for block in self.blocks:
            features = block(features, hidden)  # (B, M, features)
        weights = (self.to_weights(features) + hidden[..., None]).softmax(dim=1)  # (B, M, features)
        pooled: Tensor = (features * weights).sum(dim=1)  # (B, features)
        return pooled


class Decoder(nn.Module):
    """Styles w+ to the heights and their uncertainty, one channel a facet (StyleGAN2 without noise inputs)."""

    def __init__(self, config: PartsConfig) -> None:
        super().__init__()
        channels, style = config.decoder_channels, config.style_features
        self.seed = nn.Parameter(torch.randn(channels, ROWS // 2, COLUMNS // 2))
        self.convs = nn.ModuleList([ModulatedConv(channels, channels, style) for _ in range(config.style_layers)])
        self.to_heights = ModulatedConv(channels, 2 * FACETS, style, demodulate=False)

    def forward(self, styles: Tensor) -> tuple[Tensor, Tensor]:
        """(B, layers, style) to heights and log spreads, each (B, 4, 8, 8)."""
        x = self.seed.expand(styles.shape[0], -1, -1, -1)  # (B, channels, 4, 4)
        for layer, conv in enumerate(self.convs):
            if layer == 1:
                x = functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
            x = activate(conv(x, styles[:, layer]))  # (B, channels, 4, 4), then (B, channels, 8, 8)
        heights, log_spread = self.to_heights(x, styles[:, -1]).chunk(2, dim=1)  # (B, 4, 8, 8) each
        return heights, log_spread


class PartsNetwork(nn.Module):
    """Flux images and a guess to control heights [mm] and the spread of their error [mm].

    ``scale`` [mm] is the unit in which the network thinks of heights.
    """

    def __init__(self, config: PartsConfig, scale: float = 0.35) -> None:
        super().__init__()
        self.config, self.scale = config, scale
        points = FACETS * ROWS * COLUMNS
        self.encoder = VisionTransformer(config) if config.vision_transformer else Encoder(config)
        self.from_descent = nn.Linear(points, config.features)
        self.pooling = Pooling(config)
        self.from_guess = nn.Linear(points, config.features)
        self.from_step = nn.Linear(points, config.features)
        self.to_styles = nn.Sequential(
            nn.LayerNorm(config.features),
            nn.Linear(config.features, config.features),
            nn.LeakyReLU(0.2),
            nn.Linear(config.features, config.style_layers * config.style_features),
        )
        self.decoder = Decoder(config) if config.style_decoder else None
        self.to_spread = nn.Linear(config.features, points)
        # What is nearly linear in the images passes by the narrow styles.
        self.bypass = nn.Linear(config.features + points, points)
        nn.init.zeros_(self.bypass.weight)
        nn.init.zeros_(self.bypass.bias)

    def forward(
        self, flux: Tensor, conditions: Tensor, mask: Tensor, guess_flux: Tensor, guess: Tensor, descent: Tensor
    ) -> tuple[Tensor, Tensor]:
        """As `model.network.architecture.SurfaceNetwork.forward`."""
        shares = descent.flatten(2) / self.scale  # (B, M, points)
        step = shares.sum(dim=1)  # (B, points)
        each = (images.flatten(0, 1) for images in (flux, guess_flux, conditions))  # (B M, ...)
        features = self.encoder(*each).view(*mask.shape, -1)  # (B, M, features)
        alone = shares * mask.sum(dim=1)[:, None, None]  # (B, M, points)
        pooled = self.pooling(features + self.from_descent(alone), mask)  # (B, features)
        pooled = pooled + self.from_guess(guess.flatten(1) / self.scale) + self.from_step(step)  # (B, features)
        heights = self.bypass(torch.cat([pooled, step], dim=1)).view_as(guess)  # (B, 4, 8, 8)
        if self.decoder is None:
            log_spread = self.to_spread(pooled).view_as(guess)
        else:
            styles = self.to_styles(pooled)  # (B, layers * style)
            styles = styles.view(-1, self.config.style_layers, self.config.style_features)  # (B, layers, style)
            grown, log_spread = self.decoder(styles)  # (B, 4, 8, 8) each
            heights = heights + grown
        heights = heights - heights.mean(dim=(2, 3), keepdim=True)
        return guess + self.scale * heights, self.scale * torch.exp(log_spread.clamp(-6, 2))


def coarse(network: SurfaceNetwork) -> SurfaceNetwork:
    """Today's network, of images of 32 x 32 pixels."""
    encoder = network.encoder
    encoder.fold = nn.Sequential(nn.AvgPool2d(2), nn.PixelUnshuffle(4))  # type: ignore[assignment]
    encoder.to_features = nn.Linear(encoder.to_features.in_features // 4, encoder.to_features.out_features)
    return network


def blind(network: SurfaceNetwork) -> SurfaceNetwork:
    """Today's network, without images: all that it sees is guess, descents and geometry."""
    network.encoder = _Nothing(network.config.features)  # type: ignore[assignment]
    return network


class _Nothing(nn.Module):
    def __init__(self, features: int) -> None:
        super().__init__()
        self.features = features

    def forward(self, flux: Tensor, guess_flux: Tensor, conditions: Tensor) -> Tensor:
        return flux.new_zeros(len(flux), self.features)


CHANGES = {"": lambda network: network, "coarse": coarse, "blind": blind}
"""What may be changed in today's network, by name."""


def steepest_descents(trace: Callable[[Tensor], Tensor], flux: Tensor, basis: Tensor) -> Tensor:
    """As `model.network.inputs.descents`, by one step of steepest descent that takes cameras at their word."""
    directions = basis.flatten(1)
    with torch.enable_grad():
        changes = torch.zeros(*flux.shape[:2], *basis.shape[1:], device=flux.device, requires_grad=True)
        guessed = trace(changes)
        measured = binned(flux, guessed.shape[-1])
        unit = DESCENT_NOISE * measured.amax(dim=(2, 3), keepdim=True)
        misfit = (((measured - guessed) / unit) ** 2).sum() / 2
        (gradient,) = torch.autograd.grad(misfit, changes)
    downhill = -gradient.flatten(2) @ directions.T
    along = downhill.sum(dim=1)
    along = along / along.norm(dim=1, keepdim=True).clamp(min=1e-12)
    heights = (along @ directions).view(-1, 1, *basis.shape[1:])
    step = STEP_HEIGHT / heights.square().mean(dim=(1, 2, 3, 4)).sqrt().clamp(min=1e-12)
    with torch.no_grad():
        moved = trace((step[:, None, None, None, None] * heights).expand_as(changes)) - guessed.detach()
        curvature = (moved / unit).square().sum(dim=(1, 2, 3)) / step**2
    shares = downhill / (1 + curvature)[:, None, None]
    return torch.einsum("bmk,kfij->bmfij", shares, basis)
