"""Where the facets of a mirror lie, and pictures of heights on them, seen from the front."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.plant import Heliostat, Outline, inside_outline

Array = NDArray[np.floating]

# Pixels along the shorter side of the smallest facet, and along the longer side of a mirror.
_FACET_PIXELS, _MOST_PIXELS = 48, 640

_SQUARE: Outline = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))


@dataclass(frozen=True, eq=False)
class FacetPlaces:
    """Facets in the mirror's plane, x to the right and y up.

    Attributes
    ----------
    centers : (F, 2) [m]
    halves : (F, 2, 2) [m]
        Half width and half height of each, as vectors.
    outlines : sequence of Outline
        Their edges in half widths and half heights.
    """

    centers: NDArray[np.float64]
    halves: NDArray[np.float64]
    outlines: Sequence[Outline]

    @classmethod
    def of(cls, heliostat: Heliostat) -> "FacetPlaces":
        """The facets of a heliostat, as they lie."""
        facets = heliostat.facets
        return cls(
            np.array([facet.position[:2] for facet in facets]),
            np.array([[facet.canting_x[:2], facet.canting_y[:2]] for facet in facets]),
            [facet.outline or _SQUARE for facet in facets],
        )

    @classmethod
    def of_control_points(cls, points: Array) -> "FacetPlaces":
        """The facets of control points (F, I, J, 3) [m], as parallelograms between corners."""
        corners = points[:, [0, -1, 0], [0, 0, -1], :2]
        halves = (corners[:, 1:] - corners[:, :1]) / 2
        return cls(corners[:, 0] + halves.sum(axis=1), halves, [_SQUARE] * len(points))

    @classmethod
    def in_rows(cls, count: int, size: tuple[float, float]) -> "FacetPlaces":
        """Equal facets in rows from the upper left, on a mirror of (width, height) [m].

        For a surface whose facets are not those of its heliostat any more.
        """
        columns = math.ceil(math.sqrt(count))
        rows = math.ceil(count / columns)
        half = 0.49 * np.array(size) / [columns, rows]
        number = np.arange(count)
        across = ((number % columns + 0.5) / columns - 0.5) * size[0]
        up = (0.5 - (number // columns + 0.5) / rows) * size[1]
        halves = np.tile(np.diag(half), (count, 1, 1))
        return cls(np.stack([across, up], axis=-1), halves, [_SQUARE] * count)

    @property
    def sizes(self) -> NDArray[np.float64]:
        """Width and height (F, 2) [m] of each facet."""
        return np.asarray(2 * np.linalg.norm(self.halves, axis=-1))

    def edges(self) -> list[NDArray[np.float64]]:
        """Corners (V, 2) [m] of each facet's edge."""
        return [
            center + np.array(outline) @ half
            for center, half, outline in zip(self.centers, self.halves, self.outlines, strict=True)
        ]

    @property
    def box(self) -> NDArray[np.float64]:
        """Lower left and upper right corner (2, 2) [m] of the rectangle around all facets."""
        corners = np.concatenate(self.edges())
        return np.array([corners.min(axis=0), corners.max(axis=0)])

    def image(self, heights: Array) -> NDArray[np.float64]:
        """Heights (F, i, j), evenly spaced over each facet, as an image of `box`.

        i runs along x and j along y. Rows are from the top, and NaN is beside the facets.
        """
        low, high = self.box
        pixel = max(
            float(self.sizes.min()) / _FACET_PIXELS, float((high - low).max()) / _MOST_PIXELS
        )
        columns, rows = np.maximum(np.round((high - low) / pixel), 1).astype(int).tolist()
        x = low[0] + (np.arange(columns) + 0.5) / columns * (high - low)[0]
        y = high[1] - (np.arange(rows) + 0.5) / rows * (high - low)[1]
        image = np.full((rows, columns), np.nan)
        for facet, edge in enumerate(self.edges()):
            across = _covered(x, edge[:, 0])
            along = _covered(-y, -edge[:, 1])
            places = np.stack(np.meshgrid(x[across], y[along]), axis=-1) - self.centers[facet]
            u, v = np.moveaxis(places @ np.linalg.inv(self.halves[facet]), -1, 0)
            inside = inside_outline(u, v, self.outlines[facet])
            part = image[along, across]
            part[inside] = _interpolated(heights[facet], u[inside], v[inside])
        return image


def _covered(places: NDArray[np.float64], edge: NDArray[np.float64]) -> slice:
    """The rising ``places`` from the least to the largest of an edge's."""
    return slice(*np.searchsorted(places, [edge.min(), edge.max()]).tolist())


def _interpolated(
    heights: Array, u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Bilinear heights (i, j) at places from -1 to 1 along i and j."""
    last = np.array(heights.shape) - 1
    place = np.clip((np.stack([u, v]) + 1) / 2 * last[:, None], 0, last[:, None])
    first = np.minimum(place.astype(int), np.maximum(last - 1, 0)[:, None])
    (a, b), (i, j) = place - first, first
    k, m = np.minimum(i + 1, last[0]), np.minimum(j + 1, last[1])
    lower = (1 - a) * heights[i, j] + a * heights[k, j]
    upper = (1 - a) * heights[i, m] + a * heights[k, m]
    return np.asarray((1 - b) * lower + b * upper)
