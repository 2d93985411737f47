"""Pillbox: the solar disc evenly bright, without limb darkening and aureole."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from model.sunshape.base import SOLAR_DISC, SunShape, check


@dataclass(frozen=True)
class Pillbox(SunShape):
    """A disc of even radiance with half angle ``half_angle`` [rad]."""

    units: ClassVar[Mapping[str, float]] = {"half_angle_mrad": 1e-3}

    half_angle: float = SOLAR_DISC

    def __post_init__(self) -> None:
        check("pillbox half_angle [rad]", self.half_angle, 1e-6, 0.1)

    @property
    def edges(self) -> Sequence[float]:
        """The disc's centre and rim [rad]."""
        return (0.0, float(self.half_angle))

    def profile(self, angle: Tensor) -> Tensor:
        """One inside the disc."""
        return (angle <= self.half_angle).to(angle.dtype)
