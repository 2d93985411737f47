"""Measure a camera's transfer function from photographs of a sheet with forecast spots.

A forecast gives the distribution of light on the sheet, but not its scale. The sheet's counts under
the spot are interpolated from those around it. For a position with counts c, on a sheet with counts
s, and a curve g from counts to light,

    g(c) = g(s) + b F,

where F is the forecast and b the photograph's exposure. One curve for all photographs, on bright
and dull days, and one exposure for each are fitted by least squares in counts. The model is linear
in the exposures, so they are eliminated (variable projection). The curve is a monotone spline
through knots in the logarithms of light and counts. Its prior is sRGB to a free power; bends from
that need many photographs as evidence.

Sources: Debevec and Malik, *Recovering high dynamic range radiance maps from photographs*, SIGGRAPH
1997; Golub and Pereyra, *The differentiation of pseudo-inverses and nonlinear least squares
problems*, SIAM J. Numer. Anal. 10 (1973); Fritsch and Carlson, *Monotone piecewise cubic
interpolation*, SIAM J. Numer. Anal. 17 (1980).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

from model.errors import InvalidInputError
from model.imaging.light import Measured, Srgb
from model.imaging.separate import separate

Array = NDArray[np.float64]

# The darkest knot is far below any sheet in daylight (0.13 to 0.4 of the camera's range of light).
_KNOTS = np.log(np.geomspace(0.02, 1.0, 10))
_TABLE = np.linspace(0, 1, 65)  # counts of the table: between them the curve is straight to 1e-4
_NOISE = 0.02  # [counts] typical error of forecasts
_INDEPENDENT = 5.0  # effective pixels of a photograph, because their errors are correlated
_STRIDE = 4  # [px] between positions
_BEND = 0.1  # prior std of the change of the logarithmic slope between knots, relative
_SLOPE = 1.0  # ... and of the slope itself, relative to sRGB's


@dataclass(frozen=True, eq=False)
class LitSheet:
    """Data of one photograph for the camera's curve, at N positions within the spot.

    Attributes
    ----------
    counts, sheet : (N,) [1]
        Counts with the spot's light, and without it: interpolated from the sheet around the spot.
    forecast : (N,)
        The spot's light, in any unit.
    clipped : bool (N,)
        Saturated positions, where the real counts would be higher. Without them, the selection
        would favour positions that are darker than forecast.
    """

    counts: Array
    sheet: Array
    forecast: Array
    clipped: NDArray[np.bool_]


def lit_sheet(
    crop: NDArray[np.uint8], clipped: NDArray[np.bool_] | None, forecast: Array
) -> LitSheet:
    """Extract the data of a rectified photograph (rows, columns).

    The sheet under the spot is estimated with sRGB. Real cameras are close enough to it for a
    smooth sheet. ``clipped`` (saturated pixels) and ``forecast`` (light) have the same shape.
    """
    law = Srgb()
    parts = separate((255 * law.light(crop / 255)).astype(np.float32))
    places = np.zeros(crop.shape, bool)
    places[::_STRIDE, ::_STRIDE] = True
    places &= parts.main
    counts, sheet = (
        law.counts(light[places] / 255)
        for light in (parts.background + parts.flux, parts.background)
    )
    cut_off = np.zeros(len(counts), bool) if clipped is None else clipped[places]
    return LitSheet(counts, sheet, np.asarray(forecast[places], dtype=np.float64), cut_off)


def fit_law(photographs: Sequence[LitSheet]) -> Measured:
    """Fit the transfer function of the camera that took the photographs.

    Raises
    ------
    InvalidInputError
        If no photograph shows light.
    """
    shown = [one for one in photographs if one.forecast[~one.clipped].any()]
    if not shown:
        raise InvalidInputError(
            "a camera response curve is measured from photographs of spots, and there is none"
        )
    found = least_squares(_errors, np.zeros(len(_KNOTS) - 1), args=(shown,), x_scale=_BEND)
    return _curve(found.x)


def _curve(bends: Array) -> Measured:
    """The curve with sRGB's steps in log counts between knots, times exp(``bends``) (K - 1,)."""
    usual = np.log(Srgb().counts(np.exp(_KNOTS)))
    steps = np.diff(usual) * np.exp(bends)
    knots = -np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    darkest = np.exp(knots[0])
    dark, bright = _TABLE[darkest >= _TABLE], _TABLE[darkest < _TABLE]
    below = Srgb().light(dark * np.exp(usual[0]) / darkest)
    light = np.append(below, np.exp(PchipInterpolator(knots, _KNOTS)(np.log(bright))))
    light[-1] = 1  # removes rounding errors
    return Measured(tuple(_TABLE.tolist()), tuple(light.tolist()))


def _errors(bends: Array, photographs: Sequence[LitSheet]) -> Array:
    """Errors of all counts, then the prior's residuals.

    The pixels of each photograph together have the weight `_INDEPENDENT`.
    """
    curve = _curve(bends)
    errors = [
        _misses(curve, one) * (_INDEPENDENT / len(one.counts)) ** 0.5 / _NOISE
        for one in photographs
    ]
    return np.concatenate([*errors, np.diff(bends) / _BEND, bends / _SLOPE])


def _misses(curve: Measured, one: LitSheet) -> Array:
    """Differences of counts (N,) from those of the forecast, at the best exposure."""
    sheet, light = curve.light(one.sheet), curve.light(one.counts)
    # An error in light, divided by the curve's slope, is an error in counts.
    weighted = (
        ~one.clipped
        * one.forecast
        / np.interp(one.counts, _TABLE, np.gradient(curve.lights, _TABLE)) ** 2
    )
    exposure = (weighted * (light - sheet)).sum() / (weighted * one.forecast).sum()
    missed = one.counts - curve.counts(sheet + exposure * one.forecast)
    return np.where(one.clipped, missed.clip(min=0), missed)
