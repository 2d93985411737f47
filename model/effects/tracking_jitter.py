"""Tracking jitter: the mount swings about its first axis while the camera's shutter is open."""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Effect, Scalar, Stage, parameter, quadrature
from model.tracing.scene import Optics


@dataclass(frozen=True, eq=False)
class TrackingJitter(Effect):
    """The mirror turns about the first mount axis with a standard deviation of ``sigma_mrad`` [mrad]."""

    name: ClassVar[str] = "tracking_jitter"
    stage: ClassVar[Stage] = "optics"

    sigma_mrad: Scalar = parameter(0.0, 0.0, 4.0, "mrad")

    def on_optics(self, optics: Optics) -> Optics:
        """Add to the declared jitter in quadrature."""
        return replace(optics, tracking_jitter=quadrature(optics.tracking_jitter, 1e-3 * self.sigma_mrad))
