"""A receiver of two planes that meet in an upright edge."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from model.plant import Patch, TargetPlane, Vector


@dataclass(frozen=True, eq=False)
class Wedge:
    name: str
    middle: TargetPlane
    fold_deg: float

    @property
    def center(self) -> Vector:
        return self.middle.center

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

    def patches(self, columns: int) -> Iterator[Patch]:
        half, fold = columns // 2, np.radians(self.fold_deg)
        for side, part in ((-1, slice(0, half)), (1, slice(half, columns))):
            normal = np.cos(fold) * self.normal + side * np.sin(fold) * self.middle.right
            along = np.cross(self.up, normal) * side
            width = self.width * (part.stop - part.start) / columns
            plane = TargetPlane(
                self.name, self.center + along * width / 2, normal, self.up, width, self.height
            )
            yield Patch(part, np.ones(part.stop - part.start), plane)
