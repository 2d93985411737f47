"""Whether what a model leaves unexplained is the target's own pattern: marks and grid lines that no light made.

A pattern of the target stands still on the target while spots move over it; what the light's model lacks moves with the
spots.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.study.flux_images import FluxImage, centers

Array = NDArray[np.float64]

# Share of a spot's peak above which its light tells how much of it the target gives back.
_LIT = 0.3

# Correlation of photographs with each other from which on what they show is the target's, far more than that of grain,
# and by how much it must exceed that of the same photographs laid spot on spot.
_SURE, _MORE = 0.2, 0.15


@dataclass(frozen=True)
class Pattern:
    """How alike the residuals of different photographs are, place by place: correlations from -1 to 1.

    ``on_target`` where they are laid upon each other as the target lies, ``on_spot`` as the spots do; ``depth`` is the
    standard deviation [1] of what the target gives back of its light, as far as it is common to photographs.
    """

    on_target: float
    on_spot: float
    depth: float

    @property
    def is_targets(self) -> bool:
        """Whether the residual is the target's own pattern."""
        return self.on_target > _SURE and self.on_target > self.on_spot + _MORE


def pattern_of(images: Sequence[FluxImage], measured: Array, forecast: Array, window: float) -> Pattern:
    """The pattern in residuals of cuts (N, 64, 64) of side ``window`` [m] about the spots, each of sum one."""
    planes = [image.setup.plane for image in images]
    places = np.concatenate([centers(image.image[None], [image.setup.plane]) for image in images])
    size = measured.shape[-1]
    lit = forecast > _LIT * forecast.max(axis=(1, 2), keepdims=True)
    share = np.where(lit, measured / np.where(lit, forecast, 1) - 1, np.nan)
    # Whole pixels, right and down, from the target's middle to each window's.
    steps = np.rint(places / (window / size)).astype(int)
    names = [plane.name for plane in planes]
    on_target, depth = _alike(share, steps, names)
    return Pattern(on_target, _alike(share, np.zeros_like(steps), names)[0], depth)


def _alike(share: Array, steps: NDArray[np.int_], names: Sequence[str]) -> tuple[float, float]:
    """Correlation of each photograph with the mean of the others of its target, and the depth of what they share."""
    both = one = others = count = 0.0
    for name in set(names):
        of = [index for index, other in enumerate(names) if other == name]
        for mine, theirs in _pairs(share[of], steps[of]):
            both, count = both + float(mine @ theirs), count + len(mine)
            one, others = one + float(mine @ mine), others + float(theirs @ theirs)
    if one * others == 0:
        return 0.0, 0.0
    return both / np.sqrt(one * others), np.sqrt(max(both, 0.0) / count)


def _pairs(share: Array, steps: NDArray[np.int_]) -> list[tuple[Array, Array]]:
    """Each photograph's lit pixels, and the mean of the other photographs at the same places."""
    steps = steps - steps.min(axis=0)
    columns, rows = steps.max(axis=0) + share.shape[-1]
    canvas = np.full((len(share), rows, columns), np.nan)
    for layer, image, (right, down) in zip(canvas, share, steps, strict=True):
        layer[down : down + image.shape[0], right : right + image.shape[1]] = image - np.nanmean(image)
    pairs = []
    total, count = np.nansum(canvas, axis=0), np.isfinite(canvas).sum(axis=0)
    for layer in canvas:
        here = np.isfinite(layer) & (count > 1)
        pairs.append((layer[here], (total[here] - layer[here]) / (count[here] - 1)))
    return pairs
