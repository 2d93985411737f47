"""Two-axis mounts: from motor steps to axis angles to the mirror's pose, and back.

Notes
-----
A mount is two rotation axes in series, which are not parallel. The mirror's attitude (mirror to
ENU) is::

    R = R(first_axis, t1) @ R(second_axis, t2) @ R_zero

``R_zero`` is the attitude at t1 = t2 = 0. The second axis is given in that zero position; it
rotates with the first. The heliostats of Juelich rotate about east and then about "up"; an
azimuth-elevation mount rotates about up and then about east. For the same mirror normal, different
mounts leave the mirror rolled differently about it, and this rotates the flux image.

All functions take and return float64 numpy arrays with any leading batch shape. Each mirror of a
batch has a separate mount in `Mount.stack`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.actuator import Actuators
from model.errors import InvalidInputError, UnreachableError

Array = NDArray[np.float64]

# Mirror coordinates (x right seen from the front, y up the mirror, z normal) to ENU for an upright
# mirror that faces south: R_east(90 deg).
_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

_EAST, _, _UP = np.eye(3)

AxisName = Literal["first", "second"]
"""One of a mount's two axes."""

# Lever below which a mirror faces the zenith, so that its pylon does not lean.
_MIN_LEVER = 1e-9

# Each round leaves a hundredth of the error for a lean of 10 mrad.
_LEAN_ROUNDS = 6


def rotation(axis: ArrayLike, angle: ArrayLike) -> Array:
    """Right-handed rotations (..., 3, 3) about ``axis`` (..., 3) by ``angle`` (...) [rad]."""
    from scipy.spatial.transform import Rotation  # the command line starts without it

    direction = np.asarray(axis, dtype=np.float64)
    unit = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    vectors = unit * np.asarray(angle, dtype=np.float64)[..., None]
    # SciPy before 1.17 takes one row of vectors only.
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return np.asarray(matrices.reshape(*vectors.shape[:-1], 3, 3))


def _floats(values: ArrayLike) -> Array:
    return np.asarray(values, dtype=np.float64)


def _dot(a: Array, b: Array) -> Array:
    """Scalar products (...) of vectors (..., 3)."""
    return np.asarray((a * b).sum(axis=-1))


