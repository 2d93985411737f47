"""Target registration: errors of the target's corners.

What it is
    A photograph is rectified by the corners of the target. Corners with errors of some pixels, or a
    target that was surveyed with the wrong size, leave an affine error. A point (x, y) [m, right
    and up of the centre] appears at::

        R(rotation_deg) (scale_x * (x + shear * y), scale_y * y)

    with R turning anticlockwise. A shift is not included, because images are aligned by their
    spots.

Source
    The hierarchy of plane transformations in Hartley and Zisserman, *Multiple View Geometry in
    Computer Vision*, section 2.4.

In an image
    The spot is wider, flatter, sheared or turned, with all its detail, and so are the target's
    edges and marks. Irradiance keeps its values: energy on the image grows with the area, scale_x *
    scale_y.

What it scales with
    Nothing of the heliostat: the same for all of them on one target, at any distance and sun. Two
    targets of one camera have different errors.

What it is confused with
    - Gravity and focus errors: resize the spot, but differently at every distance and elevation,
      and without its blurred rim.
    - Blur in one direction (jitter): adds a variance, while a scale multiplies it; compare small
      and large spots.
    - Axis tilt: turns images by an angle that depends on the mount's position; a registration's
      angle is always the same.
    - A wrong aspect ratio of the pixels: changes scale_x relative to scale_y.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from model.effects.base import Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class TargetRegistration(Effect):
    """The image shows the target scaled, sheared and turned about its centre.

    A point (x, y) [m, right and up] appears at R(rotation_deg) (scale_x * (x + shear * y), scale_y
    * y), with R anticlockwise.
    """

    name: ClassVar[str] = "target_registration"
    about: ClassVar[str] = (
        "Target registration: the target's corners were not found where they are."
    )
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"camera"})

    scale_x: Scalar = parameter(1.0, 0.8, 1.25, "1", "camera")
    scale_y: Scalar = parameter(1.0, 0.8, 1.25, "1", "camera")
    shear: Scalar = parameter(0.0, -0.2, 0.2, "1", "camera")
    rotation_deg: Scalar = parameter(0.0, -15.0, 15.0, "deg", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Resample bicubically; irradiance keeps its values, and pixels outside are dark."""
        size = images.new_tensor([window.width, -window.height])  # grids count rows downwards
        # The grid gives the source position of each pixel in the true image, in half sizes.
        back = torch.linalg.inv(self._matrix(images)) * size / size[:, None]
        theta = torch.cat([back, images.new_zeros(2, 1)], dim=1)[None]
        grid = affine_grid(theta, [1, 1, *images.shape[-2:]], align_corners=False)
        return grid_sample(
            images[None], grid, mode="bicubic", padding_mode="zeros", align_corners=False
        )[0]

    def _matrix(self, like: Tensor) -> Tensor:
        """Matrix (2, 2) from true to apparent positions, right and up."""
        scale_x, scale_y, shear, degrees = (
            torch.as_tensor(value, dtype=like.dtype, device=like.device)
            for value in (self.scale_x, self.scale_y, self.shear, self.rotation_deg)
        )
        angle = degrees * (math.pi / 180)
        cosine, sine = torch.cos(angle), torch.sin(angle)
        turn = torch.stack([cosine, -sine, sine, cosine]).view(2, 2)
        stretch = torch.stack([scale_x, scale_x * shear, torch.zeros_like(shear), scale_y]).view(
            2, 2
        )
        return turn @ stretch
