"""Sun shape: haze that spreads the sun's light into an aureole.

What it is
    Aerosol and thin cloud scatter sunlight forward by a few milliradians. To the sharp, limb-darkened disc of 4.65
    mrad comes an aureole that reaches some 44 mrad and carries a share of the energy, the circumsolar ratio: next to
    nothing under a clean sky, forty percent and more through haze and cirrus. The parameter is the chi of Buie's
    formula, which is close to that ratio but not the same.

Source
    Buie, Monger, Dey, *Sunshape distributions for terrestrial solar simulations*, Solar Energy 74 (2003),
    doi:10.1016/S0038-092X(03)00125-7, eqs. 6 to 9; measured frequencies of the ratio in Neumann et al.,
    *Representative terrestrial solar brightness profiles*, J. Solar Energy Engineering 124 (2002).

In an image
    The core keeps its shape and loses height; a broad, faint skirt appears around it, so that energy moves from the
    spot's middle beyond its former edge. The skirt has the spot's own roundness, whatever the mirror looks like.

What it scales with
    The skirt's size grows in proportion to the slant range, and is stretched where the beam meets the target at a
    slant. It is the same for all heliostats at one time, for it is the sky's, and changes from day to day.

What it is confused with
    - Slope error: a Gaussian without a far skirt. Tell them by the tails beyond three sigma, and by the fact that
      slope errors belong to a heliostat while haze belongs to an hour.
    - Camera blur: the same size in metres at every distance; compare near and far heliostats.
    - A gamma below one: lifts faint light, and so makes a skirt too, but one that follows the image's own contours
      and not the distance, and that lifts the background with it.
    - A background: has no maximum at the spot.

Neutral at 0.02, a clear sky's, which any declared sun is taken to have: what counts is the haze over that.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter
from model.sunshape import CLEAR_SKY, Buie, Hazy
from model.tracing.scene import Optics


@dataclass(frozen=True, eq=False)
class SunShapeEffect(Effect):
    """The declared sun behind haze; Buie's sun with 0.02, the default, becomes Buie's with ``circumsolar_ratio``."""

    name: ClassVar[str] = "sun_shape"
    about: ClassVar[str] = "Sun shape: haze that spreads the sun's light into an aureole."
    stage: ClassVar[Stage] = "optics"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"distance", "weather"})
    comes: ClassVar[frozenset[Arrival]] = frozenset({"day"})

    circumsolar_ratio: Scalar = parameter(CLEAR_SKY, 0.0, 0.5, "1")

    def on_optics(self, optics: Optics) -> Optics:
        """Put the haze before the sun."""
        if optics.sun_shape == Buie(CLEAR_SKY):
            return replace(optics, sun_shape=Buie(self.circumsolar_ratio))
        return replace(optics, sun_shape=Hazy(optics.sun_shape, self.circumsolar_ratio))