def _apply(matrix: Array, vector: Array) -> Array:
    """Matrices (..., 3, 3) times vectors (..., 3)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class Mount:
    """A two-axis mount, or a batch (...) of them.

    Attributes
    ----------
    first_axis, second_axis : (..., 3)
        Unit vectors in ENU at zero angles.
    zero_attitude : (..., 3, 3)
        Mirror coordinates to ENU at zero angles.
    joint : (..., 3) [m]
        The pivot of both axes, from the heliostat's position in ENU.
    mirror_offset : (..., 3) [m]
        From the pivot to the mirror's centre, in mirror coordinates.
    actuators : pair of Actuator, or None if they are not known
    axis_zero : (2,) [rad]
        Added to the actuators' angles to give the axis angles.
    is_calibrated : bool
        Whether the axes are as measured, not as surveyed: they include all tilts.
    calibrated_until : date or None
        Day of its calibration's newest photograph, if known.
    lean : (...) [rad]
        Of the pylon towards an upright mirror's front, proportional to the normal's level part.
    jitter_axis : "first" or "second"
        The less stiff axis, about which the mirror oscillates in wind.
    """

    first_axis: Array
    second_axis: Array
    zero_attitude: Array
    joint: Array
    mirror_offset: Array
    actuators: Actuators | None = None
    axis_zero: tuple[float, float] = (0.0, 0.0)
    is_calibrated: bool = False
    calibrated_until: date | None = None
    lean: float | Array = 0.0
    jitter_axis: AxisName = "first"

    @classmethod
    def juelich(
        cls,
        actuators: Actuators | None = None,
        joint: ArrayLike = (0.0, 0.0, 0.0),
        mirror_offset: ArrayLike = (0.0, 0.0, 0.175),
    ) -> "Mount":
        """First axis east; the second perpendicular, up at zero angle (Solar Tower Juelich)."""
        pivot, offset, zero = _floats(joint), _floats(mirror_offset), (-np.pi / 2, 0.0)
        return cls(_EAST, _UP, _UPRIGHT, pivot, offset, actuators, axis_zero=zero)

    @classmethod
    def azimuth_elevation(cls, mirror_offset: ArrayLike = (0.0, 0.0, 0.0)) -> "Mount":
        """First axis up, second the mirror's horizontal axis; upright and facing south at zero."""
        return cls(_UP, _EAST, _UPRIGHT, np.zeros(3), _floats(mirror_offset))

    @classmethod
    def stack(cls, mounts: Sequence["Mount"]) -> "Mount":
        """A batch (B,) of mounts, without actuators."""
        names = "first_axis", "second_axis", "zero_attitude", "joint", "mirror_offset", "lean"
        values: dict[str, Any] = {n: np.array([getattr(m, n) for m in mounts]) for n in names}
        return cls(**values)

    def tilted(self, attitude: ArrayLike) -> "Mount":
        """The mount with its foundation rotated by ``attitude`` (3, 3)."""
        turn = _floats(attitude)
        return replace(
            self,
            first_axis=self.first_axis @ turn.T,
            second_axis=self.second_axis @ turn.T,
            zero_attitude=turn @ self.zero_attitude,
        )

    def attitude(self, angles: ArrayLike) -> Array:
        """Mirror coordinates to ENU (..., 3, 3) at axis angles (..., 2) [rad]."""
        t = _floats(angles)
        turned = (
            rotation(self.first_axis, t[..., 0])
            @ rotation(self.second_axis, t[..., 1])
            @ self.zero_attitude
        )
        return lean_attitude(turned, self.lean) if np.any(self.lean) else np.asarray(turned)

    def require_within(self, motors: Array) -> None:
        """Raise `UnreachableError` unless motors (2,) [steps] are within the drives' travel."""
        for position, drive in zip(motors, self.actuators or (), strict=True):
            drive.require_within(position)

    def angles_from_motors(self, steps: ArrayLike) -> Array:
        """Axis angles (..., 2) [rad] at motor positions (..., 2) [steps]."""
        if self.actuators is None:
            raise InvalidInputError(
                "this mount has no actuators, so motor positions say nothing of its angles"
            )
        position = _floats(steps)
        turned = [
            actuator.angle(position[..., axis]) for axis, actuator in enumerate(self.actuators)
        ]
        return np.asarray(np.stack(turned, axis=-1) + np.asarray(self.axis_zero))

    def motors_from_angles(self, angles: ArrayLike) -> Array:
        """Motor positions (..., 2) [steps] at axis angles (..., 2) [rad]."""
        if self.actuators is None:
            raise InvalidInputError(
                "this mount has no actuators, so its angles have no motor positions"
            )
        turned = _floats(angles) - np.asarray(self.axis_zero)
        return np.stack(
            [actuator.steps(turned[..., axis]) for axis, actuator in enumerate(self.actuators)],
            axis=-1,
        )

    def angles_from_normal(self, normal: ArrayLike) -> Array:
        """Axis angles (..., 2) [rad] that set the mirror's normal to ``normal`` (..., 3).

        Raises `UnreachableError` if no pair of angles does (axes that are not perpendicular).
        """
        goal = _floats(normal)
        goal = goal / np.linalg.norm(goal, axis=-1, keepdims=True)
        if np.any(self.lean):
            goal = normal_before_lean(goal, self.lean)
        zero = self.zero_attitude[..., 2]
        return solve_axis_angles(self.first_axis, self.second_axis, zero, goal)

    def mirror_center(self, position: ArrayLike, attitude: ArrayLike) -> Array:
        """Mirror centres (..., 3) [m] in ENU of heliostats at ``position`` (..., 3) [m]."""
        offset = _apply(np.asarray(attitude), self.mirror_offset)
        return np.asarray(np.asarray(position) + self.joint + offset)

    def align(self, position: ArrayLike, sun: ArrayLike, aim: ArrayLike) -> Array:
        """Axis angles (..., 2) [rad] that reflect the sun from the mirror's centre to an aim point.

        The mirror's centre moves with the angles, so the bisector is computed again from the new
        centre. Three rounds leave less than a nanoradian for a pivot of decimetres. Raises
        `UnreachableError` if no mirror reflects the sun there.

        Parameters
        ----------
        position : array_like (..., 3) [m]
            The heliostat, in ENU.
        sun : array_like (..., 3)
            Unit vector towards the sun.
        aim : array_like (..., 3) [m]
        """
        source, point = _floats(sun), _floats(aim)
        center = _floats(position) + self.joint
        for _ in range(4):
            angles = self.angles_from_normal(bisector(source, point - center))
            center = self.mirror_center(position, self.attitude(angles))
        return angles


