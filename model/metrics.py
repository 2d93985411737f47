"""Every accuracy and error figure, defined once.

Flux accuracy compares shapes on a window centred on each image's own centre of mass (DESIGN.md, section 7), so that
neither aiming nor exposure counts. Surface error is the mean absolute difference of control heights after each
facet's mean is taken out, which no image can see.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import InvalidInputError
from model.imaging.window import center_of_mass, flux_window

Array = NDArray[np.float64]


def flux_accuracy(measured: ArrayLike, forecast: ArrayLike) -> float:
    """1 - sum|measured - forecast| / sum(measured), both scaled to the same sum; one for equal shapes.

    Source: Lewen et al. 2024 (iDLR), flux accuracy.
    """
    a, b = np.asarray(measured, dtype=np.float64), np.asarray(forecast, dtype=np.float64)
    if a.shape != b.shape:
        raise InvalidInputError(f"fluxes must have one shape, got {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all() and a.sum() > 0 and b.sum() > 0):
        raise InvalidInputError("fluxes must be finite and hold energy")
    return float(1 - np.abs(a / a.sum() - b / b.sum()).sum())


@dataclass(frozen=True)
class FluxComparison:
    """Accuracy of a forecast and the shares of the measured and forecast energy outside its window."""

    accuracy: float
    window: float
    measured_outside: float
    forecast_outside: float


def compare_on_target(
    measured: ArrayLike, forecast: ArrayLike, size: tuple[float, float], window: float = 4.0, resolution: int = 64
) -> FluxComparison:
    """Compare two fluxes (rows, columns) over one target of ``size`` (width, height) [m].

    Each is cut to a square ``window`` [m] about its own centre of mass, (resolution, resolution) pixels.
    """
    cuts, outside = [], []
    for flux in (np.asarray(measured, dtype=np.float64), np.asarray(forecast, dtype=np.float64)):
        cut = flux_window(flux, size, center_of_mass(flux, size), window, resolution)
        cuts.append(cut)
        outside.append(1 - cut.sum() / flux.sum())
    return FluxComparison(flux_accuracy(*cuts), window, *outside)


def surface_error(z: ArrayLike, truth: ArrayLike) -> float:
    """Mean absolute error [m] of control heights (..., F, I, J), each facet's mean removed from both."""
    difference = np.asarray(z, dtype=np.float64) - np.asarray(truth, dtype=np.float64)
    return float(np.abs(difference - difference.mean(axis=(-2, -1), keepdims=True)).mean())
