"""Model where a heliostat reflects the sun's light at given motor positions, and the derivatives by
its parameters.

Notes
-----
The kinematic chain is that of two axes at right angles, with the small errors of a real mount. Its
frame has x along the first axis and z along the second one at zero angles. In Juelich that is east,
north and up; `KinematicChain.frame` turns other mounts into it. E is the rotation of the
foundation, T the lack of a right angle between the axes, and m the mirror's normal at zero angles::

    n = E R_x(t1) T R_z(t2) m,   E = R_z(foundation_up) R_y(foundation_north),   T = R_y(axes_skew),
                                 m = R_x(mirror_tilt) (0, -1, 0)

Light leaves the mirror's centre along 2 (n . sun) n - sun. A rotation of the foundation about east,
or of the mirror about the second axis, equals a change of a drive's zero, so neither has a separate
parameter.

A residual is the pair of angles [rad], sideways and upwards as seen from the mirror, from the
reflected ray to the measured spot. It does not depend on the plane of the spot. Arrays have leading
dimensions (H, M), heliostats and their measurements.

Sources: PAINT, ``kinematics_properties``; errors of the mount as parameters of a fit: Baheti and
Scott 1980, *Design of self-calibrating controllers for heliostats in a solar power plant*.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.actuator import Actuator, LinearActuator
from model.errors import InvalidInputError
from model.mount import Mount, rotation
from model.plant import Heliostat

Array = NDArray[np.float64]


@dataclass(frozen=True)
class KinematicParameter:
    """A kinematic parameter; ``spread`` [unit] is its prior deviation from PAINT's value."""

    name: str
    unit: str
    spread: float
    about: str


PARAMETERS = (
    KinematicParameter("east", "m", 0.05, "the pivot lies further east than surveyed"),
    KinematicParameter("north", "m", 0.05, "the pivot lies further north than surveyed"),
    KinematicParameter("up", "m", 0.05, "the pivot lies higher than surveyed"),
    KinematicParameter(
        "foundation_north",
        "rad",
        0.03,
        "the first axis dips to the east: the foundation is turned about north",
    ),
    KinematicParameter(
        "foundation_up",
        "rad",
        0.05,
        "the first axis points north of east: the foundation is turned about up",
    ),
    KinematicParameter("axes_skew", "rad", 0.005, "the axes lack a right angle"),
    KinematicParameter(
        "mirror_tilt", "rad", 0.01, "the mirror's normal is not perpendicular to the second axis"
    ),
    KinematicParameter("first_zero", "rad", 0.03, "the first drive's angle at its reference"),
    KinematicParameter("second_zero", "rad", 0.03, "the second drive's angle at its reference"),
    KinematicParameter("first_radius", "m", 0.002, "the first spindle turns at a longer arm"),
    KinematicParameter("second_radius", "m", 0.002, "the second spindle turns at a longer arm"),
    KinematicParameter(
        "first_offset", "m", 0.002, "the first spindle is held further from the pivot"
    ),
    KinematicParameter(
        "second_offset", "m", 0.002, "the second spindle is held further from the pivot"
    ),
    KinematicParameter("first_stroke", "m", 0.002, "the first spindle is longer at its reference"),
    KinematicParameter(
        "second_stroke", "m", 0.002, "the second spindle is longer at its reference"
    ),
    KinematicParameter("mirror_ahead", "m", 0.02, "the mirror lies further before the pivot"),
)
NAMES = tuple(parameter.name for parameter in PARAMETERS)
SPREAD: Array = np.array([parameter.spread for parameter in PARAMETERS])
ZEROS = slice(NAMES.index("first_zero"), NAMES.index("second_zero") + 1)
"""The drives' zeros among the parameters: lost steps and drift change them."""
STROKES = slice(NAMES.index("first_stroke"), NAMES.index("second_stroke") + 1)
"""The spindles' lengths at their references among the parameters."""

ANOTHER_KIND_M = 0.02
"""Largest difference [m] between lengths of drives of one kind; they differ by millimetres."""

# Largest relative difference between the motor steps per metre of one kind.
_ANOTHER_KIND = 0.01