def jitter_direction(mount: Mount, angles: Array) -> Array:
    """Unit vector (3,) in ENU of a mount's axis that oscillates, at axis angles (2,) [rad]."""
    if mount.jitter_axis == "first":
        return mount.first_axis
    return np.asarray(rotation(mount.first_axis, angles[0]) @ mount.second_axis)


def bisector(sun: Array, outgoing: Array) -> Array:
    """Normals (..., 3), of any length, that reflect a ``sun`` (..., 3) along ``outgoing`` (..., 3).

    Raises `UnreachableError` if no mirror does.
    """
    normal = sun + outgoing / np.linalg.norm(outgoing, axis=-1, keepdims=True)
    if (np.linalg.norm(normal, axis=-1) < 1e-6).any():
        raise UnreachableError(
            "the aim point lies straight away from the sun; no mirror reflects there"
        )
    return np.asarray(normal)


def lean_attitude(attitude: Array, lean: float | Array) -> Array:
    """Attitudes (..., 3, 3) after the pylon leans by ``lean`` (...) [rad] times the lever."""
    sideways = np.cross(_UP, attitude[..., 2])
    lever = np.maximum(np.linalg.norm(sideways, axis=-1), _MIN_LEVER)
    return np.asarray(rotation(sideways / lever[..., None], lean * lever) @ attitude)


def normal_before_lean(normal: Array, lean: float | Array) -> Array:
    """Unit normals (..., 3) that the axes must set for the lean to make them ``normal`` (..., 3).

    The lean is a rotation by ``lean * cos(elevation)`` about a horizontal axis perpendicular to the
    normal: it lowers the elevation and keeps the azimuth.
    """
    level = np.linalg.norm(normal[..., :2], axis=-1)
    true = np.arctan2(normal[..., 2], level)
    elevation = true
    for _ in range(_LEAN_ROUNDS):
        elevation = true + lean * np.cos(elevation)
    ahead = normal[..., :2] / np.maximum(level, _MIN_LEVER)[..., None]
    return np.concatenate(
        [ahead * np.cos(elevation)[..., None], np.sin(elevation)[..., None]], axis=-1
    )


def solve_axis_angles(first: Array, second: Array, zero: Array, goal: Array) -> Array:
    """Axis angles (..., 2) [rad] that rotate normals ``zero`` to ``goal``; all arrays are (..., 3).

    Paden-Kahan subproblem 2: the second rotation sets the normal's component along the first axis,
    the first rotation the rest. Of the two solutions the one with the smaller second angle: the
    mirror does not flip over its second axis.
    """
    along = _dot(zero, second)[..., None] * second
    across = zero - along
    # first . R(second, t2) zero = constant + cosine cos(t2) + sine sin(t2)
    constant, cosine = _dot(first, along), _dot(first, across)
    sine = _dot(first, np.cross(second, across))
    ratio = (_dot(goal, first) - constant) / np.hypot(cosine, sine)
    if (np.abs(ratio) > 1 + 1e-9).any():
        raise UnreachableError("the mount cannot turn its mirror to this normal")
    phase, half_angle = np.arctan2(sine, cosine), np.arccos(np.clip(ratio, -1, 1))
    both = np.stack([phase + half_angle, phase - half_angle], axis=-1)
    both = np.arctan2(np.sin(both), np.cos(both))
    t2 = np.where(np.abs(both[..., 0]) <= np.abs(both[..., 1]), both[..., 0], both[..., 1])
    turned = _apply(rotation(second, t2), zero)
    before = turned - _dot(turned, first)[..., None] * first
    after = goal - _dot(goal, first)[..., None] * first
    t1 = np.arctan2(_dot(np.cross(before, after), first), _dot(before, after))
    return np.stack([t1, t2], axis=-1)
