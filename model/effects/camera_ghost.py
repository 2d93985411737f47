"""Camera ghost: a second, faint and displaced image of the spot.

What it is
    Two surfaces of the camera's optics, or of the window of its housing, reflect a share of the
    light twice. A tilted protective pane does the same. The image shows the spot and a copy at a
    constant displacement::

        image = (1 - share) * true(x, y) + share * true(x - right_m, y - up_m)

Source
    Ghosts of lenses and windows: Fest, *Stray Light Analysis and Control* (SPIE 2013), chapter on
    ghost reflections. The effect is in the catalogue because the images of undeclared set 4 need it
    (RESULTS.md).

In an image
    One side of the spot has a second edge or a shoulder, and its core is too faint compared with
    its wings. The residual shows the spot twice: with one sign at its position, slightly moved by
    the common centroid, and with the other sign at the copy's position.

What it scales with
    Nothing of the heliostat or the sun: the displacement is the same in metres on a target for all
    images of a camera.

What it is confused with
    - Canting of one facet: also moves a quarter of the light aside, but the distance grows with the
      slant range, the direction turns with the mount, and each heliostat differs.
    - A foreign heliostat's spot: comes and goes, and has another shape.
    - Camera blur: spreads light in all directions.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from model.effects.base import Effect, Factor, Scalar, Stage, parameter
from model.tracing.scene import Window


@dataclass(frozen=True, eq=False)
class CameraGhost(Effect):
    """A ``share`` of the light is displaced by ``right_m`` and ``up_m`` [m on the target]."""

    name: ClassVar[str] = "camera_ghost"
    about: ClassVar[str] = "Camera ghost: a second, faint and displaced image of the spot."
    stage: ClassVar[Stage] = "image"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"camera"})
    guesses: ClassVar[tuple[dict[str, float], ...]] = tuple(
        {"share": 0.05, "right_m": size * right, "up_m": size * up}
        for size in (0.4, 0.9)
        for right in (-1, 0, 1)
        for up in (-1, 0, 1)
        if right or up
    )

    share: Scalar = parameter(0.0, 0.0, 0.5, "1", "camera")
    right_m: Scalar = parameter(0.0, -2.0, 2.0, "m", "camera")
    up_m: Scalar = parameter(0.0, -2.0, 2.0, "m", "camera")

    def on_image(self, images: Tensor, window: Window) -> Tensor:
        """Add the displaced copy; its parts beyond the image are lost."""
        right, up, share = (
            torch.as_tensor(v, dtype=images.dtype, device=images.device)
            for v in (self.right_m, self.up_m, self.share)
        )
        # The grid gives the source position of each pixel, in half sizes; its rows count downwards.
        back = torch.stack([-2 * right / window.width, 2 * up / window.height])
        theta = torch.cat(
            [torch.eye(2, dtype=images.dtype, device=images.device), back[:, None]], dim=1
        )[None]
        grid = affine_grid(theta, [1, 1, *images.shape[-2:]], align_corners=False)
        double = grid_sample(
            images[None], grid, mode="bicubic", padding_mode="zeros", align_corners=False
        )[0]
        return (1 - share) * images + share * double
