"""Tracking jitter: the mount oscillates about its less stiff axis during the exposure.

What it is
    Wind, backlash and the steps of the drive let a mirror oscillate about its less stiff axis. At
    the Solar Tower Juelich this is the first axis, which points east. A heliostat type may declare
    the second one (`Mount.jitter_axis`). The spot is smeared if the
    exposure is longer than an oscillation, or if several images are averaged. The angle is Gaussian
    with ``sigma_mrad``.

Source
    Geometry alone: if the mirror turns by e about the axis a, its normal n moves by e (a x n), and
    the reflected ray by the derivative of 2 (n.s) n - s (see `model.tracing.convolution`). Dynamics
    of heliostats in wind: Griffith et al., *Structural dynamics testing and analysis for design
    evaluation and monitoring of heliostats*, J. Solar Energy Engineering 137 (2015).

In an image
    A smear along one line, which is nearly vertical on the target if the axis points east.
    Nothing changes across the line, and contours along it stay sharp.

What it scales with
    The length is twice the angle times the slant range, and less if the axis leans towards the
    normal. The direction on the target turns with the sun, depending on the mount. It is common to
    all heliostats, because the wind is.

What it is confused with
    - Slope error and sun shape: blur all directions. Compare the variances along and across the
      line.
    - Camera blur: also blurs all directions, and is constant in metres.
    - A wrong registered height of the target (``scale_y``): scales the whole image with its edges,
      instead of convolving it, and is the same for near and far heliostats.
    - Oscillation about the other axis: the same in another direction.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter, quadrature
from model.tracing.scene import Optics


@dataclass(frozen=True, eq=False)
class TrackingJitter(Effect):
    """The mirror turns about one mount axis with standard deviation ``sigma_mrad`` [mrad]."""

    name: ClassVar[str] = "tracking_jitter"
    about: ClassVar[str] = (
        "Tracking jitter: the mount oscillates about its first axis while the camera's shutter is"
        " open."
    )
    stage: ClassVar[Stage] = "optics"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"distance", "roll", "weather"})
    of_heliostats: ClassVar[bool] = True
    comes: ClassVar[frozenset[Arrival]] = frozenset({"day"})

    sigma_mrad: Scalar = parameter(0.0, 0.0, 4.0, "mrad")

    def on_optics(self, optics: Optics) -> Optics:
        """Add to the declared jitter in quadrature."""
        return replace(
            optics, tracking_jitter=quadrature(optics.tracking_jitter, 1e-3 * self.sigma_mrad)
        )
