"""A camera's transfer function, measured: from photographs of a lit sheet whose spots are forecast.

A forecast says how light is spread over the sheet, though not how bright, and the sheet's counts beside the spot go on
beneath it. Of a place with counts c on a sheet of counts s, and a curve g from counts to light,

    g(c) = g(s) + b F,

F the forecast and b the photograph's exposure. One curve for all photographs, of days bright and dull, and an exposure
for each are fitted by least squares in counts; exposures, in which the model is linear, are eliminated (variable
projection). The curve is a monotone spline through knots in the logarithms of light and counts; beforehand it is taken
to be sRGB to some power, which costs nothing, and to bend from that only where many photographs say so.

Sources: Debevec and Malik, *Recovering high dynamic range radiance maps from photographs*, SIGGRAPH 1997; Golub and
Pereyra, *The differentiation of pseudo-inverses and nonlinear least squares problems*, SIAM J. Numer. Anal. 10 (1973);
Fritsch and Carlson, *Monotone piecewise cubic interpolation*, SIAM J. Numer. Anal. 17 (1980).
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

# The darkest knot lies far below any sheet by day (0.13 to 0.4 of the light that a camera can tell).
_KNOTS = np.log(np.geomspace(0.02, 1.0, 10))
_TABLE = np.linspace(0, 1, 65)  # counts of the table: between them the curve is straight to 1e-4
_NOISE = 0.02  # [counts] by which forecasts err, mostly
_INDEPENDENT = 5.0  # pixels of a photograph as which all of its count, for their errors go together
_STRIDE = 4  # [px] between places
_BEND = 0.1  # usual change of the logarithmic slope from knot to knot, relative
_SLOPE = 1.0  # ... and of the slope itself from sRGB's


@dataclass(frozen=True, eq=False)
class LitSheet:
    """What a photograph tells of its camera's law, at N places within the spot.

    Attributes
    ----------
    counts, sheet : (N,) [1]
        With the spot's light, and without it: as the sheet beside the spot goes on beneath it.
    forecast : (N,)
        The spot's light, in any unit.
    clipped : bool (N,)
        Where the camera's range cut the light off: there would be more counts. To leave such places out would choose
        those that are darker than forecast.
    """

    counts: Array
    sheet: Array
    forecast: Array
    clipped: NDArray[np.bool_]


def lit_sheet(crop: NDArray[np.uint8], clipped: NDArray[np.bool_] | None, forecast: Array) -> LitSheet:
    """What a rectified photograph (rows, columns) tells.

    The sheet beneath the spot is told by sRGB, from which no camera is so far that it mattered to a smooth sheet.
    ``clipped`` and ``forecast`` are as large: what the camera's range cut off, and the light.
    """
    law = Srgb()
    parts = separate((255 * law.light(crop / 255)).astype(np.float32))
    places = np.zeros(crop.shape, bool)
    places[::_STRIDE, ::_STRIDE] = True
    places &= parts.main
    counts, sheet = (law.counts(light[places] / 255) for light in (parts.background + parts.flux, parts.background))
    cut_off = np.zeros(len(counts), bool) if clipped is None else clipped[places]
    return LitSheet(counts, sheet, np.asarray(forecast[places], dtype=np.float64), cut_off)


def fit_law(photographs: Sequence[LitSheet]) -> Measured:
    """The transfer function of the camera that took the photographs.

    Raises
    ------
    InvalidInputError
        Where no photograph shows light.
    """
    shown = [one for one in photographs if one.forecast[~one.clipped].any()]
    if not shown:
        raise InvalidInputError("a camera's law is measured from photographs of spots, and there is none")
    found = least_squares(_errors, np.zeros(len(_KNOTS) - 1), args=(shown,), x_scale=_BEND)
    return _curve(found.x)


def _curve(bends: Array) -> Measured:
    """The curve whose steps in log counts, from knot to knot, are those of sRGB times exp(``bends``) (K - 1,)."""
    usual = np.log(Srgb().counts(np.exp(_KNOTS)))
    steps = np.diff(usual) * np.exp(bends)
    knots = -np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    darkest = np.exp(knots[0])
    dark, bright = _TABLE[darkest >= _TABLE], _TABLE[darkest < _TABLE]
    below = Srgb().light(dark * np.exp(usual[0]) / darkest)
    light = np.append(below, np.exp(PchipInterpolator(knots, _KNOTS)(np.log(bright))))
    light[-1] = 1  # but for rounding
    return Measured(tuple(_TABLE.tolist()), tuple(light.tolist()))


def _errors(bends: Array, photographs: Sequence[LitSheet]) -> Array:
    """Errors of all counts, each photograph's together worth `_INDEPENDENT`, then what is known beforehand."""
    curve = _curve(bends)
    errors = [_misses(curve, one) * (_INDEPENDENT / len(one.counts)) ** 0.5 / _NOISE for one in photographs]
    return np.concatenate([*errors, np.diff(bends) / _BEND, bends / _SLOPE])


def _misses(curve: Measured, one: LitSheet) -> Array:
    """By how much counts (N,) differ from those of the forecast, at the exposure that suits them best."""
    sheet, light = curve.light(one.sheet), curve.light(one.counts)
    # Errors in light, divided by the curve's slope, are errors in counts.
    weighted = ~one.clipped * one.forecast / np.interp(one.counts, _TABLE, np.gradient(curve.lights, _TABLE)) ** 2
    exposure = (weighted * (light - sheet)).sum() / (weighted * one.forecast).sum()
    missed = one.counts - curve.counts(sheet + exposure * one.forecast)
    return np.where(one.clipped, missed.clip(min=0), missed)
