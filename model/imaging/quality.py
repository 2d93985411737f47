"""Quality of a photograph: a few measures, and the limits for its rejection."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.imaging.separate import Separation
from model.imaging.strips import row_strips

SATURATED_GRAY = 250
_LOWEST_CEILING = 240  # a frame that was averaged or scaled has its largest count below 255
_PILE = 6.0  # ratio of pixels at three counts from a ceiling on to those at a count below it
# Least share of the image for one count below: chance makes small accumulations.
_MIN_PILE = 1.2e-4
# Of a saturated area only the rim and a lower bound of the light are known. A spot with a small rim
# has little information. On real photographs the accuracy of forecasts falls slowly up to this
# limit.
_LIMIT_SATURATED = 0.6
# Real photographs with one side removed, up to half of their light, are forecast as well as whole
# ones (benchmarks/cut.py). From this value on the estimate no longer grows: more may be
# missing than is visible.
_LIMIT_CUT = 0.3
_LIMIT_SECOND = 0.40
# In light, 300 real empty targets show patches of at most 0.33 of the background; 86 real spots
# start at 0.9.
_MIN_CONTRAST = 0.36
_MIN_CERTAINTY = 10.0
_CERTAIN = 30.0
_MIN_AREA = 0.003

_REMEDY = {
    "no_spot": (
        "no spot is brighter than the target around it; photograph while the heliostat is on target"
    ),
    "low_signal": (
        "the spot is too faint against daylight and texture; give an empty-target reference or more"
        " exposure"
    ),
    "saturated": "the spot's centre is beyond the camera's range; shorten the exposure",
    "cut": "the spot runs over the target's edge; aim the heliostat at the target's centre",
    "second_spot": (
        "another spot is about as strong, so it is unknown which is meant; clear the target of"
        " others"
    ),
}


def ceiling(counts: NDArray[np.uint8]) -> int:
    """The count from which on an image (rows, columns) is saturated.

    Pixels accumulate there. Frames that were averaged or scaled have their plateau below 255, real
    ones at 245 to 253. The result is `SATURATED_GRAY` if there is no accumulation below it.
    """
    pixels = np.bincount(counts.ravel(), minlength=256)
    for level in range(_LOWEST_CEILING, SATURATED_GRAY + 2):
        below = max(float(pixels[level - 12 : level - 2].mean()), _MIN_PILE * counts.size)
        if pixels[level : level + 3].sum() > _PILE * below and pixels[level] > 1.5 * below:
            return level - 2  # interpolation has spread the plateau's edge
    return SATURATED_GRAY


def cut_off_at(counts: NDArray[np.unsignedinteger], most: int) -> int | None:
    """The count at which the range of a 16-bit image (rows, columns) ends too early, or None.

    If a camera has fewer bits, or a black level was subtracted, pixels accumulate at one count. It
    is too far below ``most``, the largest count, for `ceiling` to find it.
    """
    strips = (counts[strip].ravel() for strip in row_strips(counts.shape))
    pixels = np.sum([np.bincount(strip, minlength=1 << 16) for strip in strips], axis=0)
    for level in (*((1 << bits) - 1 for bits in range(10, 16)), int(counts.max())):
        if 255 * level < _LOWEST_CEILING * most:
            below = 0.1 * float(pixels[level - 12 * level // 255 : level - 2 * level // 255].sum())
            if pixels[level] > _PILE * max(below, _MIN_PILE * counts.size):
                return level
    return None


@dataclass(frozen=True)
class Quality:
    """The quality of a photograph.

    Attributes
    ----------
    accepted : bool
    reason : str or None
        Short code of the rejection: ``target_not_found``, ``no_spot``, ``low_signal``,
        ``saturated``, ``cut`` or ``second_spot``.
    detail : str or None
        One sentence with the remedy.
    saturated_share : float [1]
        Share of the spot's bright area (above half its peak) where the gray value is at the
        camera's limit.
    clipped_share : float [1]
        The same where at least one colour is at the limit. More light still increases the gray
        value there, but less than in proportion.
    cut_share : float [1]
        Estimated share of the spot's energy that misses the target.
    signal_to_background : float [1]
        The spot's peak divided by the target's brightness there. For separated flux, the divisor is
        the mean level off the spot.
    energy_outside_window : float [1]
        Share of the spot's energy outside of the centered window.
    second_spot_share : float [1]
        Energy of other spots on the target, divided by the energy of all.
    signal_to_noise : float [1]
        The spot's peak divided by the deviation of the smoothed background.
    spot_area_share : float [1]
        Area of the spot with its wings, divided by the target's area.
    sheet_share : float [1]
        Share of the flux that the sheet's pattern displaces within the spot, estimated from the
        pattern off the spot.
    """

    accepted: bool
    reason: str | None = None
    detail: str | None = None
    saturated_share: float = 0.0
    clipped_share: float = 0.0
    cut_share: float = 0.0
    signal_to_background: float = 0.0
    energy_outside_window: float = 0.0
    second_spot_share: float = 0.0
    signal_to_noise: float = 0.0
    spot_area_share: float = 0.0
    sheet_share: float = 0.0


def judge(
    parts: Separation,
    saturated: NDArray[np.bool_],
    clipped: NDArray[np.bool_],
    energy_outside_window: float,
) -> Quality:
    """Compute the quality of a separated image; reject it if a limit is exceeded.

    Parameters
    ----------
    parts : Separation
    saturated, clipped : bool (rows, columns)
        Pixels with the gray value, and with at least one colour, at the camera's limit.
    energy_outside_window : float [1]
    """
    if not parts.main.any():
        return refused("no_spot")
    peak = float(np.percentile(parts.smooth[parts.main], 99))
    contrast = peak / max(float(parts.background[parts.main].mean()), 1.0)
    certainty, area = peak / parts.noise, float(parts.main.mean())
    quality = Quality(
        accepted=True,
        saturated_share=_bright_share(saturated, parts.smooth, peak, parts.main),
        clipped_share=_bright_share(clipped, parts.smooth, peak, parts.main),
        cut_share=_cut_share(parts.flux),
        signal_to_background=contrast,
        energy_outside_window=energy_outside_window,
        second_spot_share=_second_share(parts),
        signal_to_noise=certainty,
        spot_area_share=area,
        sheet_share=_sheet_share(parts),
    )
    if contrast < _MIN_CONTRAST or certainty < _MIN_CERTAINTY or area < _MIN_AREA:
        return _refuse(
            quality, "low_signal" if certainty > _CERTAIN and area > _MIN_AREA else "no_spot"
        )
    return _limited(quality)


def _limited(quality: Quality) -> Quality:
    """The same quality, or a rejection for the first measure that exceeds its limit."""
    limits = (
        ("saturated", quality.saturated_share > _LIMIT_SATURATED),
        ("cut", quality.cut_share > _LIMIT_CUT),
        ("second_spot", quality.second_spot_share > _LIMIT_SECOND),
    )
    for reason, passed in limits:
        if passed:
            return _refuse(quality, reason)
    return quality


def _refuse(quality: Quality, reason: str) -> Quality:
    return replace(quality, accepted=False, reason=reason, detail=_REMEDY[reason])


def refused(reason: str, detail: str | None = None) -> Quality:
    """A rejection with its remedy, for an image without measurements."""
    return Quality(accepted=False, reason=reason, detail=detail or _REMEDY[reason])


def judge_flux(
    flux: NDArray[np.floating], main: NDArray[np.bool_], outside: float, second: float
) -> Quality:
    """The quality of an image (rows, columns) whose background was already removed."""
    peak = float(flux.max())
    if peak <= 0 or not main.any():
        return refused("no_spot")
    off = float(flux[~main].mean()) if not main.all() else 0.0
    quality = Quality(
        accepted=True,
        saturated_share=_bright_share(flux >= 0.995 * peak, flux, peak, main),
        cut_share=_cut_share(flux),
        signal_to_background=peak / max(off, peak / 255),
        energy_outside_window=outside,
        second_spot_share=second,
        signal_to_noise=peak / max(float(flux[~main].std()) if not main.all() else 0.0, peak / 255),
        spot_area_share=float(main.mean()),
    )
    return _limited(quality)


def _second_share(parts: Separation) -> float:
    """Energy of the other spots, divided by the energy of all."""
    signal = np.maximum(parts.smooth, 0)
    others = float(signal[parts.foreign].sum())
    return others / max(others + float(signal[parts.main].sum()), 1e-9)


def _sheet_share(parts: Separation) -> float:
    """Mean error of the flux relative to its mean, caused by an uneven sheet.

    The sheet is assumed to be as uneven under the spot as elsewhere. Stains and seams reflect the
    spot's light in the same way as daylight. The unevenness is assumed to be normally distributed.
    """
    off = ~(parts.main | parts.foreign)
    if not off.any():
        return 0.0
    uneven = 1.4826 * float(
        np.median(np.abs(parts.smooth[off] / np.maximum(parts.background[off], 1.0)))
    )
    light = float((parts.flux + parts.background)[parts.main].sum(dtype=np.float64))
    return (
        float((2 / np.pi) ** 0.5)
        * uneven
        * light
        / max(float(parts.flux.sum(dtype=np.float64)), 1e-9)
    )


def _bright_share(
    where: NDArray[np.bool_], signal: NDArray[np.floating], peak: float, main: NDArray[np.bool_]
) -> float:
    bright = main & (signal > 0.5 * peak)
    return float(where[bright].mean()) if bright.any() else 0.0


def _cut_share(flux: NDArray[np.floating]) -> float:
    """Estimated share of the energy beyond the image's edges.

    Each row and column is extrapolated exponentially. A profile with edge value e and inward slope
    g continues with the area e^2 / g. If a profile does not fall towards the edge, the spot's
    radius limits its extension.
    """
    radius = float(np.sqrt((flux > 0.5 * flux.max()).sum() / np.pi))
    depth = max(4, round(0.5 * radius))
    lost = 0.0
    for turned in (flux, flux[::-1], flux.T, flux.T[::-1]):
        edge = turned[:3].mean(axis=0, dtype=np.float64)
        slope = (turned[depth : depth + 3].mean(axis=0, dtype=np.float64) - edge) / depth
        reach = np.minimum(edge / np.maximum(slope, 1e-12), radius)
        lost += float((edge * reach).sum())
    return lost / (lost + float(flux.sum(dtype=np.float64)))
