"""The noise of a photograph, read from the photograph alone.

Grain is what no smooth light explains. What is cut at black leaves no grain but a lift: where there
is no light, noise below zero is lost and noise above it stays. Hot and dead pixels are no grain:
they are spikes at the same places of all photographs (`hot_pixels`).

Notes
-----
::

    g = (L * image)**2 / 36,  L = [1 -2 1]' [1 -2 1]   grain; planes and slopes give zero
    variance(level) = line through the means of g      read noise, rounding and counting
    lift = sigma (phi(a) - a Phi(-a)),  Phi(-a) = share of black pixels   (`black_lift`)

    spike: |image - median| > SPIKE s(level)           s by the 90 % quantile at a level

Sources: Immerkaer (1996), doi:10.1006/cviu.1996.0060, and Tobin (1958), doi:10.2307/1907382.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, median_filter, uniform_filter
from scipy.stats import norm

Array = NDArray[np.float64]

SPACING = 2
"""Pixels between those that are compared: neighbours share the noise of a coarse camera."""

MIN_BLACK = 0.01
"""Share of black pixels below which an image is not cut at black."""

BLOCK = 9
"""Pixels a side over which the share of black ones is counted."""

AROUND = 5
"""Pixels a side of a spike's surroundings: spikes of up to 3 x 3 are found."""

SPIKE = 6.0
"""Deviation from that median, in standard deviations, beyond which a pixel is a spike."""

MIN_IMAGES = 4
"""Smallest number of photographs that show which pixels are hot or dead."""

LEVELS = 12
"""Number of parts of an image, by intensity, each with its own noise."""


def spikes(image: Array) -> NDArray[np.bool_]:
    """Pixels (rows, columns) that are far from the median of their surroundings.

    Its light must be smooth over `AROUND` pixels.
    """
    smooth = median_filter(image, AROUND)
    off, found = np.abs(image - smooth).ravel(), np.zeros(image.size, dtype=bool)
    step = off[off > 0].min(initial=np.inf)  # of levels, where most pixels are cut at black
    for part in np.array_split(np.argsort(smooth, axis=None), LEVELS):
        usual = max(np.quantile(off[part], 0.9) / norm.ppf(0.95), step)
        found[part] = off[part] > SPIKE * usual
    return found.reshape(image.shape)


def hot_pixels(images: Sequence[NDArray[np.floating]]) -> NDArray[np.bool_]:
    """Pixels (rows, columns) that are `spikes` of most images; none of fewer than `MIN_IMAGES`."""
    if len(images) < MIN_IMAGES:
        return np.zeros(images[0].shape, dtype=bool)
    return np.asarray(np.mean([spikes(image.astype(np.float64)) for image in images], axis=0) > 0.5)


def grain_variance(image: Array, spacing: int = SPACING) -> Array:
    """Variance of each pixel's noise (rows, columns), which is linear in its intensity."""
    grain, inner = _grain(image, spacing), image[spacing:-spacing, spacing:-spacing]
    parts = np.array_split(np.argsort(inner, axis=None), LEVELS)
    levels = np.array([inner.ravel()[part].mean() for part in parts])
    variances = np.array([grain.ravel()[part].mean() for part in parts])
    lever = levels - levels.mean()
    slope = lever @ variances / max(float(lever @ lever), 1e-30)  # an even image has one level
    line = variances.mean() + slope * (image - levels.mean())
    return np.asarray(np.clip(line, variances.min(), variances.max()))


def _grain(image: Array, spacing: int) -> Array:
    """Squares of the mask's responses (rows - 2 spacing, columns - 2 spacing)."""
    lines = image[: -2 * spacing] - 2 * image[spacing:-spacing] + image[2 * spacing :]
    columns = lines[:, : -2 * spacing] - 2 * lines[:, spacing:-spacing] + lines[:, 2 * spacing :]
    return np.asarray((columns / 6) ** 2)


def black_lift(image: NDArray[np.floating]) -> Array:
    """What noise that is cut at black lifts each pixel by on the average (rows, columns).

    A normal variable of mean a sigma that is cut at zero is lifted, and the share Phi(-a) of its
    values is cut. No more can be lifted than is there. That such a lift also moves the centre of
    mass is not counted.
    """
    above = np.asarray(image - image.min(), dtype=np.float64)
    black = above == 0
    if min(above.shape) < BLOCK or not MIN_BLACK <= black.mean() < 1:
        return np.zeros_like(above)
    grey = ~maximum_filter(black, 3)[1:-1, 1:-1]
    faint = grey & (above <= np.quantile(above[~black], 0.25))[1:-1, 1:-1]
    if not faint.any():
        return np.zeros_like(above)
    sigma = np.sqrt(_grain(above, 1)[faint].mean())
    share = uniform_filter(black.astype(np.float64), BLOCK, mode="nearest")
    a = norm.isf(np.clip(share, 1e-9, 0.5))
    lift = sigma * (norm.pdf(a) - a * norm.cdf(-a))
    return np.asarray(np.minimum(lift, uniform_filter(above, BLOCK, mode="nearest")))
