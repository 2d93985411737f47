"""Separate the heliostat's spot from the target, in light (`model.imaging.light`).

The image is the sheet in daylight plus the flux. Dark lines, rivets and marks are filled first. A
smooth surface is fitted to the pixels off the spot, and subtracted. The remaining signal of the
main spot is kept. Its faint wings fade out softly, because a hard mask would truncate them.

Notes
-----
::

    image = sheet(x, y) + flux(x, y) + noise   sheet: a polynomial off the spot, and its residual
                                               there, bridged under the spot
    flux = max(0, image - sheet) * mask        mask: 1 on the main spot, falls smoothly to 0
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_LINE_WIDTH = 7  # [px] dark features up to this width are lines or rivets
_MARK_WIDTH = 41  # ... and up to this width marks
_LINE_FLANK = 3  # [px] by which lines are widened, for their blurred flanks
_LINE_DARKNESS, _MARK_DARKNESS = 0.03, 0.15  # relative to the surroundings
_GRAIN = 1.5  # [px] smoothing of the flux itself, far below the width of the sun's image
_SMOOTHING = 2.0  # [px] smoothing of the map that separates spots from noise
_ROUNDS = 12
_STRIDE = 4  # [px] step of the pixels for the fit of the surface
_SPOT_LEVEL = 3.0  # noise deviations above which a pixel may belong to a spot
_WING_SHARE = 0.01  # ... and share of the peak
# Shares of the peak; the first is the start of a core, because daylight is uneven.
_CUTS = (0.15, 0.2, 0.3, 0.4, 0.5, 0.6)
_VALLEY = 0.6  # of the lower peak: a deeper valley separates two spots
_WING_REACH = 0.8  # reach of wings beyond the core, relative to its mean radius
_MARGIN = 0.25  # margin around it for the light below the noise, in the same unit
_TENDRIL = 9  # [px] width up to which a bright streak at a spot belongs to the sheet
_MIN_AREA = 40  # [px] of a spot


@dataclass(frozen=True, eq=False)
class Separation:
    """The parts of a rectified image.

    Attributes
    ----------
    flux : float32 (rows, columns) [light]
        The main spot's flux, zero elsewhere.
    background : float32 (rows, columns) [light]
    smooth : float32 (rows, columns) [light]
        The whole smoothed signal with all spots.
    main, foreign : bool (rows, columns)
        Pixels of the main spot, and of other spots.
    noise : float [light]
        Deviation of ``smooth`` off the spots.
    """

    flux: Image
    background: Image
    smooth: Image
    main: Mask
    foreign: Mask
    noise: float


def separate(crop: Image) -> Separation:
    """Separate the spot on a rectified image (rows, columns), with 255 as the camera's maximum."""
    bridged, hidden = bridge_dark_features(crop)
    even = _blurred(bridged, _GRAIN)
    surface = fit_background(even, hidden)
    signal = _signal(even, surface, hidden)
    if signal.spots.main.any():
        # The first surface only finds the spots; the second is fitted to all pixels off them.
        surface = _polynomial(even, ~(signal.spots.main | signal.spots.foreign | hidden))
        signal = _signal(even, surface, hidden)
    main, foreign = signal.spots
    background = surface + _bridge_over(signal.smooth, main | foreign)
    flux = np.maximum(even - background, 0) * _feathered(main, foreign)
    return Separation(
        flux.astype(np.float32),
        background.astype(np.float32),
        np.asarray(signal.smooth, np.float32),
        main,
        foreign,
        signal.noise,
    )


class Spots(NamedTuple):
    """Masks of the main spot and of the other spots (rows, columns)."""

    main: Mask
    foreign: Mask


class _Signal(NamedTuple):
    """The smoothed signal above a surface, its noise, and its spots."""

    smooth: Image
    noise: float
    spots: Spots


def _signal(even: Image, surface: Image, hidden: Mask) -> _Signal:
    smooth = _blurred(even - surface, _SMOOTHING)
    noise = _noise(smooth, hidden)
    return _Signal(smooth, noise, find_spots(smooth, noise))


def _blurred(image: NDArray[np.floating], sigma: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma), dtype=np.float32)


class BridgedImage(NamedTuple):
    """An image with filled dark features, and the mask of its marks."""

    image: Image
    marks: Mask


def bridge_dark_features(crop: Image) -> BridgedImage:
    """Fill dark lines, rivets and marks from their surroundings."""
    gray = crop.astype(np.float32)
    # Marks are darker than the sheet. A gap between two spots, or between a spot and the edge, is
    # only darker than the spots.
    sheet = fit_background(gray, np.zeros(gray.shape, bool))
    hidden = _dark(gray, _MARK_WIDTH, _MARK_DARKNESS) & (gray < (1 - _MARK_DARKNESS) * sheet)
    hidden = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    lines = cv2.dilate(
        _dark(gray, _LINE_WIDTH, _LINE_DARKNESS).astype(np.uint8), _disc(_LINE_FLANK)
    ).astype(bool)
    return BridgedImage(_fill(gray, hidden | lines), hidden)


