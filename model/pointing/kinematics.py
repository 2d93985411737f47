"""Where a heliostat sends the sun's light at its motors' steps: the parameters of its mount, and what each one moves.

The chain is that of PAINT with the small errors of a real mount in it. With E the turn of the foundation, T the lack of
a right angle between the axes, and m the mirror's normal at zero angles::

    n = E R_x(t1) T R_z(t2) m,   E = R_z(foundation_up) R_y(foundation_north),   T = R_y(axes_skew),
                                 m = R_x(mirror_tilt) (0, -1, 0)

and light leaves the mirror's centre along 2 (n . sun) n - sun. A turn of the foundation about east, or of the mirror
about the second axis, is one of a drive's zero and has no parameter of its own.

A residual is the pair of angles [rad], sidewards and upwards as seen from the mirror, from the light's way to the
measured spot: what the spot is off, whatever plane it lies on. Arrays have leading dimensions (H, M), heliostats and
their measurements.

Sources: PAINT, ``kinematics_properties``; errors of the mount as parameters of a fit: Baheti and Scott 1980, *Design of
self-calibrating controllers for heliostats in a solar power plant*.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.mount import LinearActuator, Mount, rotation
from model.plant import Heliostat

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """A kinematic parameter: its unit, its spread over a field of one kind, and what it is.

    ``spread`` [unit] is the standard deviation about PAINT's value that is believed before a field has been seen.
    """

    name: str
    unit: str
    spread: float
    about: str


PARAMETERS = (
    Parameter("east", "m", 0.05, "the pivot lies further east than surveyed"),
    Parameter("north", "m", 0.05, "the pivot lies further north than surveyed"),
    Parameter("up", "m", 0.05, "the pivot lies higher than surveyed"),
    Parameter("foundation_north", "rad", 0.03, "the first axis dips to the east: the foundation is turned about north"),
    Parameter("foundation_up", "rad", 0.05, "the first axis points north of east: the foundation is turned about up"),
    Parameter("axes_skew", "rad", 0.005, "the axes lack a right angle"),
    Parameter("mirror_tilt", "rad", 0.01, "the mirror's normal is not perpendicular to the second axis"),
    Parameter("first_zero", "rad", 0.03, "the first drive's angle at its reference"),
    Parameter("second_zero", "rad", 0.03, "the second drive's angle at its reference"),
    Parameter("first_radius", "m", 0.002, "the first spindle turns at a longer arm"),
    Parameter("second_radius", "m", 0.002, "the second spindle turns at a longer arm"),
    Parameter("first_offset", "m", 0.002, "the first spindle is held further from the pivot"),
    Parameter("second_offset", "m", 0.002, "the second spindle is held further from the pivot"),
    Parameter("first_stroke", "m", 0.002, "the first spindle is longer at its reference"),
    Parameter("second_stroke", "m", 0.002, "the second spindle is longer at its reference"),
    Parameter("mirror_ahead", "m", 0.02, "the mirror lies further before the pivot"),
)
NAMES = tuple(parameter.name for parameter in PARAMETERS)
SPREAD: Array = np.array([parameter.spread for parameter in PARAMETERS])
ZEROS = slice(NAMES.index("first_zero"), NAMES.index("second_zero") + 1)
"""Where the drives' zeros stand among the parameters: what lost steps and drift move."""
STROKES = slice(NAMES.index("first_stroke"), NAMES.index("second_stroke") + 1)
"""Where the spindles' lengths at their references stand."""

ANOTHER_KIND_M = 0.02
"""Lengths [m] of drives of one kind differ by millimetres; by more than this they are another kind's."""

# Their motors' steps a metre differ by less than this share.
_ANOTHER_KIND = 0.01

_X, _Y, _Z = np.eye(3)


@dataclass(frozen=True, eq=False)
class Readings:
    """What motors, sun and photographs said: H heliostats with up to M measurements each, in order of time.

    Attributes
    ----------
    steps : (H, M, 2)
        Motor positions.
    sun : (H, M, 3)
        Unit vectors towards the sun.
    spot : (H, M, 3) [m]
        Measured centres of the light, in ENU.
    days : (H, M) [d]
        When, from any moment on.
    used : (H, M) of bool
        Where there is a measurement; the rest is padding, which may hold any finite numbers.
    """

    steps: Array
    sun: Array
    spot: Array
    days: Array
    used: NDArray[np.bool_]

    def of(self, rows: NDArray[np.intp] | slice) -> "Readings":
        """Those of some heliostats, no more padded than they need."""
        used = self.used[rows]
        most = max(1, int(used.sum(axis=1).max(initial=0)))
        if used[:, most:].any():
            raise InvalidInputError("readings: padding must follow the measurements")
        cut = (rows, slice(0, most))
        return Readings(self.steps[cut], self.sun[cut], self.spot[cut], self.days[cut], used[:, :most])


