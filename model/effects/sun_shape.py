"""Sun shape: haze that spreads the sun's light into an aureole.

What it is
    Aerosol and thin cloud scatter sunlight forward by a few milliradians. The sharp, limb-darkened
    disc of 4.65 mrad gets an aureole that reaches some 44 mrad. Its share of the energy is the
    circumsolar ratio: nearly zero for a clean sky, forty percent and more for haze and cirrus. The
    parameter is the chi of Buie's formula, which is close to that ratio but not the same.

Source
    Buie, Monger, Dey, *Sunshape distributions for terrestrial solar simulations*, Solar Energy 74
    (2003), doi:10.1016/S0038-092X(03)00125-7, eqs. 6 to 9; measured frequencies of the ratio in
    Neumann et al., *Representative terrestrial solar brightness profiles*, J. Solar Energy
    Engineering 124 (2002).

In an image
    The core keeps its shape and loses height. A broad, faint skirt appears around it, so energy
    moves from the spot's centre beyond its former edge. The skirt is round for any mirror.

What it scales with
    The skirt's size grows in proportion to the slant range, and increases if the beam meets the
    target obliquely. It belongs to the sky, so it is the same for all heliostats at one time, and
    changes from day to day.

What it is confused with
    - Slope error: a Gaussian without a far skirt. The tails beyond three sigma distinguish them.
      Slope errors also belong to a heliostat, and haze to an hour.
    - Camera blur: the same size in metres at every distance; compare near and far heliostats.
    - A gamma below one: raises faint light, and so makes a skirt too. But its skirt follows the
      image's contours and not the distance, and it raises the background as well.
    - A background: has no maximum at the spot.

The neutral value is 0.02, that of a clear sky. Any declared sun is assumed to include it; only haze
above it counts.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Arrival, Effect, Factor, Scalar, Stage, parameter
from model.sunshape import CLEAR_SKY, Buie, Hazy
from model.tracing.scene import Optics


@dataclass(frozen=True, eq=False)
class SunShapeEffect(Effect):
    """The declared sun behind haze.

    The default sun, Buie's with 0.02, becomes Buie's with ``circumsolar_ratio``.
    """

    name: ClassVar[str] = "sun_shape"
    about: ClassVar[str] = "Sun shape: haze that spreads the sun's light into an aureole."
    stage: ClassVar[Stage] = "optics"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"distance", "weather"})
    comes: ClassVar[frozenset[Arrival]] = frozenset({"since", "day"})

    circumsolar_ratio: Scalar = parameter(CLEAR_SKY, 0.0, 0.5, "1")

    def on_optics(self, optics: Optics) -> Optics:
        """Add the haze to the sun shape."""
        if optics.sun_shape == Buie(CLEAR_SKY):
            return replace(optics, sun_shape=Buie(self.circumsolar_ratio))
        return replace(optics, sun_shape=Hazy(optics.sun_shape, self.circumsolar_ratio))
