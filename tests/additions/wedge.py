"""A receiver of two planes that meet in an upright edge."""

from dataclasses import dataclass

import numpy as np

from model.plant import SurfaceGrid, TargetPlane, TouchingPlanes, Vector, windows_on


@dataclass(frozen=True, eq=False)
class Wedge:
    name: str
    middle: TargetPlane
    fold_deg: float
    absorptance: float = 1.0

    @property
    def center(self) -> Vector:
        return self.middle.center

    @property
    def aim(self) -> Vector:
        return self.center

    @property
    def normal(self) -> Vector:
        return self.middle.normal

    @property
    def up(self) -> Vector:
        return self.middle.up

    @property
    def width(self) -> float:
        return self.middle.width

    @property
    def height(self) -> float:
        return self.middle.height

    @property
    def shape(self) -> dict[str, float]:
        return {"fold_deg": self.fold_deg}

    def grid(self, rows: int, columns: int) -> SurfaceGrid:
        fold, flat = np.radians(self.fold_deg), self.middle.grid(rows, columns)
        side = np.where(np.arange(columns) < columns // 2, -1.0, 1.0)[:, None]
        normals = np.cos(fold) * self.normal + side * np.sin(fold) * self.middle.right
        across = (flat.points - self.center) @ self.middle.right
        along = np.cross(self.up, normals) - self.middle.right
        points = flat.points + across[..., None] * along
        return SurfaceGrid(points, np.tile(normals, (rows, 1, 1)), flat.areas)

    def touching(self, mirrors: Vector) -> TouchingPlanes:
        count = len(mirrors)
        origins = np.tile(self.center, (count, 1))
        axes = np.tile(self.middle.axes, (count, 1, 1))
        return windows_on(self.grid(2, 24), mirrors, origins, axes)