@dataclass(frozen=True, eq=False)
class Chain:
    """Kinematics of H heliostats as their properties have them, before any calibration.

    Attributes
    ----------
    pivot : (H, 3) [m]
    ahead : (H,) [m]
        The mirror's centre before the pivot, along the normal.
    increment, offset, radius, stroke, zero : (H, 2) [steps/m, m, m, m, rad]
        The drives', as in `model.mount.LinearActuator`.
    sense : (H, 2)
        1, or -1 where the angle shrinks as the stroke grows.
    """

    pivot: Array
    ahead: Array
    increment: Array
    offset: Array
    radius: Array
    stroke: Array
    zero: Array
    sense: Array

    @classmethod
    def of(cls, heliostats: Sequence[Heliostat]) -> "Chain":
        """The chain of heliostats whose mounts all have actuators; InvalidInputError for one that has none."""
        for heliostat in heliostats:
            if heliostat.mount.actuators is None:
                raise InvalidInputError(f"heliostat {heliostat.name} has no linear actuators in its kinematics")
        drives = [heliostat.mount.actuators or () for heliostat in heliostats]

        def values(name: str) -> Array:
            return np.array([[getattr(drive, name) for drive in pair] for pair in drives], dtype=np.float64)

        return cls(
            pivot=np.array([heliostat.position + heliostat.mount.joint for heliostat in heliostats]),
            ahead=np.array([heliostat.mount.mirror_offset[2] for heliostat in heliostats]),
            increment=values("increment"),
            offset=values("offset"),
            radius=values("pivot_radius"),
            stroke=values("initial_stroke_length"),
            zero=values("initial_angle"),
            sense=np.where(values("clockwise") > 0, -1.0, 1.0),
        )

    def kinds(self) -> list[NDArray[np.intp]]:
        """Rows of heliostats whose drives are of one kind, the largest kind first.

        Those of one kind turn the same ways, and differ by what single heliostats are adjusted by. Their strokes and
        zeros are no mark of a kind: some property files hold defaults for them.
        """
        found, left = [], np.arange(len(self.pivot))
        while left.size:
            one = left[0]
            alike = (self.sense[left] == self.sense[one]) & (
                np.abs(self.increment[left] / self.increment[one] - 1) < _ANOTHER_KIND
            )
            for lengths in (self.offset, self.radius):
                alike &= np.abs(lengths[left] - lengths[one]) < ANOTHER_KIND_M
            of_kind = alike.all(axis=1)
            found.append(left[of_kind])
            left = left[~of_kind]
        return sorted(found, key=len, reverse=True)

    def rows(self, rows: NDArray[np.intp] | slice) -> "Chain":
        """The chain of some of the heliostats."""
        return Chain(**{name: value[rows] for name, value in vars(self).items()})


def calibrated(mount: Mount, parameters: Array) -> Mount:
    """A mount of PAINT's kind with its ``parameters`` (P,), in the order of `PARAMETERS`, in it."""
    if mount.actuators is None:
        raise InvalidInputError("this mount has no actuators, so there is nothing to calibrate")
    p = dict(zip(NAMES, parameters.tolist(), strict=True))
    foundation = rotation(_Z, p["foundation_up"]) @ rotation(_Y, p["foundation_north"])
    second = foundation @ rotation(_Y, p["axes_skew"])
    first_drive, second_drive = (
        _longer(drive, p[f"{which}_radius"], p[f"{which}_offset"], p[f"{which}_stroke"])
        for which, drive in zip(("first", "second"), mount.actuators, strict=True)
    )
    return replace(
        mount,
        first_axis=foundation @ _X,
        second_axis=second @ _Z,
        zero_attitude=second @ rotation(_X, p["mirror_tilt"]) @ mount.zero_attitude,
        joint=mount.joint + parameters[:3],
        mirror_offset=mount.mirror_offset + p["mirror_ahead"] * _Z,
        actuators=(first_drive, second_drive),
        axis_zero=(mount.axis_zero[0] + p["first_zero"], mount.axis_zero[1] + p["second_zero"]),
        is_calibrated=True,
    )


def _longer(drive: LinearActuator, radius: float, offset: float, stroke: float) -> LinearActuator:
    return replace(
        drive,
        pivot_radius=drive.pivot_radius + radius,
        offset=drive.offset + offset,
        initial_stroke_length=drive.initial_stroke_length + stroke,
    )


@dataclass(frozen=True, eq=False)
class Light:
    """Where light leaves a mirror and whither: ``center`` (H, M, 3) [m] and unit ``direction`` (H, M, 3)."""

    center: Array
    direction: Array


