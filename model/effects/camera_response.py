"""Camera response: counts that do not grow in proportion to the light.

What it is
    Cameras meant for human eyes compress bright light by a power, and every sensor ends at its full well. Light is
    taken relative to the image's peak, cut at ``saturation``, and raised to the power ``gamma``::

        seen = peak * min(light / peak, saturation)**gamma

    A gamma below one lifts the faint parts (an encoded image that was never decoded has about 0.45), one above
    darkens them.

Source
    Debevec and Malik, *Recovering high dynamic range radiance maps from photographs*, SIGGRAPH 1997; the encoding of
    consumer cameras is IEC 61966-2-1. For flux mapping the response must be linear or known: Roeger et al.,
    *Techniques to measure solar flux density distribution on large-scale receivers*, J. Solar Energy Engineering 136
    (2014).

In an image
    Contours keep their places and change their values: a point transformation. Gamma below one makes spots fat and
    flat, above one slim; a Gaussian spot of width sigma becomes one of sigma / sqrt(gamma). Saturation leaves a
    plateau with a sharp rim.

What it scales with
    Nothing of the plant: the same for all heliostats, distances and suns that one camera sees. The exposure matters
    where the saturation is the sensor's own.

What it is confused with
    - Sun shape, slope error, blur: all make spots fat, but smooth contours instead of keeping them, and grow with the
      slant range (blur excepted). A scatter of measured against forecast brightness, pixel by pixel, is a thin curve
      for a response and a cloud for a blur.
    - An error of a tracer that weights samples by parameter instead of area: looks just like gamma. Know the tracer
      true first.
    - A background that was not subtracted lifts the dark parts, too, but does so far from the spot.
"""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class CameraResponse(Effect):
    """Light is cut at ``saturation`` of the peak, then raised to the power ``gamma``."""

    name: ClassVar[str] = "camera_response"
    about: ClassVar[str] = "Camera response: counts that do not grow in proportion to the light."
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"camera"})
    comes: ClassVar[frozenset[Arrival]] = frozenset({"since", "day"})

    gamma: Scalar = parameter(1.0, 0.3, 3.0, "1", "camera")
    saturation: Scalar = parameter(1.0, 0.3, 1.0, "1", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Peak * min(image / peak, saturation)**gamma; what lies below zero counts as dark."""
        peak = images.amax(dim=(-2, -1), keepdim=True).clamp(min=1e-30)
        # The tiny share keeps the power's gradient finite where it is dark.
        share = (images / peak).clamp(min=1e-12)
        return peak * (share - (share - self.saturation).clamp(min=0)) ** self.gamma