_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True, eq=False)
class Readings:
    """Measurements of H heliostats, up to M each, in order of time: motors, sun and spot.

    Attributes
    ----------
    steps : (H, M, 2)
        Motor positions.
    sun : (H, M, 3)
        Unit vectors towards the sun.
    spot : (H, M, 3) [m]
        Measured centres of the light, in ENU.
    days : (H, M) [d]
        Times, from any origin.
    used : (H, M) of bool
        True for a measurement, False for padding of any finite numbers.
    """

    steps: Array
    sun: Array
    spot: Array
    days: Array
    used: NDArray[np.bool_]

    def of(self, rows: NDArray[np.intp] | slice) -> "Readings":
        """Select some heliostats, with the least padding."""
        used = self.used[rows]
        most = max(1, int(used.sum(axis=1).max(initial=0)))
        if used[:, most:].any():
            raise InvalidInputError("readings: padding must follow the measurements")
        cut = (rows, slice(0, most))
        return Readings(
            self.steps[cut], self.sun[cut], self.spot[cut], self.days[cut], used[:, :most]
        )


class AxesFrame(NamedTuple):
    """The frame of a mount's axes.

    ``turn`` (3, 3) leads from ENU to it. ``phase`` [rad] is the second angle at which the mirror's
    normal, (0, -1, 0) in the chain, is the mount's at zero.
    """

    turn: Array
    phase: float

    @classmethod
    def of(cls, mount: Mount) -> "AxesFrame":
        """The frame of a mount whose axes and normal at zero are at right angles."""
        first, second = mount.first_axis, mount.second_axis
        turn = np.stack([first, np.cross(second, first), second])
        x, y, _ = turn @ mount.zero_attitude[:, 2]
        return cls(turn, float(np.arctan2(x, -y)))


@dataclass(frozen=True, eq=False)
class KinematicChain:
    """Kinematics of H heliostats from their property files, before any calibration.

    Attributes
    ----------
    frame : (H, 3, 3)
        ENU to the frame of the axes.
    axis_zero : (H, 2) [rad]
        Added to the drives' angles.
    pivot : (H, 3) [m]
        In ENU.
    ahead : (H,) [m]
        The mirror's centre before the pivot, along the normal.
    increment, offset, radius, stroke, zero : (H, 2) [steps/m or steps/rad, m, m, m, rad]
        Of the drives, as in `model.actuator`; a rotary drive has no lengths, here one.
    sense : (H, 2)
        1, or -1 if the angle decreases with the stroke.
    is_rotary : (H, 2) of bool
    """

    frame: Array
    axis_zero: Array
    pivot: Array
    ahead: Array
    increment: Array
    offset: Array
    radius: Array
    stroke: Array
    zero: Array
    sense: Array
    is_rotary: NDArray[np.bool_]

    @classmethod
    def of(cls, heliostats: Sequence[Heliostat]) -> "KinematicChain":
        """Build the chain of heliostats; InvalidInputError for one without actuators."""
        for heliostat in heliostats:
            if heliostat.mount.actuators is None:
                raise InvalidInputError(
                    f"heliostat {heliostat.name} has no actuators in its kinematics"
                )
        drives = [heliostat.mount.actuators or () for heliostat in heliostats]

        def values(name: str) -> Array:
            return np.array(
                [[getattr(drive, name, 1.0) for drive in pair] for pair in drives], dtype=np.float64
            )

        frames = [AxesFrame.of(heliostat.mount) for heliostat in heliostats]
        return cls(
            frame=np.array([frame.turn for frame in frames]),
            axis_zero=np.array(
                [
                    np.add(heliostat.mount.axis_zero, (0.0, frame.phase))
                    for heliostat, frame in zip(heliostats, frames, strict=True)
                ]
            ),
            pivot=np.array(
                [heliostat.position + heliostat.mount.joint for heliostat in heliostats]
            ),
            ahead=np.array([heliostat.mount.mirror_offset[2] for heliostat in heliostats]),
            increment=values("increment"),
            offset=values("offset"),
            radius=values("pivot_radius"),
            stroke=values("initial_stroke_length"),
            zero=values("initial_angle"),
            sense=np.where(values("clockwise") > 0, -1.0, 1.0),
            is_rotary=np.array(
                [[not isinstance(drive, LinearActuator) for drive in pair] for pair in drives]
            ),
        )

    def kinds(self) -> list[NDArray[np.intp]]:
        """Group the rows of heliostats by kind of drive, the largest kind first.

        Drives of one kind turn the same way and have nearly the same lengths. Strokes and zeros are
        not compared: some property files have defaults for them.
        """
        found, left = [], np.arange(len(self.pivot))
        while left.size:
            first = left[0]
            alike = (self.sense[left] == self.sense[first]) & (
                self.is_rotary[left] == self.is_rotary[first]
            )
            alike &= np.abs(self.increment[left] / self.increment[first] - 1) < _ANOTHER_KIND
            for lengths in (self.offset, self.radius):
                alike &= np.abs(lengths[left] - lengths[first]) < ANOTHER_KIND_M
            of_kind = alike.all(axis=1)
            found.append(left[of_kind])
            left = left[~of_kind]
        return sorted(found, key=len, reverse=True)

    def rows(self, rows: NDArray[np.intp] | slice) -> "KinematicChain":
        """Select some heliostats."""
        return KinematicChain(**{name: value[rows] for name, value in vars(self).items()})


