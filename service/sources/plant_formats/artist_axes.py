"""ARTIST's rigid body: how its joints turn a mirror, and which mount that is.

A mirror lies with its normal up, x east and y north. It is turned to face south, and then by::

    R_n(tilt_n) R_u(tilt_u) T(first) R_e(angle 1) R_e(tilt_e) R_n(tilt_n) T(second) R_u(angle 2)
    T(concentrator)

The first axis is east and the second is the mirror's upward axis: a mount of kind ``pitch_roll``.
A first tilt of a quarter turn makes the first axis upright. The mirror lies on its side then, and
the mount is ``azimuth_elevation``.

Source: ARTIST 2.0, ``artist.field.kinematics_rigid_body`` and ``artist.geometry.transforms``.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TRANSLATIONS = tuple(
    f"{part}_translation_{axis}"
    for part in ("first_joint", "second_joint", "concentrator")
    for axis in "enu"
)
TILTS = ("first_joint_tilt_n", "first_joint_tilt_u", "second_joint_tilt_e", "second_joint_tilt_n")

ON_ITS_SIDE = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Our mirror coordinates to ARTIST's, of a mirror whose second axis is its x."""

_QUARTER = np.pi / 2
_SAME_RAD = 1e-6


def first_tilt(tilt_n: float, tilt_u: float) -> Array:
    """The rotation (3, 3) of the first joint in ENU; about north it is left-handed, as ARTIST's."""
    c, s = np.cos(tilt_n), np.sin(tilt_n)
    north = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    c, s = np.cos(tilt_u), np.sin(tilt_u)
    return np.asarray(north @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A rigid body as a mount.

    Attributes
    ----------
    kind : str
        ``pitch_roll`` or ``azimuth_elevation``.
    joint : (3,) [m]
        From the heliostat's position to the pivot, in ENU.
    mirror_offset : float [m]
        From the pivot to the mirror's middle along its normal.
    left_out : mapping
        Deviations [m], [rad] that no mount of plant.yaml has, by name.
    """

    kind: str
    joint: Array
    mirror_offset: float
    left_out: Mapping[str, float]

    @property
    def mirror(self) -> Array:
        """Our mirror coordinates to ARTIST's (3, 3)."""
        return ON_ITS_SIDE if self.kind == "azimuth_elevation" else np.eye(3)


def rigid_body(deviations: Mapping[str, float]) -> RigidBody:
    """The mount of a rigid body with these deviations [m], [rad]."""
    is_upright = abs(deviations["first_joint_tilt_n"] - _QUARTER) < _SAME_RAD
    tilts = {name: deviations[name] for name in TILTS}
    turn = np.eye(3)
    if is_upright:
        del tilts["first_joint_tilt_n"]
        turn = first_tilt(_QUARTER, 0.0)
    first = np.array([deviations[f"first_joint_translation_{axis}"] for axis in "enu"])
    shifts = {name: deviations[name] for name in TRANSLATIONS[3:]}
    offset = -shifts.pop("concentrator_translation_n")
    left_out = {name: value for name, value in {**tilts, **shifts}.items() if abs(value) > 1e-9}
    kind = "azimuth_elevation" if is_upright else "pitch_roll"
    return RigidBody(kind, turn @ first, offset, left_out)


def deviations_of(kind: str, pivot_height: float, mirror_offset: float) -> dict[str, float]:
    """The deviations [m], [rad] of a mount; the reverse of `rigid_body`."""
    found = dict.fromkeys((*TRANSLATIONS, *TILTS), 0.0)
    found["concentrator_translation_n"] = -mirror_offset
    if kind == "azimuth_elevation":
        found["first_joint_tilt_n"] = _QUARTER
        found["first_joint_translation_e"] = pivot_height
    else:
        found["first_joint_translation_u"] = pivot_height
    return found
