"""Test whether the residuals of a model are a pattern of the target, such as marks and grid lines.

A pattern of the target stays at the same place on the target while spots move over it. Residuals
of the flux model move with the spots.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.study.flux_images import FluxImage, centers

Array = NDArray[np.float64]

# Share of a spot's peak above which its flux gives an estimate of the target's reflectance.
_LIT = 0.3

# Smallest correlation of photographs by a pattern, far above that of grain, and its smallest excess
# over the correlation of the same photographs superposed by their spots.
_SURE, _MORE = 0.2, 0.15


@dataclass(frozen=True)
class Pattern:
    """Correlations of the residuals of different photographs, from -1 to 1.

    Photographs are superposed by the target for ``on_target``, and by the spots for ``on_spot``.
    ``depth`` is the standard deviation [1] of the target's reflectance that photographs share.
    """

    on_target: float
    on_spot: float
    depth: float

    @property
    def is_targets(self) -> bool:
        """Whether the residual is the target's own pattern."""
        return self.on_target > _SURE and self.on_target > self.on_spot + _MORE


def pattern_of(
    images: Sequence[FluxImage], measured: Array, forecast: Array, window: float
) -> Pattern:
    """Find the pattern in residuals of cuts (N, 64, 64) of side ``window`` [m] and sum one."""
    planes = [image.setup.plane for image in images]
    places = np.concatenate([centers(image.image[None], [image.setup.plane]) for image in images])
    size = measured.shape[-1]
    lit = forecast > _LIT * forecast.max(axis=(1, 2), keepdims=True)
    share = np.where(lit, measured / np.where(lit, forecast, 1) - 1, np.nan)
    # Whole pixels, right and down, from the target's centre to each window's.
    steps = np.rint(places / (window / size)).astype(int)
    names = [plane.name for plane in planes]
    on_target = _common_part(share, steps, names)
    on_spot = _common_part(share, np.zeros_like(steps), names)
    return Pattern(on_target.correlation, on_spot.correlation, on_target.depth)


class _CommonPart(NamedTuple):
    """Correlation of photographs with the means of the others, and their common deviation [1]."""

    correlation: float
    depth: float


def _common_part(share: Array, steps: NDArray[np.int_], names: Sequence[str]) -> _CommonPart:
    """Correlate each photograph with the mean of the others of its target."""
    both = first = second = count = 0.0
    for name in set(names):
        rows = [row for row, other in enumerate(names) if other == name]
        for lit, mean in _pairs(share[rows], steps[rows]):
            both, count = both + float(lit @ mean), count + len(lit)
            first, second = first + float(lit @ lit), second + float(mean @ mean)
    if first * second == 0:
        return _CommonPart(0.0, 0.0)
    return _CommonPart(both / np.sqrt(first * second), np.sqrt(max(both, 0.0) / count))


def _pairs(share: Array, steps: NDArray[np.int_]) -> list[tuple[Array, Array]]:
    """Lit pixels of each photograph, and the mean of the other photographs at the same places."""
    steps = steps - steps.min(axis=0)
    columns, rows = steps.max(axis=0) + share.shape[-1]
    canvas = np.full((len(share), rows, columns), np.nan)
    for layer, image, (right, down) in zip(canvas, share, steps, strict=True):
        layer[down : down + image.shape[0], right : right + image.shape[1]] = image - np.nanmean(
            image
        )
    pairs = []
    total, count = np.nansum(canvas, axis=0), np.isfinite(canvas).sum(axis=0)
    for layer in canvas:
        here = np.isfinite(layer) & (count > 1)
        pairs.append((layer[here], (total[here] - layer[here]) / (count[here] - 1)))
    return pairs
