"""Actuators of an axis: from motor steps to axis angles, and back."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import InvalidInputError, UnreachableError

Array = NDArray[np.float64]

# Steps beyond an end of the travel that are rounding errors.
_ROUNDING = 0.5


@dataclass(frozen=True)
class LinearActuator:
    """A spindle that rotates an axis: the pivot's angle in a triangle of ``offset``,
    ``pivot_radius`` and stroke.

    Attributes
    ----------
    increment : float [steps/m]
    initial_stroke_length, offset, pivot_radius : float [m]
    initial_angle : float [rad]
        The axis angle at zero steps.
    clockwise : bool
        Whether the angle decreases as the stroke increases.
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
        cosine = (self.offset**2 + self.pivot_radius**2 - length**2) / (
            2 * self.offset * self.pivot_radius
        )
        if (np.abs(cosine) > 1).any():
            raise UnreachableError(
                "actuator stroke does not close its triangle; check the motor position"
            )
        return np.asarray(np.arccos(cosine))

    def angle(self, steps: ArrayLike) -> Array:
        """Axis angle (...) [rad] at motor position ``steps`` (...)."""
        stroke = np.asarray(steps, dtype=np.float64) / self.increment + self.initial_stroke_length
        turned = self._pivot_angle(stroke) - self._pivot_angle(self.initial_stroke_length)
        return self.initial_angle + (-turned if self.clockwise else turned)

    def require_within(self, steps: ArrayLike) -> None:
        """Check that motor positions (...) [steps] are within the travel.

        Raises
        ------
        UnreachableError
            If one is not.
        """
        position = np.asarray(steps, dtype=np.float64)
        beyond = position[
            ~((position >= -_ROUNDING) & (position <= self.max_increment + _ROUNDING))
        ]
        if beyond.size:
            raise UnreachableError(
                f"motor position {beyond.flat[0]:.0f} lies beyond the travel, 0 to"
                f" {self.max_increment:.0f} steps; check the position, or choose another aim"
            )

    def steps(self, angle: ArrayLike) -> Array:
        """Motor position (...) [steps] at an axis angle (...) [rad]; the inverse of `angle`.

        Raises
        ------
        UnreachableError
            If the angle is beyond an end of the travel.
        """
        turned = np.asarray(angle, dtype=np.float64) - self.initial_angle
        pivot = self._pivot_angle(self.initial_stroke_length) + (
            -turned if self.clockwise else turned
        )
        if ((pivot < 0) | (pivot > np.pi)).any():
            raise UnreachableError(
                "no stroke of the actuator turns its axis that far; choose another aim or sun"
            )
        stroke = np.sqrt(
            self.offset**2
            + self.pivot_radius**2
            - 2 * self.offset * self.pivot_radius * np.cos(pivot)
        )
        position = np.asarray((stroke - self.initial_stroke_length) * self.increment)
        self.require_within(position)
        return position


@dataclass(frozen=True)
class RotaryActuator:
    """A gear that rotates an axis in proportion to its motor's position.

    Attributes
    ----------
    increment : float [steps/rad]
        One for motor positions that are angles in radians.
    initial_angle : float [rad]
        The axis angle at zero steps.
    clockwise : bool
        Whether the angle decreases as the position increases.
    """

    increment: float = 1.0
    initial_angle: float = 0.0
    clockwise: bool = False

    def __post_init__(self) -> None:
        if self.increment <= 0:
            raise InvalidInputError("actuator increment must be positive")

    def angle(self, steps: ArrayLike) -> Array:
        """Axis angle (...) [rad] at motor position ``steps`` (...)."""
        turned = np.asarray(steps, dtype=np.float64) / self.increment
        return np.asarray(self.initial_angle + (-turned if self.clockwise else turned))

    def steps(self, angle: ArrayLike) -> Array:
        """Motor position (...) [steps] at an axis angle (...) [rad]; the inverse of `angle`."""
        turned = np.asarray(angle, dtype=np.float64) - self.initial_angle
        return np.asarray((-turned if self.clockwise else turned) * self.increment)

    def require_within(self, steps: ArrayLike) -> None:
        """Accept every position: the axis has no end of travel."""


Actuator = LinearActuator | RotaryActuator
Actuators = tuple[Actuator, Actuator]
"""Of the first and of the second axis."""
