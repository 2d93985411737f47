"""Tracking jitter: the mount oscillates about its first axis while the camera's shutter is open.

What it is
    Wind, backlash and the steps of the drive let a mirror oscillate about the axis that is least stiff; at the Solar
    Tower Juelich that is the first, which points east. In an image that is exposed for longer than an oscillation, or
    averaged of several, the spot is smeared. The angle is Gaussian with ``sigma_mrad``.

Source
    Geometry alone: as the mirror turns by e about the axis a, its normal n moves by e (a x n), and the reflected ray
    by the derivative of 2 (n.s) n - s (see `model.tracing.convolution`). Dynamics of heliostats in wind: Griffith et
    al., *Structural dynamics testing and analysis for design evaluation and monitoring of heliostats*, J. Solar
    Energy Engineering 137 (2015).

In an image
    A smear along one line, for a first axis that points east nearly the vertical of the target; nothing is lost
    across it. Contours that run along the line stay sharp.

What it scales with
    The length is twice the angle times the slant range, less where the axis leans towards the normal; the direction
    on the target turns with the sun as the mount says. It belongs to the set: wind blows for all of them.

What it is confused with
    - Slope error and sun shape: blur all directions. Compare the variances along and across the line.
    - Camera blur: the same, and constant in metres.
    - A target whose height was registered wrongly (``scale_y``): scales the whole image, edges too, instead of
      convolving it, and is the same for near and far heliostats.
    - Swinging about the second axis: the same in another direction.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter, quadrature
from model.tracing.scene import Optics


@dataclass(frozen=True, eq=False)
class TrackingJitter(Effect):
    """The mirror turns about the first mount axis with a standard deviation of ``sigma_mrad`` [mrad]."""

    name: ClassVar[str] = "tracking_jitter"
    about: ClassVar[str] = (
        "Tracking jitter: the mount oscillates about its first axis while the camera's shutter is open."
    )
    stage: ClassVar[Stage] = "optics"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"distance", "roll", "weather"})
    of_heliostats: ClassVar[bool] = True
    comes: ClassVar[frozenset[Arrival]] = frozenset({"day"})

    sigma_mrad: Scalar = parameter(0.0, 0.0, 4.0, "mrad")

    def on_optics(self, optics: Optics) -> Optics:
        """Add to the declared jitter in quadrature."""
        return replace(optics, tracking_jitter=quadrature(optics.tracking_jitter, 1e-3 * self.sigma_mrad))
