"""Slope error: waviness of the mirror too fine for the surface's control points."""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Effect, Scalar, Stage, parameter, quadrature
from model.tracing.scene import Optics


@dataclass(frozen=True, eq=False)
class SlopeError(Effect):
    """The mirror's normals scatter with a standard deviation of ``sigma_mrad`` [mrad] per axis."""

    name: ClassVar[str] = "slope_error"
    stage: ClassVar[Stage] = "optics"

    sigma_mrad: Scalar = parameter(0.0, 0.0, 4.0, "mrad")

    def on_optics(self, optics: Optics) -> Optics:
        """Add to the declared slope error in quadrature."""
        return replace(optics, slope_error=quadrature(optics.slope_error, 1e-3 * self.sigma_mrad))
