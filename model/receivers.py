"""Receivers of several planes: panels side by side, and panels in a cavity.

Their map has the panels from left to right, with columns by their widths.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from model.errors import InvalidInputError
from model.plant import SurfaceGrid, TargetPlane, TouchingPlanes, Vector, inside_outline, windows_on


@dataclass(frozen=True, eq=False)
class _OfPanels:
    """What panels and cavities have in common: planes of one height side by side.

    Attributes
    ----------
    name : str
    panels : tuple of TargetPlane
    absorptance : float
    """

    name: str
    panels: tuple[TargetPlane, ...]
    absorptance: float = 1.0

    def __post_init__(self) -> None:
        if not self.panels:
            raise InvalidInputError(f"receiver {self.name} has no panels")
        if np.ptp([panel.height for panel in self.panels]) > 1e-6 * self.panels[0].height:
            raise InvalidInputError(f"receiver {self.name}: its panels must have one height")

    @property
    def center(self) -> Vector:
        """Mean of the panels' middles."""
        return np.asarray(np.mean([panel.center for panel in self.panels], axis=0))

    def aim_of(self, mirrors: Vector) -> Vector:
        """Their middle (..., 3) [m], for all mirrors (..., 3) [m]."""
        return np.broadcast_to(self.center, mirrors.shape)

    @property
    def normal(self) -> Vector:
        """Unit normal of the panel in the middle."""
        return self.panels[len(self.panels) // 2].normal

    @property
    def up(self) -> Vector:
        """Unit vector along that panel's rows, upwards."""
        return self.panels[len(self.panels) // 2].up

    @property
    def width(self) -> float:
        """Sum of the panels' widths [m]."""
        return sum(panel.width for panel in self.panels)

    @property
    def height(self) -> float:
        """Height of the panels [m]."""
        return self.panels[0].height

    @property
    def shape(self) -> dict[str, float]:
        """Number of panels."""
        return {"panels": len(self.panels)}

    @property
    def middle(self) -> TargetPlane:
        """The plane through their middle that is as wide as they are together."""
        return TargetPlane(self.name, self.center, self.normal, self.up, self.width, self.height)

    def grid(self, rows: int, columns: int) -> SurfaceGrid:
        """Places of the panels from left to right.

        Raises
        ------
        InvalidInputError
            If there are fewer columns than panels.
        """
        if columns < len(self.panels):
            raise InvalidInputError(
                f"resolution: {columns} columns for {len(self.panels)} panels of receiver"
                f" {self.name}; ask for more"
            )
        return _joined(self.panels, rows, columns)

    @property
    def _screens(self) -> Vector:
        """The panels as rectangles (K, 3, 3) [m], which may hide each other."""
        return np.array(
            [[p.center, p.width / 2 * p.right, p.height / 2 * p.up] for p in self.panels]
        )


@dataclass(frozen=True, eq=False)
class Panels(_OfPanels):
    """Planes of one height side by side, lit from outside."""

    def touching(self, mirrors: Vector) -> TouchingPlanes:
        """Upright planes before the panels, each turned to its mirror."""
        outward = mirrors - self.center
        outward = outward - (outward @ self.up)[:, None] * self.up
        length = np.linalg.norm(outward, axis=1, keepdims=True)
        normals = np.where(length > 1e-9, outward / np.maximum(length, 1e-9), self.normal)
        axes = np.stack(
            [np.cross(self.up, normals), np.broadcast_to(self.up, normals.shape), normals], axis=1
        )
        edges = _joined(self.panels, 3, 3 * len(self.panels), edges=True)
        depth = (edges.points.reshape(-1, 3) - self.center) @ normals.T
        origins = self.center + depth.max(axis=0)[:, None] * normals
        return replace(windows_on(edges, mirrors, origins, axes), screens=self._screens)


@dataclass(frozen=True, eq=False)
class Cavity(_OfPanels):
    """Panels behind a polygonal aperture; light that meets no panel is lost.

    Attributes
    ----------
    aperture : (V, 3) [m]
        Corners of the opening in ENU, in one plane, counter-clockwise seen from outside.
    """

    aperture: Vector = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        corners = np.array(self.aperture, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 3:
            raise InvalidInputError(f"receiver {self.name}: aperture needs three corners or more")
        corners.flags.writeable = False
        object.__setattr__(self, "aperture", corners)
        spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
        if spread[2] > 1e-3 * spread[0] or spread[1] < 1e-6 * spread[0]:
            raise InvalidInputError(f"receiver {self.name}: aperture must be a plane polygon")

    def aim_of(self, mirrors: Vector) -> Vector:
        """Middle of the aperture's rectangle (..., 3) [m], for all mirrors (..., 3) [m]."""
        return np.broadcast_to(self._opening().center, mirrors.shape)

    def _opening(self) -> TargetPlane:
        """The rectangle in the aperture's plane that bounds it."""
        corners = self.aperture
        normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
        normal /= np.linalg.norm(normal)
        up = self.up if abs(self.up @ normal) < 0.99 else np.array([0.0, 1.0, 0.0])
        plane = TargetPlane(self.name, corners.mean(axis=0), normal, up, 1.0, 1.0)
        places = plane.to_plane(corners)
        low, high = places.min(axis=0), places.max(axis=0)
        width, height = high - low
        center = plane.to_enu((low + high) / 2)
        return TargetPlane(self.name, center, normal, up, float(width), float(height))

    def touching(self, mirrors: Vector) -> TouchingPlanes:
        """The aperture's plane, which light passes inside the polygon."""
        plane = self._opening()
        same = plane.touching(mirrors)
        outline = plane.to_plane(self.aperture)

        def opening(rows: int, columns: int) -> Vector:
            places = plane.to_plane(plane.grid(_FINE * rows, _FINE * columns).points)
            inside = inside_outline(places[..., 0], places[..., 1], outline)
            return np.asarray(inside.reshape(rows, _FINE, columns, _FINE).mean(axis=(1, 3)))

        return replace(same, opening=opening, outline=outline, screens=self._screens)


_FINE = 8
"""Places along each side of a window's cell by which an aperture's edge is divided."""


def _joined(
    panels: tuple[TargetPlane, ...], rows: int, columns: int, edges: bool = False
) -> SurfaceGrid:
    """Places of panels side by side; with ``edges`` they reach the panels' edges."""
    ends = np.cumsum([panel.width for panel in panels])
    splits = np.maximum(np.round(ends / ends[-1] * columns), np.arange(1, len(panels) + 1))
    counts = np.diff(splits.astype(int), prepend=0)
    grids = []
    for panel, count in zip(panels, counts, strict=True):
        grid = panel.grid(rows, int(count))
        if edges:
            stretch = np.array([count / max(count - 1, 1), rows / max(rows - 1, 1)])
            points = panel.to_enu(panel.to_plane(grid.points) * stretch)
            grid = grid._replace(points=points)
        grids.append(grid)
    points, normals, areas = (np.concatenate(parts, axis=1) for parts in zip(*grids, strict=True))
    return SurfaceGrid(points, normals, areas)
