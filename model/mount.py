"""Two-axis mounts: from motor steps to axis angles to the mirror's pose, and back.

A mount is two rotation axes in series, any two that are not parallel. The mirror's attitude (mirror to ENU) is::

    R = R(first_axis, t1) @ R(second_axis, t2) @ R_zero

where ``R_zero`` is the attitude at t1 = t2 = 0 and the second axis is given in that same zero position, so that it
turns with the first. The Juelich heliostats turn about east and then about "up"; an azimuth-elevation mount about up
and then about east. The same mirror normal reached by different mounts leaves the mirror rolled differently about it,
and so turns the flux image; hence this is data, not code.

All functions take and return float64 numpy arrays with any leading batch shape. A `Mount.stack` of mounts turns every
mirror of a batch by a mount of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import InvalidInputError, UnreachableError

Array = NDArray[np.float64]

# Mirror coordinates (x right seen from the front, y up the mirror, z normal) to ENU for a mirror standing upright and
# facing south: R_east(90 deg).
_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

_UP = np.array([0.0, 0.0, 1.0])

# Lever below which a mirror faces the zenith and its pylon does not lean.
_LEAST_LEVER = 1e-9

# Each round leaves a hundredth of the error for a lean of 10 mrad.
_LEAN_ROUNDS = 6

# Steps by which a motor's position may lie beyond an end for rounding alone.
_ROUNDING = 0.5


def rotation(axis: ArrayLike, angle: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) about ``axis`` (..., 3) by ``angle`` (...) [rad], right-handed (Rodrigues)."""
    direction = np.asarray(axis, dtype=np.float64)
    unit = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    x, y, z = unit[..., 0], unit[..., 1], unit[..., 2]
    theta = np.asarray(angle, dtype=np.float64)[..., None, None]
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    return np.asarray(np.eye(3) + np.sin(theta) * cross + (1 - np.cos(theta)) * (cross @ cross))


def _dot(a: Array, b: Array) -> Array:
    """Scalar products (...) of vectors (..., 3)."""
    return np.asarray((a * b).sum(axis=-1))