def apply_parameters(mount: Mount, parameters: Array) -> Mount:
    """Return a mount with ``parameters`` (P,), in the order of `PARAMETERS`."""
    if mount.actuators is None:
        raise InvalidInputError("this mount has no actuators, so there is nothing to calibrate")
    p = dict(zip(NAMES, parameters.tolist(), strict=True))
    frame = AxesFrame.of(mount)
    foundation = rotation(_Z, p["foundation_up"]) @ rotation(_Y, p["foundation_north"])
    second = foundation @ rotation(_Y, p["axes_skew"])
    tilt = rotation(rotation(_Z, frame.phase) @ _X, p["mirror_tilt"])
    first_drive, second_drive = (
        _longer(drive, p[f"{which}_radius"], p[f"{which}_offset"], p[f"{which}_stroke"])
        for which, drive in zip(("first", "second"), mount.actuators, strict=True)
    )
    return replace(
        mount,
        first_axis=frame.turn.T @ foundation @ _X,
        second_axis=frame.turn.T @ second @ _Z,
        zero_attitude=frame.turn.T @ second @ tilt @ frame.turn @ mount.zero_attitude,
        joint=mount.joint + parameters[:3],
        mirror_offset=mount.mirror_offset + p["mirror_ahead"] * _Z,
        actuators=(first_drive, second_drive),
        axis_zero=(mount.axis_zero[0] + p["first_zero"], mount.axis_zero[1] + p["second_zero"]),
        is_calibrated=True,
    )


def _longer(drive: Actuator, radius: float, offset: float, stroke: float) -> Actuator:
    if not isinstance(drive, LinearActuator):
        return drive
    return replace(
        drive,
        pivot_radius=drive.pivot_radius + radius,
        offset=drive.offset + offset,
        initial_stroke_length=drive.initial_stroke_length + stroke,
    )


class Residuals(NamedTuple):
    """Residuals (H, M, 2) [rad] and their derivatives (H, M, 2, P) by the parameters."""

    values: Array
    jacobian: Array


def residuals(
    chain: KinematicChain, readings: Readings, parameters: Array, zeros: Array
) -> Residuals:
    """Return the residuals ``measured - forecast`` with their derivatives; 0 in padding.

    Parameters
    ----------
    chain, readings
    parameters : (H, P)
        In the order of `PARAMETERS`.
    zeros : (H, M, 2) [rad]
        Added to the drives' zeros at each measurement.
    """
    p = dict(zip(NAMES, parameters.T[:, :, None], strict=True))
    angles, slopes = _drive_angles(chain, readings.steps, parameters)
    angles = angles + parameters[:, None, ZEROS] + zeros + chain.axis_zero[:, None]
    # Rotations are written out by component: matrix products would take most of the time.
    normal = _turn(0, p["mirror_tilt"], np.broadcast_to(-_Y, (*angles.shape[:2], 3)))
    tilt_axis = np.broadcast_to(_X, normal.shape)
    normal, tilt_axis = (_turn(2, angles[..., 1], vector) for vector in (normal, tilt_axis))
    second_axis = np.broadcast_to(_Z, normal.shape)
    normal, tilt_axis, second_axis = (
        _turn(1, p["axes_skew"], v) for v in (normal, tilt_axis, second_axis)
    )
    skew_axis = np.broadcast_to(_Y, normal.shape)
    turned = (_turn(0, angles[..., 0], v) for v in (normal, tilt_axis, second_axis, skew_axis))
    normal, tilt_axis, second_axis, skew_axis = turned
    first_axis = np.broadcast_to(_X, normal.shape)
    moved = [normal, tilt_axis, second_axis, skew_axis, first_axis]
    moved = [_turn(1, p["foundation_north"], v) for v in moved]
    moved = [_turn(2, p["foundation_up"], v) for v in [*moved, np.broadcast_to(_Y, normal.shape)]]
    normal, tilt_axis, second_axis, skew_axis, first_axis, north_axis = moved

    ahead = (chain.ahead[:, None] + p["mirror_ahead"])[..., None]
    # Light is seen in the frame of the axes, too.
    turn = chain.frame[:, None]
    sun, spot = (_turned(turn, vectors) for vectors in (readings.sun, readings.spot))
    center = _turned(turn, chain.pivot[:, None] + parameters[:, None, :3]) + ahead * normal
    cosine = (sun * normal).sum(axis=-1, keepdims=True)
    to_spot = spot - center
    distance = np.linalg.norm(to_spot, axis=-1, keepdims=True)
    to_spot = to_spot / distance
    sidewards = np.cross(turn[..., 2], to_spot)
    sidewards = sidewards / np.linalg.norm(sidewards, axis=-1, keepdims=True)
    seen = (
        np.stack([sidewards, np.cross(to_spot, sidewards)], axis=-2)
        * readings.used[..., None, None]
    )
    # Sines of angles decrease beyond a right angle; a robust fit stays far below it.
    residual = -(seen @ (2 * cosine * normal - sun)[..., None])[..., 0]

    # residual = -seen . direction, with seen at right angles to the direction from the mirror to
    # the spot.
    by_normal = -2 * (cosine[..., None] * seen + (seen @ normal[..., None]) * sun[..., None, :])
    shift = -seen / distance[..., None]
    by_normal = by_normal + ahead[..., None] * shift
    axes = {
        "foundation_north": north_axis,
        "foundation_up": np.broadcast_to(_Z, normal.shape),
        "axes_skew": skew_axis,
        "mirror_tilt": tilt_axis,
        "first_zero": first_axis,
        "second_zero": second_axis,
    }
    columns = dict(zip(NAMES[:3], np.moveaxis(shift @ turn, -1, 0), strict=True))
    for name, axis in axes.items():
        columns[name] = (by_normal @ np.cross(axis, normal)[..., None])[..., 0]
    for drive, which in enumerate(("first", "second")):
        for name, slope in slopes.items():
            columns[f"{which}_{name}"] = columns[f"{which}_zero"] * slope[..., drive, None]
    columns["mirror_ahead"] = (shift @ normal[..., None])[..., 0]
    return Residuals(residual, np.stack([columns[name] for name in NAMES], axis=-1))


