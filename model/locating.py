"""How a target is located in a photograph: by marks, by its edges, or by a known camera.

Each target declares one way (`TargetPlane.locator`). `model.imaging.finding` has the function of
each way. A known camera is a homography, the four corners in pixels, or a pose with a focal length.

Positions in an image are pixels (x, y), columns and rows from its upper left pixel, whose centre is
(0, 0). Positions on a target are metres right and up of its centre, as a viewer sees it.

Notes
-----
A camera at C looks along f, with r to the right and d downwards in its image. A point P is at::

    (a, b) = (r.(P - C), d.(P - C)) / f.(P - C)         (x, y) = principal point + F lens(a, b)
    lens(a, b) = (1 + k1 s + k2 s^2 + k3 s^3) (a, b)
                 + (2 p1 a b + p2 (s + 2 a^2), p1 (s + 2 b^2) + 2 p2 a b),  s = a^2 + b^2

Source: D. C. Brown, *Close-range camera calibration*, Photogrammetric Engineering 37 (1971); the
order k1, k2, p1, p2, k3 is that of OpenCV.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import ImageRefusedError, InvalidInputError

Array = NDArray[np.float64]

UNIT_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
"""Corners of a target in its sides, right and down: upper left, upper right, lower left, lower
right.
"""


class ImageSize(NamedTuple):
    """Columns and rows of a photograph [px]."""

    columns: int
    rows: int

    def __str__(self) -> str:
        return f"{self.columns} x {self.rows}"


class Rectangle(Protocol):
    """What is needed of a target (`model.plant.TargetPlane`)."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def center(self) -> Array:
        """Its centre (3,) [m] in ENU."""

    @property
    def normal(self) -> Array:
        """Unit normal (3,) of the lit side."""

    @property
    def width(self) -> float:
        """Its width [m]."""

    @property
    def height(self) -> float:
        """Its height [m]."""

    def to_enu(self, coordinates: ArrayLike) -> Array:
        """ENU points (..., 3) [m] of coordinates (..., 2) [m] right and up of the centre."""


# Least cosine of the angle between a target's normal and the way to its camera.
_LEAST_FACING = 0.02


@dataclass(frozen=True)
class BracketMarks:
    """A dark L bracket at each corner."""


@dataclass(frozen=True)
class SheetEdges:
    """No marks: the target is a white rectangle against darker surroundings."""


def _array(name: str, value: ArrayLike, *shape: int) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        numbers = " x ".join(map(str, shape))
        raise InvalidInputError(f"{name}: must be {numbers} finite numbers")
    array.flags.writeable = False
    return array