def _apply(matrix: Array, vector: Array) -> Array:
    """Matrices (..., 3, 3) times vectors (..., 3)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


@dataclass(frozen=True)
class LinearActuator:
    """A spindle that turns an axis: the pivot's angle in a triangle of sides ``offset``, ``pivot_radius`` and stroke.

    Attributes
    ----------
    increment : float [steps/m]
    initial_stroke_length, offset, pivot_radius : float [m]
    initial_angle : float [rad]
        The axis angle at zero steps.
    clockwise : bool
        Whether the angle shrinks as the stroke grows.
    max_increment : float [steps]
        The end of travel.

    Source: PAINT, ``kinematics_properties.actuators``.
    """

    increment: float
    initial_stroke_length: float
    offset: float
    pivot_radius: float
    initial_angle: float
    clockwise: bool
    max_increment: float

    def __post_init__(self) -> None:
        if min(self.increment, self.offset, self.pivot_radius) <= 0:
            raise InvalidInputError("actuator increment, offset and pivot_radius must be positive")

    def _pivot_angle(self, stroke: ArrayLike) -> Array:
        length = np.asarray(stroke, dtype=np.float64)
        cosine = (self.offset**2 + self.pivot_radius**2 - length**2) / (2 * self.offset * self.pivot_radius)
        if (np.abs(cosine) > 1).any():
            raise UnreachableError("actuator stroke does not close its triangle; check the motor position")
        return np.asarray(np.arccos(cosine))

    def angle(self, steps: ArrayLike) -> Array:
        """Axis angle (...) [rad] at motor position ``steps`` (...)."""
        stroke = np.asarray(steps, dtype=np.float64) / self.increment + self.initial_stroke_length
        turned = self._pivot_angle(stroke) - self._pivot_angle(self.initial_stroke_length)
        return self.initial_angle + (-turned if self.clockwise else turned)

    def require_within(self, steps: ArrayLike) -> None:
        """`UnreachableError` where a motor position (...) [steps] lies beyond an end of the travel."""
        position = np.asarray(steps, dtype=np.float64)
        beyond = position[~((position >= -_ROUNDING) & (position <= self.max_increment + _ROUNDING))]
        if beyond.size:
            raise UnreachableError(
                f"motor position {beyond.flat[0]:.0f} lies beyond the travel, 0 to {self.max_increment:.0f} steps; "
                "check the position, or choose another aim"
            )

    def steps(self, angle: ArrayLike) -> Array:
        """Motor position (...) [steps] at an axis angle (...) [rad]; inverts `angle`.

        Raises
        ------
        UnreachableError
            Where the angle lies beyond an end of the travel.
        """
        turned = np.asarray(angle, dtype=np.float64) - self.initial_angle
        pivot = self._pivot_angle(self.initial_stroke_length) + (-turned if self.clockwise else turned)
        if ((pivot < 0) | (pivot > np.pi)).any():
            raise UnreachableError("no stroke of the actuator turns its axis that far; choose another aim or sun")
        stroke = np.sqrt(self.offset**2 + self.pivot_radius**2 - 2 * self.offset * self.pivot_radius * np.cos(pivot))
        position = np.asarray((stroke - self.initial_stroke_length) * self.increment)
        self.require_within(position)
        return position


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
        From the heliostat's position to the pivot where the axes meet, in ENU.
    mirror_offset : (..., 3) [m]
        From the pivot to the mirror's centre, in mirror coordinates.
    actuators : pair of LinearActuator, or None
        None where an axis is driven directly, or its drive is not known.
    axis_zero : (2,) [rad]
        What is added to the actuators' angles to give the axis angles.
    is_calibrated : bool
        Whether its axes are as they were found standing, not as surveyed: no tilt is missing in them.
    calibrated_until : date or None
        The day of the newest photograph that it was calibrated by, where that is known.
    lean : (...) [rad]
        By how much the pylon leans towards where the mirror faces, for a mirror that stands upright; it goes with the
        lever of the mirror's weight, the horizontal part of its normal.
    """

    first_axis: Array
    second_axis: Array
    zero_attitude: Array
    joint: Array
    mirror_offset: Array
    actuators: tuple[LinearActuator, LinearActuator] | None = None
    axis_zero: tuple[float, float] = (0.0, 0.0)
    is_calibrated: bool = False
    calibrated_until: date | None = None
    lean: float | Array = 0.0

    @classmethod
    def juelich(
        cls,
        actuators: tuple[LinearActuator, LinearActuator] | None = None,
        joint: ArrayLike = (0.0, 0.0, 0.0),
        mirror_offset: ArrayLike = (0.0, 0.0, 0.175),
    ) -> "Mount":
        """First about east, then about an axis that is up when the first stands at zero (Solar Tower Juelich)."""
        return cls(
            first_axis=np.array([1.0, 0.0, 0.0]),
            second_axis=np.array([0.0, 0.0, 1.0]),
            zero_attitude=_UPRIGHT,
            joint=np.asarray(joint, dtype=np.float64),
            mirror_offset=np.asarray(mirror_offset, dtype=np.float64),
            actuators=actuators,
            axis_zero=(-np.pi / 2, 0.0),
        )

    @classmethod
    def azimuth_elevation(
        cls, joint: ArrayLike = (0.0, 0.0, 0.0), mirror_offset: ArrayLike = (0.0, 0.0, 0.0)
    ) -> "Mount":
        """First about up (azimuth), then about the mirror's horizontal axis (elevation); zero faces south, upright."""
        return cls(
            first_axis=np.array([0.0, 0.0, 1.0]),
            second_axis=np.array([1.0, 0.0, 0.0]),
            zero_attitude=_UPRIGHT,
            joint=np.asarray(joint, dtype=np.float64),
            mirror_offset=np.asarray(mirror_offset, dtype=np.float64),
        )

    @classmethod
    def stack(cls, mounts: Sequence["Mount"]) -> "Mount":
        """A batch (B,) of mounts, without their actuators."""
        return cls(
            first_axis=np.array([mount.first_axis for mount in mounts]),
            second_axis=np.array([mount.second_axis for mount in mounts]),
            zero_attitude=np.array([mount.zero_attitude for mount in mounts]),
            joint=np.array([mount.joint for mount in mounts]),
            mirror_offset=np.array([mount.mirror_offset for mount in mounts]),
            lean=np.array([mount.lean for mount in mounts]),
        )

    def tilted(self, attitude: ArrayLike) -> "Mount":
        """The same mount with its foundation turned by ``attitude`` (3, 3)."""
        turn = np.asarray(attitude, dtype=np.float64)
        return replace(
            self,
            first_axis=self.first_axis @ turn.T,
            second_axis=self.second_axis @ turn.T,
            zero_attitude=turn @ self.zero_attitude,
        )

    def attitude(self, angles: ArrayLike) -> Array:
        """Mirror coordinates to ENU (..., 3, 3) at axis angles (..., 2) [rad]."""
        t = np.asarray(angles, dtype=np.float64)
        turned = rotation(self.first_axis, t[..., 0]) @ rotation(self.second_axis, t[..., 1]) @ self.zero_attitude
        if not np.any(self.lean):
            return np.asarray(turned)
        sideways = np.cross(_UP, turned[..., 2])
        lever = np.maximum(np.linalg.norm(sideways, axis=-1), _LEAST_LEVER)
        return np.asarray(rotation(sideways / lever[..., None], self.lean * lever) @ turned)

    def _before_lean(self, normal: Array) -> Array:
        """The unit normal (..., 3) to which the axes must turn the mirror for the lean to make it ``normal`` (..., 3).

        The lean is a turn by ``lean * cos(elevation)`` about a horizontal axis at right angles to the normal: it lowers
        the elevation by so much, and leaves the azimuth.
        """
        if not np.any(self.lean):
            return normal
        level = np.linalg.norm(normal[..., :2], axis=-1)
        true = np.arctan2(normal[..., 2], level)
        elevation = true
        for _ in range(_LEAN_ROUNDS):
            elevation = true + self.lean * np.cos(elevation)
        ahead = normal[..., :2] / np.maximum(level, _LEAST_LEVER)[..., None]
        return np.concatenate([ahead * np.cos(elevation)[..., None], np.sin(elevation)[..., None]], axis=-1)

    def require_within(self, motors: Array) -> None:
        """`UnreachableError` where one of the motor positions (2,) [steps] lies beyond its drive's travel."""
        for position, drive in zip(motors, self.actuators or (), strict=True):
            drive.require_within(position)

    def angles_from_motors(self, steps: ArrayLike) -> Array:
        """Axis angles (..., 2) [rad] at motor positions (..., 2) [steps]."""
        if self.actuators is None:
            raise InvalidInputError("this mount has no actuators, so motor positions say nothing of its angles")
        position = np.asarray(steps, dtype=np.float64)
        turned = [actuator.angle(position[..., axis]) for axis, actuator in enumerate(self.actuators)]
        return np.asarray(np.stack(turned, axis=-1) + np.asarray(self.axis_zero))

    def motors_from_angles(self, angles: ArrayLike) -> Array:
        """Motor positions (..., 2) [steps] at axis angles (..., 2) [rad]; inverts `angles_from_motors`."""
        if self.actuators is None:
            raise InvalidInputError("this mount has no actuators, so its angles have no motor positions")
        turned = np.asarray(angles, dtype=np.float64) - np.asarray(self.axis_zero)
        return np.stack([actuator.steps(turned[..., axis]) for axis, actuator in enumerate(self.actuators)], axis=-1)

    def angles_from_normal(self, normal: ArrayLike) -> Array:
        """Axis angles (..., 2) [rad] that turn the mirror's normal to ``normal`` (..., 3).

        Of the two solutions the one with the smaller second angle: the mirror is not flipped over its second axis.
        Paden-Kahan subproblem 2: the second rotation sets the normal's component along the first axis, the first
        rotation does the rest.

        Raises
        ------
        UnreachableError
            Where no pair of angles reaches the normal (axes that are not perpendicular).
        """
        goal = np.asarray(normal, dtype=np.float64)
        goal = self._before_lean(goal / np.linalg.norm(goal, axis=-1, keepdims=True))
        zero = self.zero_attitude[..., 2]
        first, second = self.first_axis, self.second_axis
        along = _dot(zero, second)[..., None] * second
        across = zero - along
        # first . R(second, t2) zero = constant + cosine cos(t2) + sine sin(t2)
        constant, cosine, sine = _dot(first, along), _dot(first, across), _dot(first, np.cross(second, across))
        amplitude = np.hypot(cosine, sine)
        ratio = (_dot(goal, first) - constant) / amplitude
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

    def mirror_center(self, position: ArrayLike, attitude: ArrayLike) -> Array:
        """The mirror's centre (..., 3) [m] in ENU for a heliostat at ``position`` (..., 3), turned by ``attitude``."""
        return np.asarray(np.asarray(position) + self.joint + _apply(np.asarray(attitude), self.mirror_offset))

    def align(self, position: ArrayLike, sun: ArrayLike, aim: ArrayLike) -> Array:
        """Axis angles (..., 2) [rad] that reflect the sun from the mirror's centre to an aim point.

        Parameters
        ----------
        position : array_like (..., 3) [m]
            The heliostat, in ENU.
        sun : array_like (..., 3)
            Unit vector towards the sun.
        aim : array_like (..., 3) [m]

        The mirror's centre moves with the angles, so the bisector is taken again from the moved centre until it
        stands still; three rounds leave less than a nanoradian for a pivot of decimetres.
        """
        source, point = np.asarray(sun, dtype=np.float64), np.asarray(aim, dtype=np.float64)
        center = np.asarray(position, dtype=np.float64) + self.joint
        for _ in range(4):
            outgoing = point - center
            outgoing = outgoing / np.linalg.norm(outgoing, axis=-1, keepdims=True)
            bisector = source + outgoing
            if (np.linalg.norm(bisector, axis=-1) < 1e-6).any():
                raise UnreachableError("the aim point lies straight away from the sun; no mirror reflects there")
            angles = self.angles_from_normal(bisector)
            center = self.mirror_center(position, self.attitude(angles))
        return angles
