"""The geometry of one measurement or forecast: a heliostat, a sun and a target."""

from collections.abc import Hashable
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from model.plant import Heliostat, TargetPlane
from model.surface import DEGREE

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Setup:
    """One heliostat with its surface, under one sun, in front of one target.

    Attributes
    ----------
    heliostat : Heliostat
    control_points : (F, I, J, 3) [m]
        The mirror, in its own coordinates, as `model.surface.control_points` or a measurement gives
        it.
    sun : (3,)
        Unit vector towards the recorded sun in ENU.
    plane : TargetPlane
    spot : (3,) [m] or None
        Centre of mass of the spot in ENU; the heliostat is turned until it lies there.
    angles : (2,) [rad] or None
        Axis angles of the mount by its motors. Without a spot they are those of the mount. With a
        spot they say how far it lies from where the motors sent it.
    aim : (3,) [m] or None
        Where the ray from the mirror's centre goes if neither spot nor angles are given; by default
        the plane's centre.
    degree : int
        Of the surface's splines.
    identifier : str
    taken_at : datetime or None
        With time zone; effects may begin and end. None if it is not known.
    temperature_c : float or None [deg C]
        Of the air then.
    neighbours : (K, 3, 3) [m] or None
        Rectangles in ENU of mirrors that may hide parts of this one, by the plant's layout
        (`model.neighbours`). They act by the effect `known_neighbours` only.
    """

    heliostat: Heliostat
    control_points: Array
    sun: Array
    plane: TargetPlane
    spot: Array | None = None
    angles: Array | None = None
    aim: Array | None = None
    degree: int = DEGREE
    identifier: str = ""
    taken_at: datetime | None = None
    temperature_c: float | None = None
    neighbours: Array | None = None

    @property
    def goal(self) -> Array:
        """The point (3,) [m] in ENU that the spot, or the mirror's central ray, is sent to."""
        chosen = self.aim if self.spot is None else self.spot
        return np.asarray(self.plane.center if chosen is None else chosen, dtype=np.float64)

    @property
    def kind(self) -> Hashable:
        """What setups must have in common to be aligned at once."""
        return (self.degree, *self.control_points.shape, self.spot is None)