def project(homography: Array, points: Array) -> Array:
    """Points (n, 2) after a homography (3, 3)."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:], dtype=np.float64)


def homography_through(source: Array, goal: Array) -> Array:
    """The homography (3, 3) that leads four points (4, 2) to four others."""
    rows = []
    for (x, y), (u, v) in zip(source, goal, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    solved = np.linalg.solve(np.array(rows), goal.ravel())
    return np.asarray(np.append(solved, 1.0).reshape(3, 3))


def smallest_turn(corners: Array) -> float:
    """Smallest cross product of successive edges; positive for a convex quadrilateral.

    The order of the corners (4, 2) is that of `UNIT_CORNERS`; y is downwards.
    """
    ring = corners[[0, 1, 3, 2]]
    edges = np.roll(ring, -1, axis=0) - ring
    after = np.roll(edges, -1, axis=0)
    return float((edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]).min())


@dataclass(frozen=True, eq=False)
class CameraHomography:
    """A camera by the homography from its pixels to the target.

    Attributes
    ----------
    homography : (3, 3)
        From pixels (x, y, 1) to metres right and up of the target's centre.
    image_size : ImageSize or None
    """

    homography: Array
    image_size: ImageSize | None = None
    is_straight: bool = True

    def __post_init__(self) -> None:
        matrix = _array("homography", self.homography, 3, 3)
        if abs(np.linalg.det(matrix / np.abs(matrix).max(initial=1e-300))) < 1e-15:
            raise InvalidInputError("homography: must be invertible")
        object.__setattr__(self, "homography", matrix)

    def to_pixels(self, plane: Rectangle, places: ArrayLike, size: ImageSize) -> Array:
        """Pixels (n, 2) of places (n, 2) [m] of a target, in photographs of ``size``."""
        inverse = np.asarray(np.linalg.inv(self.homography), dtype=np.float64)
        return project(inverse, np.asarray(places, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class CameraCorners:
    """A camera by the target's four corners in its photographs.

    Attributes
    ----------
    corners_px : (4, 2) [px]
        In the order of `UNIT_CORNERS`.
    image_size : ImageSize or None
    """

    corners_px: Array
    image_size: ImageSize | None = None
    is_straight: bool = True

    def __post_init__(self) -> None:
        corners = _array("corners_px", self.corners_px, 4, 2)
        if smallest_turn(corners) <= 1.0:
            raise InvalidInputError(
                "corners_px: must be a convex quadrilateral in the order upper left, upper right,"
                " lower left, lower right"
            )
        object.__setattr__(self, "corners_px", corners)

    def to_pixels(self, plane: Rectangle, places: ArrayLike, size: ImageSize) -> Array:
        """Pixels (n, 2) of places (n, 2) [m] of a target, in photographs of ``size``."""
        right, up = np.asarray(places, dtype=np.float64).T
        sides = np.stack([right / plane.width + 0.5, 0.5 - up / plane.height], axis=-1)
        return project(homography_through(UNIT_CORNERS, self.corners_px), sides)


@dataclass(frozen=True, eq=False)
class CameraPose:
    """A camera by its position, direction and lens.

    Attributes
    ----------
    position : (3,) [m]
        In ENU.
    rotation : (3, 3)
        From ENU to the image's right, the image's down, and forward.
    focal_length_px : float or None [px]
    field_of_view_deg : float or None [deg]
        From the left to the right edge of a photograph; one of both is given.
    principal_point_px : (2,) or None [px]
        None for the photograph's middle.
    distortion : (5,)
        k1, k2, p1, p2, k3 of the lens.
    image_size : ImageSize or None
    look_at : (3,) or None [m]
        The point that the rotation was made of.
    """

    position: Array
    rotation: Array
    focal_length_px: float | None = None
    field_of_view_deg: float | None = None
    principal_point_px: tuple[float, float] | None = None
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    image_size: ImageSize | None = None
    look_at: Array | None = None

    def __post_init__(self) -> None:
        rotation = _array("rotation", self.rotation, 3, 3)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            raise InvalidInputError("rotation: its rows must be orthogonal unit vectors")
        if np.linalg.det(rotation) < 0:
            raise InvalidInputError(
                "rotation: must not mirror the image; its rows are right, down and forward"
            )
        if (self.focal_length_px is None) == (self.field_of_view_deg is None):
            raise InvalidInputError("give one of focal_length_px, field_of_view_deg")
        object.__setattr__(self, "position", _array("position_m", self.position, 3))
        object.__setattr__(self, "rotation", rotation)

    @classmethod
    def looking_at(cls, position: ArrayLike, look_at: ArrayLike, **lens: Any) -> "CameraPose":
        """An upright camera at ``position`` (3,) [m] that looks at a point (3,) [m]."""
        eye, goal = _array("position_m", position, 3), _array("look_at_m", look_at, 3)
        forward = goal - eye
        right = np.cross(forward, [0.0, 0.0, 1.0])
        if np.linalg.norm(right) < 1e-6 * max(float(np.linalg.norm(forward)), 1e-9):
            raise InvalidInputError(
                "look_at_m: is straight above or below the camera, or at its place; give its"
                " rotation instead"
            )
        forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        return cls(eye, rotation, look_at=goal, **lens)

    @property
    def is_straight(self) -> bool:
        """Whether the lens shows straight lines as straight lines."""
        return not any(self.distortion)

    def to_pixels(self, plane: Rectangle, places: ArrayLike, size: ImageSize) -> Array:
        """Pixels (n, 2) of places (n, 2) [m] of a target, in photographs of ``size``.

        Raises
        ------
        InvalidInputError
            If the target is not wholly in front of the camera, or its lit side faces away.
        """
        way = self.position - plane.center
        if way @ plane.normal < _LEAST_FACING * np.linalg.norm(way):
            raise InvalidInputError(
                "position_m: the camera is behind the target, or in its plane; it must see the lit"
                " side"
            )
        seen = (plane.to_enu(places) - self.position) @ self.rotation.T
        if (seen[:, 2] <= 0).any():
            raise InvalidInputError(
                "rotation: the target is behind the camera; look_at_m or the rows of rotation"
                " (right, down, forward) must lead towards it"
            )
        middle = self.principal_point_px or ((size[0] - 1) / 2, (size[1] - 1) / 2)
        return np.asarray(
            middle + self._focal_length(size) * self._through_lens(seen[:, :2] / seen[:, 2:])
        )

    def _focal_length(self, size: ImageSize) -> float:
        if self.focal_length_px is not None:
            return self.focal_length_px
        return size[0] / 2 / float(np.tan(np.radians(self.field_of_view_deg or 0.0) / 2))

    def _through_lens(self, straight: Array) -> Array:
        """Positions (n, 2) in the image of directions (n, 2), in focal lengths."""
        k1, k2, p1, p2, k3 = self.distortion
        a, b = straight.T
        s = a**2 + b**2
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        return np.stack(
            [
                radial * a + 2 * p1 * a * b + p2 * (s + 2 * a**2),
                radial * b + p1 * (s + 2 * b**2) + 2 * p2 * a * b,
            ],
            axis=-1,
        )


KnownCamera = CameraHomography | CameraCorners | CameraPose
"""A camera that shows a target at known pixels.