def residuals(chain: Chain, readings: Readings, parameters: Array, zeros: Array) -> tuple[Array, Array]:
    """Residuals (H, M, 2) [rad] and their derivatives (H, M, 2, P) by the parameters.

    ``parameters`` (H, P) are in the order of `PARAMETERS`; ``zeros`` (H, M, 2) [rad] are added to those of the drives
    at each measurement. What a photograph shows is ``residual = measured - forecast``, both 0 where nothing is used.
    """
    p = dict(zip(NAMES, parameters.T[:, :, None], strict=True))
    angles, slopes = _drive_angles(chain, readings.steps, parameters)
    angles = angles + parameters[:, None, ZEROS] + zeros
    # Rotations are written out: each is a turn of two components, and matrices would take most of the time.
    normal = _turn(0, p["mirror_tilt"], np.broadcast_to(-_Y, (*angles.shape[:2], 3)))
    tilt_axis = np.broadcast_to(_X, normal.shape)
    normal, tilt_axis = (_turn(2, angles[..., 1], vector) for vector in (normal, tilt_axis))
    second_axis = np.broadcast_to(_Z, normal.shape)
    normal, tilt_axis, second_axis = (_turn(1, p["axes_skew"], v) for v in (normal, tilt_axis, second_axis))
    skew_axis = np.broadcast_to(_Y, normal.shape)
    turned = (_turn(0, angles[..., 0] - np.pi / 2, v) for v in (normal, tilt_axis, second_axis, skew_axis))
    normal, tilt_axis, second_axis, skew_axis = turned
    first_axis = np.broadcast_to(_X, normal.shape)
    moved = [normal, tilt_axis, second_axis, skew_axis, first_axis]
    moved = [_turn(1, p["foundation_north"], v) for v in moved]
    moved = [_turn(2, p["foundation_up"], v) for v in [*moved, np.broadcast_to(_Y, normal.shape)]]
    normal, tilt_axis, second_axis, skew_axis, first_axis, north_axis = moved

    ahead = (chain.ahead[:, None] + p["mirror_ahead"])[..., None]
    center = chain.pivot[:, None] + parameters[:, None, :3] + ahead * normal
    cosine = (readings.sun * normal).sum(axis=-1, keepdims=True)
    to_spot = readings.spot - center
    distance = np.linalg.norm(to_spot, axis=-1, keepdims=True)
    to_spot = to_spot / distance
    sidewards = np.cross(_Z, to_spot)
    sidewards = sidewards / np.linalg.norm(sidewards, axis=-1, keepdims=True)
    seen = np.stack([sidewards, np.cross(to_spot, sidewards)], axis=-2) * readings.used[..., None, None]
    # The angles' sines would bend back beyond a right angle; a robust fit never gets there.
    residual = -(seen @ (2 * cosine * normal - readings.sun)[..., None])[..., 0]

    # residual = -seen . direction, where seen is at right angles to the way from the mirror to the spot.
    by_normal = -2 * (cosine[..., None] * seen + (seen @ normal[..., None]) * readings.sun[..., None, :])
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
    columns = dict(zip(NAMES[:3], np.moveaxis(shift, -1, 0), strict=True))
    for name, axis in axes.items():
        columns[name] = (by_normal @ np.cross(axis, normal)[..., None])[..., 0]
    for drive, which in enumerate(("first", "second")):
        for name, slope in slopes.items():
            columns[f"{which}_{name}"] = columns[f"{which}_zero"] * slope[..., drive, None]
    columns["mirror_ahead"] = (shift @ normal[..., None])[..., 0]
    return residual, np.stack([columns[name] for name in NAMES], axis=-1)


def _turn(axis: int, angle: Array, vector: Array) -> Array:
    """Vectors (..., 3) turned about a coordinate axis by angles (...) [rad], right-handed."""
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = np.empty(vector.shape)
    one, two = (axis + 1) % 3, (axis + 2) % 3
    turned[..., axis] = vector[..., axis]
    turned[..., one] = cosine * vector[..., one] - sine * vector[..., two]
    turned[..., two] = sine * vector[..., one] + cosine * vector[..., two]
    return turned


def _drive_angles(chain: Chain, steps: Array, parameters: Array) -> tuple[Array, dict[str, Array]]:
    """Angles (H, M, 2) [rad] of both drives without their zeros, and their slopes (H, M, 2) [rad/m]."""
    first = NAMES.index("first_radius")
    radius, offset, stroke = (parameters[:, None, first + k : first + k + 2] for k in (0, 2, 4))
    radius, offset = chain.radius[:, None] + radius, chain.offset[:, None] + offset
    reference = chain.stroke[:, None] + stroke
    at, at_slopes = _pivot(steps / chain.increment[:, None] + reference, offset, radius)
    zero, zero_slopes = _pivot(reference, offset, radius)
    sense = chain.sense[:, None]
    return chain.zero[:, None] + sense * (at - zero), {
        name: sense * (at_slopes[name] - zero_slopes[name]) for name in at_slopes
    }


# The triangle of a spindle is degenerate where its sides lie in one line; a fit is kept from there.
_WIDEST_COSINE = 1 - 1e-9


def _pivot(stroke: Array, offset: Array, radius: Array) -> tuple[Array, dict[str, Array]]:
    """The pivot's angle [rad] in a triangle of sides ``offset``, ``radius`` and ``stroke`` [m], and its slopes."""
    cosine = (offset**2 + radius**2 - stroke**2) / (2 * offset * radius)
    cosine = np.clip(cosine, -_WIDEST_COSINE, _WIDEST_COSINE)
    sine = np.sqrt(1 - cosine**2)
    return np.arccos(cosine), {
        "radius": -(1 / offset - cosine / radius) / sine,
        "offset": -(1 / radius - cosine / offset) / sine,
        "stroke": stroke / (offset * radius * sine),
    }
