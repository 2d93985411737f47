"""Receivers of several planes: panels side by side, and panels in a cavity."""

from dataclasses import dataclass

import numpy as np

from model.errors import InvalidInputError
from model.plant import TargetPlane, Vector


@dataclass(frozen=True, eq=False)
class Panels:
    """Planes of one height side by side, lit from outside; none hides another.

    Its map has the panels from left to right, with columns by their widths.

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


@dataclass(frozen=True, eq=False)
class Cavity:
    """Panels behind a polygonal aperture.

    Attributes
    ----------
    name : str
    aperture : (V, 3) [m]
        Corners of the opening in ENU, in one plane, counter-clockwise seen from outside.
    panels : tuple of TargetPlane
        As of `Panels`; their lit sides face the inside.
    absorptance : float
    """

    name: str
    aperture: Vector
    panels: tuple[TargetPlane, ...]
    absorptance: float = 1.0

    def __post_init__(self) -> None:
        corners = np.array(self.aperture, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 3:
            raise InvalidInputError(f"receiver {self.name}: aperture needs three corners or more")
        corners.flags.writeable = False
        object.__setattr__(self, "aperture", corners)
        Panels(self.name, self.panels)
        sides = corners - corners.mean(axis=0)
        flat = np.linalg.svd(sides, compute_uv=False)
        if flat[2] > 1e-3 * flat[0] or flat[1] < 1e-6 * flat[0]:
            raise InvalidInputError(f"receiver {self.name}: aperture must be a plane polygon")
