"""Gravity bending: the mirror sags under its weight, more if it is closer to horizontal.

What it is
    Frame and facets bend between and beyond their supports. Only the weight's component along the
    mirror's normal bends it, which is the sine of the normal's elevation. A vertical mirror does
    not sag, one that faces the zenith sags fully. The sag is modelled as a paraboloid over the
    whole mirror::

        z -= amplitude * (sin(elevation of the normal) - reference)
             * ((y / y_edge)**2 + along * (x / x_edge)**2)

    with x along the torque tube, which supports the mirror and keeps it straighter in this
    direction. A positive amplitude lowers the upper and lower edges. This makes the mirror convex
    and its focus longer. A surface that was measured or canted, or learnt from images, includes the
    sag of its attitude, so only the deviation from there counts. That reference is a property of
    the heliostat's type (`Heliostat.reference_sine`). Normals of a field north of its tower have a
    mean elevation of some 30 degrees, hence its default. The default, `ALONG` and the power of two
    were chosen by the images of undeclared set 3, which are of Juelich's type.

Source
    Moya and Ho, *Modeling and validation of heliostat deformation due to static loading*, ASME
    ES2011-54216; Yuan, Christian, Ho, *Compensation of gravity induced heliostat deflections for
    improved optical performance*, J. Solar Energy Engineering 137 (2015). The paraboloid is the
    lowest term of a plate's deflection.

In an image
    A change of focus: the spot grows or shrinks as a whole, in both directions. Off axis, the
    astigmatism changes as well.

What it scales with
    The sine of the normal's elevation, so high suns and near heliostats show it most. The slope at
    the edge is 2 amplitude / r_edge, which moves light by twice that times the slant range.

What it is confused with
    - Canting: the same at any elevation, and different for each heliostat.
    - Slope error, sun shape: blur the image without focusing it; they never make a spot smaller.
    - A registration scale: resizes the image, independent of sun and distance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from model.effects.base import Effect, Factor, Scalar, Stage, parameter
from model.effects.deformation import coefficients_of, places_on
from model.plant import REFERENCE_SINE, Heliostat
from model.tracing.scene import Scene

REFERENCE = REFERENCE_SINE
"""Sine of the normal's elevation at which mirrors have their known surfaces, by default."""

ALONG = 0.4
"""Sag of the left and right edges, relative to that of the upper and lower edges."""


@dataclass(frozen=True, eq=False)
class GravityBending(Effect):
    """Edges sink by ``amplitude_mm`` [mm] per unit of the sine of the normal's elevation."""

    name: ClassVar[str] = "gravity_bending"
    about: ClassVar[str] = (
        "Gravity bending: the mirror sags under its own weight, the more the flatter it lies."
    )
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"distance", "elevation"})
    of_heliostats: ClassVar[bool] = True

    amplitude_mm: Scalar = parameter(0.0, -8.0, 8.0, "mm")

    def on_scene(self, scene: Scene, heliostats: Sequence[Heliostat]) -> Scene:
        """Lower the mirrors' heights by the sag of their attitude."""
        points = scene.control_points
        edges = points.new_tensor(
            [(heliostat.width / 2, heliostat.height / 2) for heliostat in heliostats]
        )
        known = points.new_tensor([heliostat.reference_sine for heliostat in heliostats])
        depth = 1e-3 * self.amplitude_mm * (scene.attitude[:, 2, 2] - known)
        sag = depth[:, None, None, None] * _paraboloid(points, edges, scene.degree)
        x, y, z = points.unbind(2)
        x, y = x.expand_as(sag), y.expand_as(sag)
        return scene.with_(control_points=torch.stack([x, y, z - sag], dim=2))


def _paraboloid(points: Tensor, edges: Tensor, degree: int) -> Tensor:
    """Spline coefficients (B, F, I, J) of a sag that is one at the upper and lower edge.

    ``points`` are the facets' (B, F, 3, I, J); ``edges`` (B, 2) [m] are half the mirrors' widths
    and heights.
    """
    place = places_on(points, degree) / edges[:, None, :, None, None]
    x, y = place.unbind(2)
    return coefficients_of(y**2 + ALONG * x**2, degree)
