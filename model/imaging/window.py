"""Crop a square window from a flux image with conserved energy.

A flux image holds energy per pixel. In resampling by area, every source pixel gives each target
pixel the share of its energy that falls into it. On two rectangular grids that share is a product
of a row and a column overlap. So the whole operation is ``W_rows @ flux @ W_cols.T``, which is
exact for any zoom and any sub-pixel shift.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import InvalidInputError
from model.images import FLUX_SIZE, FLUX_WINDOW
from model.imaging.strips import row_strips


def overlap_matrix(
    source_edges: NDArray[np.float64], target_edges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Share of each source cell that falls into each target cell (..., targets, sources).

    Edges are ascending; leading axes broadcast.
    """
    low = np.maximum(target_edges[..., :-1, None], source_edges[..., None, :-1])
    high = np.minimum(target_edges[..., 1:, None], source_edges[..., None, 1:])
    return np.asarray(np.maximum(high - low, 0.0) / np.diff(source_edges)[..., None, :])


def _axis_weights(
    pixels: int, extent: float, center: float, window: float, resolution: int
) -> NDArray[np.float64]:
    source = np.linspace(-extent / 2, extent / 2, pixels + 1)
    target = center + np.linspace(-window / 2, window / 2, resolution + 1)
    return overlap_matrix(source, target)


def flux_window(
    flux: NDArray[np.floating],
    plane_size: tuple[float, float],
    center: ArrayLike = (0.0, 0.0),
    window: float | tuple[float, float] = FLUX_WINDOW,
    resolution: int | tuple[int, int] = FLUX_SIZE,
) -> NDArray[np.float64]:
    """The energy of a flux image in a window, resampled by area.

    Parameters
    ----------
    flux : (rows, columns)
        Energy per pixel over the whole plane, row 0 at the top.
    plane_size : (width, height) [m]
    center : (2,) [m]
        Centre of the window, right and up of the plane's centre.
    window : float or (width, height) [m]
    resolution : int or (rows, columns)

    Returns
    -------
    ndarray (rows, columns)
        Energy per window pixel. A window that covers the whole plane keeps the sum. Outside the
        plane the energy is zero.

    Raises
    ------
    InvalidInputError
        If ``flux`` is not two-dimensional, or a size is not positive.
    """
    image = np.asarray(flux)
    width, height = window if isinstance(window, tuple) else (window, window)
    rows, columns = resolution if isinstance(resolution, tuple) else (resolution, resolution)
    if image.ndim != 2 or image.size == 0:
        raise InvalidInputError(f"flux must be an image (rows, columns), got shape {image.shape}")
    if not min(*plane_size, width, height, rows, columns) > 0:
        raise InvalidInputError("plane_size, window and resolution must be positive")
    right, up = np.asarray(center, dtype=np.float64)
    # Rows run downwards, so the row axis is the plane's up axis with the opposite sign.
    row_weights = _axis_weights(image.shape[0], plane_size[1], -float(up), height, rows)
    column_weights = _axis_weights(image.shape[1], plane_size[0], float(right), width, columns)
    rows_of_window = np.zeros((rows, image.shape[1]))
    for strip in row_strips(image.shape):
        rows_of_window += row_weights[:, strip] @ np.asarray(image[strip], dtype=np.float64)
    return np.asarray(rows_of_window @ column_weights.T)


def share_window(
    mask: NDArray[np.bool_],
    plane_size: tuple[float, float],
    center: ArrayLike = (0.0, 0.0),
    window: float = FLUX_WINDOW,
    resolution: int = FLUX_SIZE,
) -> NDArray[np.float32]:
    """Share [1] of each window pixel that a mask covers.

    The mask (rows, columns) is over the whole plane, and the window is that of `flux_window`.
    """
    covered, all_of_it = (
        flux_window(part, plane_size, center, window, resolution)
        for part in (mask.astype(float), np.ones(mask.shape))
    )
    return np.asarray(covered / np.maximum(all_of_it, 1e-12), dtype=np.float32)


def center_of_mass(
    flux: NDArray[np.floating], plane_size: tuple[float, float]
) -> NDArray[np.float64]:
    """Centroid (2,) [m], right and up of the plane's centre, of an image (rows, columns).

    Row 0 is at the top.

    Raises
    ------
    InvalidInputError
        If the image has no energy.
    """
    image = np.asarray(flux, dtype=np.float64)
    total = image.sum()
    if not total > 0:
        raise InvalidInputError("an image without energy has no centre of mass")
    rows, columns = image.shape
    right = (np.arange(columns) + 0.5) / columns - 0.5
    up = 0.5 - (np.arange(rows) + 0.5) / rows
    moments = image.sum(axis=0) @ right * plane_size[0], image.sum(axis=1) @ up * plane_size[1]
    return np.array(moments, dtype=np.float64) / float(total)