``image_size`` are columns and rows of its photographs, None for any. ``is_straight`` is whether it
shows straight lines as straight lines.
"""

Locator = BracketMarks | SheetEdges | KnownCamera
"""A way to locate a target in a photograph."""


def corner_places(plane: Rectangle) -> Array:
    """The corners (4, 2) [m] right and up of a target's centre, in the order of `UNIT_CORNERS`."""
    return np.asarray((UNIT_CORNERS - 0.5) * np.array([plane.width, -plane.height]))


def corners_by_camera(
    camera: KnownCamera, plane: Rectangle, size: ImageSize | None = None
) -> Array:
    """The target's corners (4, 2) [px] in a known camera's photograph of ``size``.

    Without a size it is the camera's, and any if that is not known, for a check of a declaration.

    Raises
    ------
    InvalidInputError
        If the camera cannot see the target as declared.
    ImageRefusedError
        With reason ``target_not_found``, if the photograph has another size, or not all of the
        target.
    """
    if size is not None and camera.image_size is not None and size != camera.image_size:
        raise ImageRefusedError(
            "target_not_found",
            f"the camera of {plane.name} is declared for photographs of {camera.image_size}"
            f" pixels, and this one has {size}; correct the target's camera",
        )
    frame = size or camera.image_size or ImageSize(1000, 1000)
    with np.errstate(all="ignore"):  # what is not finite is refused below
        corners = camera.to_pixels(plane, corner_places(plane), frame)
    if not np.isfinite(corners).all() or smallest_turn(corners) <= 1.0:
        raise InvalidInputError(
            f"camera: shows {plane.name} mirrored, or of no area; pixels are (column, row) with row"
            " 0 at the top, and metres are right and up of the target's centre"
        )
    known = size or camera.image_size
    if known is not None and ((corners < -0.5) | (corners > np.array(known) - 0.5)).any():
        outside = corners[np.argmax(np.abs(corners - np.array(known) / 2).max(axis=-1))]
        raise ImageRefusedError(
            "target_not_found",
            f"the declared camera has a corner of {plane.name} at ({outside[0]:.0f},"
            f" {outside[1]:.0f}), outside of a photograph of {known} pixels; correct the"
            " target's camera",
        )
    return corners


# --- JSON
# --------------------------------------------------------------------------------------------------


def locator_to_json(locator: Locator) -> dict[str, object]:
    """A locator as ``plant.yaml``, the store and exports have it; `locator_from_json` reads it."""
    if isinstance(locator, BracketMarks):
        return {"marks": "l_brackets"}
    if isinstance(locator, SheetEdges):
        return {"marks": "none"}
    size = {} if locator.image_size is None else {"image_size_px": list(locator.image_size)}
    return {"marks": "none", "camera": _camera_to_json(locator) | size}


def _camera_to_json(camera: KnownCamera) -> dict[str, object]:
    if isinstance(camera, CameraHomography):
        return {"homography": camera.homography.tolist()}
    if isinstance(camera, CameraCorners):
        return {"corners_px": camera.corners_px.tolist()}
    pose: dict[str, object] = {"position_m": camera.position.tolist()}
    if camera.look_at is not None:
        pose["look_at_m"] = camera.look_at.tolist()
    else:
        pose["rotation"] = camera.rotation.tolist()
    for name in ("focal_length_px", "field_of_view_deg"):
        if getattr(camera, name) is not None:
            pose[name] = getattr(camera, name)
    if camera.principal_point_px is not None:
        pose["principal_point_px"] = list(camera.principal_point_px)
    if any(camera.distortion):
        pose["distortion"] = list(camera.distortion)
    return {"pose": pose}


def locator_from_json(data: Mapping[str, Any]) -> Locator:
    """The locator of ``{"marks": .., "camera": ..}``, whose keys and types are checked already.

    Raises
    ------
    InvalidInputError
        If its values contradict each other; it begins with the key.
    """
    camera = data.get("camera")
    if data.get("marks") == "l_brackets":
        if camera is not None:
            raise InvalidInputError(
                "camera: marks are l_brackets, which locate the target; leave one of both out"
            )
        return BracketMarks()
    if camera is None:
        return SheetEdges()
    size = camera.get("image_size_px")
    image_size = None if size is None else ImageSize(int(size[0]), int(size[1]))
    if camera.get("homography") is not None:
        return CameraHomography(camera["homography"], image_size)
    if camera.get("corners_px") is not None:
        return CameraCorners(camera["corners_px"], image_size)
    return _pose_from_json(camera["pose"], image_size)


def _pose_from_json(pose: Mapping[str, Any], image_size: ImageSize | None) -> CameraPose:
    point, bent = pose.get("principal_point_px"), pose.get("distortion") or ()
    lens: dict[str, Any] = {
        "focal_length_px": pose.get("focal_length_px"),
        "field_of_view_deg": pose.get("field_of_view_deg"),
        "principal_point_px": None if point is None else (float(point[0]), float(point[1])),
        "distortion": tuple(map(float, bent)) + (0.0,) * (5 - len(bent)),
        "image_size": image_size,
    }
    if pose.get("rotation") is None:
        return CameraPose.looking_at(pose["position_m"], pose["look_at_m"], **lens)
    return CameraPose(pose["position_m"], pose["rotation"], **lens)
