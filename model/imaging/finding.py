"""Find a target in a camera frame, in the way that it declares (`model.locating`).

Each way is one function of `FINDERS`. All give the same: where the target is in the frame.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.imaging.edges import find_sheet
from model.imaging.rectify import BRACKETS, Layout, Pixel, ToPixels, find_corners, rectify
from model.locating import (
    BracketMarks,
    CameraCorners,
    CameraHomography,
    CameraPose,
    ImageSize,
    KnownCamera,
    SheetEdges,
    corners_by_camera,
)
from model.plant import TargetPlane

Points = NDArray[np.float64]


class Frame(NamedTuple):
    """A camera frame: counts uint8 and light float32, both (rows, columns)."""

    gray: NDArray[np.uint8]
    light: NDArray[np.float32]


class TargetImage(NamedTuple):
    """Where a target is in a frame.

    Attributes
    ----------
    corners : (4, 2) [px]
        Upper left, upper right, lower left, lower right; pixel centres are integers.
    to_pixels : callable or None
        Pixels (n, 2) of places (n, 2) in the target's sides, right and down from its upper left
        corner; None if straight lines are straight in the frame.
    """

    corners: Points
    to_pixels: ToPixels | None = None

    def rectified(self, image: NDArray[Pixel]) -> NDArray[Pixel]:
        """The target (256, 256), warped from an image of the frame."""
        return rectify(image, self.corners, to_pixels=self.to_pixels)


def _by_brackets(_: BracketMarks, frame: Frame, plane: TargetPlane) -> TargetImage:
    return TargetImage(find_corners(frame.gray, plane, (BRACKETS,), frame.light))


def _by_edges(_: SheetEdges, frame: Frame, plane: TargetPlane) -> TargetImage:
    return TargetImage(find_sheet(frame.gray, plane, frame.light))


def _by_camera(camera: KnownCamera, frame: Frame, plane: TargetPlane) -> TargetImage:
    rows, columns = frame.gray.shape
    size = ImageSize(columns, rows)
    corners = corners_by_camera(camera, plane, size)
    if camera.is_straight:
        return TargetImage(corners)

    def to_pixels(sides: Points) -> Points:
        places = (sides - 0.5) * np.array([plane.width, -plane.height])
        return camera.to_pixels(plane, places, size)

    return TargetImage(corners, to_pixels)


FINDERS: dict[type, Callable[..., TargetImage]] = {
    BracketMarks: _by_brackets,
    SheetEdges: _by_edges,
    CameraHomography: _by_camera,
    CameraCorners: _by_camera,
    CameraPose: _by_camera,
}
"""How each `model.locating.Locator` finds its target: of the locator, the frame and the target."""


def find_target(
    frame: Frame, plane: TargetPlane, layouts: Sequence[Layout] = (BRACKETS,)
) -> TargetImage:
    """Find a target in a frame, as it declares; by marks of ``layouts`` if it declares nothing.

    Raises
    ------
    ImageRefusedError
        With reason ``target_not_found`` and the remedy.
    InvalidInputError
        If a declared camera cannot see the target.
    """
    if plane.locator is None:
        return TargetImage(find_corners(frame.gray, plane, layouts, frame.light))
    return FINDERS[type(plane.locator)](plane.locator, frame, plane)