def _turned(turn: Array, vectors: Array) -> Array:
    """Vectors (..., 3) after rotations (..., 3, 3)."""
    return np.asarray((turn @ vectors[..., None])[..., 0])


def _turn(axis: int, angle: Array, vector: Array) -> Array:
    """Rotate vectors (..., 3) about a coordinate axis by angles (...) [rad], right-handed."""
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = np.empty(vector.shape)
    x, y = (axis + 1) % 3, (axis + 2) % 3
    turned[..., axis] = vector[..., axis]
    turned[..., x] = cosine * vector[..., x] - sine * vector[..., y]
    turned[..., y] = sine * vector[..., x] + cosine * vector[..., y]
    return turned


class _Angles(NamedTuple):
    """Angles (H, M, 2) [rad] of both drives, and their slopes (H, M, 2) [rad/m] by lengths."""

    angles: Array
    slopes: dict[str, Array]


def _drive_angles(chain: KinematicChain, steps: Array, parameters: Array) -> _Angles:
    """Return the drives' angles without the zeros among the parameters."""
    first = NAMES.index("first_radius")
    radius, offset, stroke = (parameters[:, None, first + k : first + k + 2] for k in (0, 2, 4))
    radius, offset = chain.radius[:, None] + radius, chain.offset[:, None] + offset
    reference = chain.stroke[:, None] + stroke
    at, at_slopes = _pivot(steps / chain.increment[:, None] + reference, offset, radius)
    zero, zero_slopes = _pivot(reference, offset, radius)
    sense, is_rotary = chain.sense[:, None], chain.is_rotary[:, None]
    slopes = {
        name: np.where(is_rotary, 0.0, sense * (at_slopes[name] - zero_slopes[name]))
        for name in at_slopes
    }
    turned = np.where(is_rotary, steps / chain.increment[:, None], at - zero)
    return _Angles(chain.zero[:, None] + sense * turned, slopes)


# The triangle of a spindle degenerates if its sides lie in one line; a fit is kept away from it.
_WIDEST_COSINE = 1 - 1e-9


def _pivot(stroke: Array, offset: Array, radius: Array) -> _Angles:
    """Return the pivot's angle in a triangle of sides ``offset``, ``radius`` and ``stroke`` [m]."""
    cosine = (offset**2 + radius**2 - stroke**2) / (2 * offset * radius)
    cosine = np.clip(cosine, -_WIDEST_COSINE, _WIDEST_COSINE)
    sine = np.sqrt(1 - cosine**2)
    slopes = {
        "radius": -(1 / offset - cosine / radius) / sine,
        "offset": -(1 / radius - cosine / offset) / sine,
        "stroke": stroke / (offset * radius * sine),
    }
    return _Angles(np.arccos(cosine), slopes)