def _dark(gray: Image, width: int, darkness: float) -> Mask:
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (width, width))
    padded = cv2.copyMakeBorder(gray, width, width, width, width, cv2.BORDER_REFLECT_101)
    soft = _blurred(np.asarray(padded, dtype=np.float32), 0.7)
    closed = cv2.morphologyEx(soft, cv2.MORPH_CLOSE, kernel)
    relative = (closed - soft) / np.maximum(closed, 1.0)
    return np.asarray(relative[width:-width, width:-width] > darkness)


def _fill(gray: Image, holes: Mask) -> Image:
    """Fill holes by the weighted mean of their neighbours, from fine to coarse scales."""
    filled, missing = np.where(holes, 0, gray).astype(np.float32), holes.copy()
    for sigma in (1.0, 2.0, 4.0, 8.0, 16.0):
        weight = _blurred((~holes).astype(np.float32), sigma)
        mean = _blurred(np.where(holes, 0, gray).astype(np.float32), sigma)
        sure = missing & (weight > 0.1)
        filled[sure] = mean[sure] / weight[sure]
        missing &= ~sure
    if missing.any():
        filled[missing] = gray[~holes].mean() if (~holes).any() else gray.mean()
    return filled


def fit_background(gray: Image, hidden: Mask) -> Image:
    """Fit the sheet's brightness under and around the spot (rows, columns).

    A polynomial surface is fitted, in iterations, to the pixels that are not brighter than noise
    allows. If less of the sheet is free, the surface has a lower degree.
    """
    free = ~hidden
    surface = np.full(
        gray.shape, np.median(gray[free]) if free.any() else gray.mean(), dtype=np.float32
    )
    smooth = _blurred(gray, _SMOOTHING)
    for round_ in range(_ROUNDS):
        residual = smooth - surface
        below = residual[free & (residual < 0)]
        spread = max(float(np.sqrt(np.mean(below**2))) if below.size else 0.0, 0.5)
        keep = free & (residual < 1.5 * spread) & (residual > -4 * spread)
        if round_ >= 4:
            bright = ((residual > 2 * spread) & free).astype(np.uint8)
            opened = cv2.morphologyEx(bright, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
            keep &= ~cv2.dilate(opened, np.ones((15, 15), np.uint8)).astype(bool)
        surface = _polynomial(smooth, keep, round_ // 2 + 1)
    return surface


def _polynomial(gray: Image, keep: Mask, most: int = 3) -> Image:
    """Fit a polynomial surface to the kept pixels.

    Its degree depends on their share of the sheet. Its normal equations are moments of the image,
    which separate into rows and columns.
    """
    share = keep.mean()
    degree = min(3 if share > 0.35 else 2 if share > 0.15 else 1, most)
    y, x = (np.linspace(-1, 1, count) for count in gray.shape)
    weight = keep[::_STRIDE, ::_STRIDE].astype(np.float64)
    if weight.sum() < 64:
        return np.full(gray.shape, float(np.percentile(gray, 20)), dtype=np.float32)
    y_powers, x_powers = (
        np.vander(axis[::_STRIDE], 2 * degree + 1, increasing=True) for axis in (y, x)
    )
    moments = y_powers.T @ weight @ x_powers
    right = y_powers.T @ (weight * gray[::_STRIDE, ::_STRIDE]) @ x_powers
    terms = [(j, i) for j in range(degree + 1) for i in range(degree + 1 - j)]
    matrix = np.array([[moments[j + n, i + m] for n, m in terms] for j, i in terms])
    solution = np.linalg.lstsq(matrix, np.array([right[term] for term in terms]), rcond=None)[0]
    coefficients = np.zeros((degree + 1, degree + 1))
    for term, value in zip(terms, solution, strict=True):
        coefficients[term] = value
    return np.asarray(np.polynomial.polynomial.polygrid2d(y, x, coefficients), dtype=np.float32)


def _bridge_over(residual: Image, spots: Mask) -> Image:
    """Interpolate the remaining brightness of the sheet smoothly across the spots.

    Outside, it follows shadow edges and glare. Under a spot it is a push-pull interpolation:
    averages over increasing cells, then from coarse to fine (Gortler et al. 1996, The Lumigraph).
    """
    known = (~spots).astype(np.float32)
    return _blurred(_push_pull(residual * known, known), _SMOOTHING)


def _push_pull(weighted: Image, weight: Image) -> Image:
    if min(weight.shape) <= 2:
        return np.full(
            weight.shape, weighted.sum() / max(float(weight.sum()), 1e-6), dtype=np.float32
        )
    halved = (np.asarray(cv2.pyrDown(image), dtype=np.float32) for image in (weighted, weight))
    coarse = _push_pull(*halved)
    spread = cv2.pyrUp(coarse, dstsize=(weight.shape[1], weight.shape[0]))
    sure = np.minimum(weight, 1.0)
    return np.where(
        weight > 0, sure * weighted / np.maximum(weight, 1e-6) + (1 - sure) * spread, spread
    )


def _noise(smooth: Image, hidden: Mask) -> float:
    """Deviation of a map about zero, from its lower half, because spots only add."""
    below = smooth[~hidden & (smooth < 0)]
    return max(float(1.4826 * np.median(-below)) if below.size else 0.0, 0.25)


def find_spots(smooth: Image, noise: float) -> Spots:
    """Find the spots in a smoothed signal.

    The main spot has the most energy. A spot is a core and the wings around it, so that a sunlit
    patch next to the wings does not count as its light.
    """
    cores = _cores(smooth, noise)
    if not cores:
        return Spots(*np.zeros((2, *smooth.shape), bool))
    level = max(_SPOT_LEVEL * noise, _WING_SHARE * float(smooth.max()))
    regions = _nearest(cores)
    masks = [_with_wings(smooth > level, core, regions == i) for i, core in enumerate(cores)]
    energies = [float(smooth[mask].sum()) for mask in masks]
    main = masks[int(np.argmax(energies))]
    return Spots(main, np.any(masks, axis=0) & ~main)


def _cores(smooth: Image, noise: float) -> list[Mask]:
    """The bright cores of the spots.

    The signal is thresholded at increasing levels. If a core splits into peaks well above the
    level, it is several overlapping spots. Shallower valleys are between the facets' images of one
    heliostat.
    """
    cores = [np.ones(smooth.shape, bool)]
    for share in _CUTS:
        level = max(_SPOT_LEVEL * noise, share * float(smooth.max()))
        divided: list[Mask] = []
        for core in cores:
            peaks = _peaks_above(smooth, core, level)
            if share == _CUTS[0] or not peaks:
                divided += peaks if share == _CUTS[0] else [core]
            else:
                nearest = _nearest(peaks)
                divided += [core & (nearest == i) for i in range(len(peaks))]
        cores = divided
    return cores


def _peaks_above(smooth: Image, core: Mask, level: float) -> list[Mask]:
    """The connected parts of a core that are large enough and rise well above a level."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        ((smooth > level) & core).astype(np.uint8), connectivity=8
    )
    parts = [labels == i for i in range(1, len(stats)) if stats[i, cv2.CC_STAT_AREA] >= _MIN_AREA]
    return [part for part in parts if level < _VALLEY * float(smooth[part].max())]


def _nearest(shapes: list[Mask]) -> NDArray[np.int32]:
    """The index of every pixel's nearest shape."""
    distances = [
        cv2.distanceTransform((~shape).astype(np.uint8), cv2.DIST_L2, 5) for shape in shapes
    ]
    return np.asarray(np.argmin(distances, axis=0), dtype=np.int32)


def _with_wings(bright: Mask, core: Mask, region: Mask) -> Mask:
    """A core with the bright pixels around it."""
    distance = cv2.distanceTransform((~core).astype(np.uint8), cv2.DIST_L2, 5)
    near = bright & region & (distance < _WING_REACH * _radius(core))
    # Opening removes thin streaks along seams and wrinkles of the sheet.
    compact = cv2.morphologyEx(near.astype(np.uint8), cv2.MORPH_OPEN, _disc(_TENDRIL))
    _, labels = cv2.connectedComponents(
        (compact.astype(bool) | core).astype(np.uint8), connectivity=8
    )
    joined = np.isin(labels, np.unique(labels[core])).astype(np.uint8)
    wider = cv2.dilate(joined, _disc(max(3, round(2 * _MARGIN * _radius(core)) | 1))).astype(bool)
    return np.asarray(wider & region)


def _disc(diameter: int) -> NDArray[np.uint8]:
    return np.asarray(
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter)), dtype=np.uint8
    )


def _radius(mask: Mask) -> float:
    return float(np.sqrt(mask.sum() / np.pi))


def _feathered(main: Mask, foreign: Mask, reach: float = 6.0) -> Image:
    """Weight 1 in the main spot, falling to 0 around it, and 0 in other spots.

    ``reach`` [px] is the standard deviation of the fall, a Gaussian.
    """
    if not main.any():
        return np.zeros(main.shape, np.float32)
    distance = cv2.distanceTransform((~main).astype(np.uint8), cv2.DIST_L2, 5)
    weight = np.exp(-0.5 * (distance / reach) ** 2)
    weight[foreign] = 0
    return np.asarray(weight, dtype=np.float32)
