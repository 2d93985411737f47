"""Every accuracy and error figure, defined once.

Flux accuracy compares shapes on a window centred on each image's own centre of mass (DESIGN.md,
section 7), so that neither aiming nor exposure counts. Surface error is the mean absolute
difference of control heights after each facet's mean is taken out, which no image can see.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import InvalidInputError
from model.frames import SOLAR_DISC
from model.images import FLUX_SIZE, FLUX_WINDOW
from model.imaging.window import center_of_mass, flux_window
from model.plant import Heliostat

Array = NDArray[np.float64]


WINDOWS = (FLUX_WINDOW, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
"""Sides [m] of comparison windows: a flux image's, unless a spot is larger (`accuracy_window`)."""

WINDOW_TOLERANCE = 0.1
"""Share by which a spot's outer rim, which holds little light, may exceed its window."""

SPILL = 0.02
"""Share of a spot's energy that may lie outside its window."""


def flux_accuracies(measured: Array, forecast: Array) -> Array:
    """1 - sum|measured - forecast| / sum(measured) of fluxes (..., R, C), both scaled to the same
    sum.

    One for equal shapes. Source: Lewen et al. 2024 (iDLR), flux accuracy.
    """
    a, b = (flux / flux.sum(axis=(-2, -1), keepdims=True) for flux in (measured, forecast))
    return np.asarray(1 - np.abs(a - b).sum(axis=(-2, -1)))


def flux_accuracy(measured: ArrayLike, forecast: ArrayLike) -> float:
    """As `flux_accuracies`, of one flux (R, C).

    Raises
    ------
    InvalidInputError
        If the fluxes differ in shape, are not finite or hold no energy.
    """
    a, b = np.asarray(measured, dtype=np.float64), np.asarray(forecast, dtype=np.float64)
    if a.shape != b.shape:
        raise InvalidInputError(f"fluxes must have one shape, got {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all() and a.sum() > 0 and b.sum() > 0):
        raise InvalidInputError("fluxes must be finite and hold energy")
    return float(flux_accuracies(a, b))


@dataclass(frozen=True)
class FluxComparison:
    """Accuracy of a forecast, and the shares of both energies outside its window."""

    accuracy: float
    window: float
    measured_outside: float
    forecast_outside: float


def compare_on_target(
    measured: ArrayLike,
    forecast: ArrayLike,
    size: tuple[float, float],
    window: float = FLUX_WINDOW,
    resolution: int = FLUX_SIZE,
    measured_size: tuple[float, float] | None = None,
) -> FluxComparison:
    """Compare two fluxes (rows, columns) over one target of ``size`` (width, height) [m].

    Each is cut to a square ``window`` [m] about its own centre of mass, (resolution, resolution)
    pixels. ``measured_size`` [m] is that of the first if it shows only a part of the target.
    """
    first = _cut(measured, measured_size or size, window, resolution)
    second = _cut(forecast, size, window, resolution)
    accuracy = flux_accuracy(first.flux, second.flux)
    return FluxComparison(accuracy, window, first.outside, second.outside)


def accuracy_window(
    images: Sequence[ArrayLike],
    sizes: Sequence[tuple[float, float]],
    *,
    spill: float = SPILL,
    widest: float = WINDOWS[-1],
) -> float:
    """Side [m] of the smallest of `WINDOWS`, up to ``widest``, that holds all of the spots but
    ``spill``.

    ``images`` are N fluxes (rows, columns) over whole targets of ``sizes`` (width, height) [m]; of
    many, half of them must fit.
    """
    windows = [window for window in WINDOWS if window <= widest]
    for window in windows:
        outside = [
            _cut(i, size, window, FLUX_SIZE).outside for i, size in zip(images, sizes, strict=True)
        ]
        if np.median(outside) <= spill:
            return window
    return windows[-1]


def spot_window(heliostat: Heliostat, slant_range: float) -> float:
    """Side [m] of the smallest of `WINDOWS` that holds a heliostat's spot at a slant range [m].

    The spot is as wide as the light of the ideal mirror from the sun's centre, under normal
    incidence, and the sun's disc with twice the standard deviation of the mirror's errors.
    """
    optics = heliostat.optics
    error = np.hypot(2 * optics.slope_error, optics.pointing_error)
    side = _central_spot(heliostat, slant_range) + 2 * slant_range * (SOLAR_DISC + 2 * error)
    return min((w for w in WINDOWS if w * (1 + WINDOW_TOLERANCE) >= side), default=WINDOWS[-1])


def _central_spot(heliostat: Heliostat, slant_range: float) -> float:
    """Width [m] of the ideal mirror's light from a point on its axis."""
    centers, axes, half_sizes = heliostat.facet_frames
    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    local = np.zeros((len(centers), len(corners), 3))
    local[..., :2] = corners * half_sizes[:, None]
    focus = np.array([facet.focal_length or np.inf for facet in heliostat.facets])
    normals = -local / (2 * focus[:, None, None]) + [0.0, 0.0, 1.0]
    points, normals = (np.einsum("fkc,fcd->fkd", part, axes) for part in (local, normals))
    slopes = normals[..., :2] / normals[..., 2:]
    hits = centers[:, None, :2] + points[..., :2] + 2 * slant_range * slopes
    return float(np.ptp(hits.reshape(-1, 2), axis=0).max())


class _Cut(NamedTuple):
    """A flux in the window about its centre of mass, and the share of its energy outside."""

    flux: Array
    outside: float


def _cut(image: ArrayLike, size: tuple[float, float], window: float, resolution: int) -> _Cut:
    flux = np.asarray(image, dtype=np.float64)
    cut = flux_window(flux, size, center_of_mass(flux, size), window, resolution)
    return _Cut(cut, float(1 - cut.sum() / flux.sum()))


def surface_error(z: ArrayLike, truth: ArrayLike) -> float:
    """Mean absolute error [m] of heights (..., F, I, J), without the mean of each facet."""
    difference = np.asarray(z, dtype=np.float64) - np.asarray(truth, dtype=np.float64)
    return float(np.abs(difference - difference.mean(axis=(-2, -1), keepdims=True)).mean())
