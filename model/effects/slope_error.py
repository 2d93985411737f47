"""Slope error: waviness of the mirror that is too fine for the surface's control points.

What it is
    Ripple of the glass, roughness and dew tilt the mirror's normals at random. The scale is below
    the resolution of a facet's B-spline (some 20 cm). Each normal has a Gaussian error of
    ``sigma_mrad`` along each of two axes across it.

Source
    The optical error of Rabl, *Active Solar Collectors and Their Applications* (1985): independent
    errors add in quadrature, and a slope counts twice. Measurements: Ulmer et al., *Automated high
    resolution measurement of heliostat slope errors*, Solar Energy 85 (2011),
    doi:10.1016/j.solener.2010.01.010.

In an image
    The spot is blurred by a Gaussian of 2 sigma in the plane of incidence and 2 sigma
    cos(incidence) across it. Fine structure disappears first; the far tails stay dark.

What it scales with
    In proportion to the slant range, and with the incidence in one direction. It stays with a
    heliostat from image to image and from year to year, except for dew and frost.

What it is confused with
    - Sun shape: spreads light in the same way, but into far tails, and is the same for all
      heliostats at one time.
    - Camera blur: constant in metres, and round on the target at any incidence.
    - Tracking jitter: smears along a line, whose direction depends on the mount.
    - A surface that is too smooth: its missing waviness appears as slope error. With a surface of
      finer control points, the effect disappears.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Effect, Factor, Scalar, Stage, parameter, quadrature
from model.tracing.scene import Optics


@dataclass(frozen=True, eq=False)
class SlopeError(Effect):
    """The mirror's normals scatter with a standard deviation of ``sigma_mrad`` [mrad] per axis."""

    name: ClassVar[str] = "slope_error"
    about: ClassVar[str] = (
        "Slope error: waviness of the mirror too fine for the surface's control points."
    )
    stage: ClassVar[Stage] = "optics"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"distance", "heliostat"})
    of_heliostats: ClassVar[bool] = True

    sigma_mrad: Scalar = parameter(0.0, 0.0, 4.0, "mrad")

    def on_optics(self, optics: Optics) -> Optics:
        """Add to the declared slope error in quadrature."""
        return replace(optics, slope_error=quadrature(optics.slope_error, 1e-3 * self.sigma_mrad))
