"""Camera response: counts that are not proportional to the light.

What it is
    Consumer cameras compress bright light by a power, and every sensor has a full well. Light is
    relative to the image's peak, limited to ``saturation``, and raised to the power ``gamma``::

        seen = peak * min(light / peak, saturation)**gamma

    A gamma below one raises the faint parts; an encoded image that was never decoded has about
    0.45. A gamma above one darkens them.

Source
    Debevec and Malik, *Recovering high dynamic range radiance maps from photographs*, SIGGRAPH
    1997; the encoding of consumer cameras is IEC 61966-2-1. For flux mapping the response must be
    linear or known: Roeger et al., *Techniques to measure solar flux density distribution on
    large-scale receivers*, J. Solar Energy Engineering 136 (2014).

In an image
    Contours keep their positions and change their values: a point operation. A gamma below one
    makes spots wide and flat, above one narrow. A Gaussian spot of width sigma gets the width
    sigma / sqrt(gamma). Saturation leaves a plateau with a sharp rim.

What it scales with
    Nothing of the plant: the same for all heliostats, distances and suns of one camera. The
    exposure matters if the sensor itself saturates.

What it is confused with
    - Sun shape, slope error, blur: all widen spots, but smooth contours instead of keeping them,
      and grow with the slant range (except blur). A scatter plot of measured against forecast
      brightness, pixel by pixel, is a thin curve for a response and a cloud for a blur.
    - A tracer that weights samples by parameter instead of area: looks exactly like gamma. Verify
      the tracer first.
    - A background that was not subtracted: raises the dark parts too, but also far from the spot.
"""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class CameraResponse(Effect):
    """Light is limited to ``saturation`` of the peak, then raised to the power ``gamma``."""

    name: ClassVar[str] = "camera_response"
    about: ClassVar[str] = "Camera response: counts that do not grow in proportion to the light."
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"camera"})
    comes: ClassVar[frozenset[Arrival]] = frozenset({"since", "day"})

    gamma: Scalar = parameter(1.0, 0.3, 3.0, "1", "camera")
    saturation: Scalar = parameter(1.0, 0.3, 1.0, "1", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Apply peak * min(image / peak, saturation)**gamma; negative values count as dark."""
        peak = images.amax(dim=(-2, -1), keepdim=True).clamp(min=1e-30)
        # The small lower bound keeps the power's gradient finite in dark pixels.
        share = (images / peak).clamp(min=1e-12)
        return peak * (share - (share - self.saturation).clamp(min=0)) ** self.gamma
