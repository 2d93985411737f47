"""Rectify a camera frame: select the target's marks, and fit the homography through them.

The positions of a target's marks are a `Layout`. The default is a bracket at each corner. Plants
where marks serve several targets with a common edge have other layouts. Four marks give a
homography as a hypothesis. It must be plausible (convex, the right aspect ratio, arms along the
edges), and its score is from all marks of the layout that agree with it.

Notes
-----
::

    (u, v, 1) ~ H (x, y, 1)     pixel and plane; H (3, 3) by least squares over agreeing marks
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import ImageRefusedError, InvalidInputError
from model.imaging.marks import Kind, Mark, Points, find_marks, intersection
from model.locating import UNIT_CORNERS, project, smallest_turn
from model.plant import TargetPlane

CROP_SIZE = 256

Pixel = TypeVar("Pixel", np.uint8, np.float32)

_CANDIDATES = 4  # marks of one kind and orientation that are tried for one position
_ASPECT_TOLERANCE = 0.35  # of the natural logarithm; an oblique view shortens the width
_ARM_TOLERANCE_DEG = 14.0
_MIN_ARM_RATIO, _MAX_ARM_RATIO = 0.03, 0.35  # arm to the target's side
_AGREEMENT = 0.35  # largest distance of a mark from its predicted position, relative to an arm


@dataclass(frozen=True)
class MarkPlace:
    """Position of a mark on the plane.

    ``kind`` and ``quarter`` (quarter turns) are as in `Mark`; ``x`` (right) and ``y`` (down) are in
    target sides.
    """

    kind: Kind
    quarter: int
    x: float
    y: float


Layout = tuple[MarkPlace, ...]
"""The marks of a target.

The first four are those of its corners: upper left, upper right, lower left, lower right.
"""

BRACKETS: Layout = (
    MarkPlace("L", 0, 0, 0),
    MarkPlace("L", 1, 1, 0),
    MarkPlace("L", 3, 0, 1),
    MarkPlace("L", 2, 1, 1),
)
"""A separate target: an L bracket at each corner."""

ToPixels = Callable[[Points], Points]
"""Pixels (n, 2) of places (n, 2) in a target's sides, right and down from its upper left corner."""


def find_corners(
    gray: NDArray[np.uint8],
    plane: TargetPlane,
    layouts: Sequence[Layout] = (BRACKETS,),
    light: NDArray[np.float32] | None = None,
) -> Points:
    """Find the target's corners in a camera frame, by its marks.

    Parameters
    ----------
    gray : uint8 (rows, columns)
        Counts, for the detection of marks.
    plane : TargetPlane
        Its aspect ratio distinguishes it from other targets in the frame.
    layouts : sequence of Layout
        Layouts to try, in order.
    light : float32 (rows, columns), optional
        The same image in light, for the positions of edges. A lens blurs light, and a response
        curve moves the middle of a blurred edge.

    Returns
    -------
    ndarray (4, 2) [px]
        x, y of the upper left, upper right, lower left and lower right corner; pixel centres are
        integers.

    Raises
    ------
    ImageRefusedError
        With reason ``target_not_found``.
    """
    marks = find_marks(gray, light)
    for layout in layouts:
        corners = _fit_layout(marks, layout, plane)
        if corners is not None:
            return corners
    raise ImageRefusedError(
        "target_not_found",
        f"the corner marks of {plane.name} were not found; give the four corners in pixels",
    )


def check_corners(corners: ArrayLike) -> Points:
    """Validate configured corners and return them as a (4, 2) array [px].

    Raises
    ------
    InvalidInputError
        If they are not four finite points of a convex quadrilateral in the order upper left, upper
        right, lower left, lower right.
    """
    points = np.asarray(corners, dtype=np.float64)
    if points.shape != (4, 2) or not np.isfinite(points).all() or smallest_turn(points) <= 1.0:
        raise InvalidInputError(
            "corners must be four points (x, y) in pixels: upper left, upper right, lower left,"
            " lower right"
        )
    return points


def rectify(
    image: NDArray[Pixel], corners: Points, size: int = CROP_SIZE, to_pixels: ToPixels | None = None
) -> NDArray[Pixel]:
    """Warp an image to the rectified target.

    Parameters
    ----------
    image : uint8 or float32 (rows, columns) or (rows, columns, 3)
    corners : (4, 2) [px]
        See `find_corners`.
    size : int
        Pixels per side of the result, whose outer edges are the target's.
    to_pixels : callable, optional
        Where places of the target are, if a lens bends its lines; else by the corners.

    Returns
    -------
    ndarray (size, size) or (size, size, 3)
        Each pixel is the mean over its area, computed by fine sampling and averaging.
    """
    longest = max(
        np.linalg.norm(corners[a] - corners[b]) for a, b in ((0, 1), (2, 3), (0, 2), (1, 3))
    )
    factor = int(np.clip(np.ceil(longest / size), 1, 8))
    fine = size * factor
    if to_pixels is None:
        edge = fine * UNIT_CORNERS - 0.5
        transform = cv2.getPerspectiveTransform(corners.astype(np.float32), edge.astype(np.float32))
        warped = cv2.warpPerspective(image, transform, (fine, fine), flags=cv2.INTER_LINEAR)
    else:
        middles = (np.arange(fine) + 0.5) / fine
        places = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
        x, y = to_pixels(places).astype(np.float32).T.reshape(2, fine, fine)
        warped = cv2.remap(image, x, y, cv2.INTER_LINEAR)
    return np.asarray(
        cv2.resize(warped, (size, size), interpolation=cv2.INTER_AREA), dtype=image.dtype
    )


def _fit_layout(marks: list[Mark], layout: Layout, plane: TargetPlane) -> Points | None:
    """The corners by the set of marks with the best agreement, or None."""
    candidates = [
        [mark for mark in marks if (mark.kind, mark.quarter) == (place.kind, place.quarter)][
            :_CANDIDATES
        ]
        for place in layout
    ]
    own = _best_of(((0, 1, 2, 3),), layout, candidates, plane)
    if own is not None:
        return own
    # A corner's mark is hidden. Use other marks of the layout, or else its neighbours' arms.
    others = tuple(
        places for places in combinations(range(len(layout)), 4) if places != (0, 1, 2, 3)
    )
    fitted = _best_of(others, layout, candidates, plane)
    return fitted if fitted is not None else _best_completed(layout, candidates, plane)


class _ScoredCorners(NamedTuple):
    """Corners (4, 2) [px], and the sum of the scores of consistent marks."""

    score: float
    corners: Points


def _best_of(
    sets: tuple[tuple[int, ...], ...],
    layout: Layout,
    candidates: list[list[Mark]],
    plane: TargetPlane,
) -> Points | None:
    """The corners by the four marks with the best agreement, from the given sets of positions."""
    best: _ScoredCorners | None = None
    for places in sets:
        source = np.array([[layout[i].x, layout[i].y] for i in places], dtype=np.float64)
        if _spread(source) < 0.2:
            continue
        for chosen in product(*(candidates[i] for i in places)):
            fitted = _fit_four(source, list(chosen), layout, candidates, plane)
            if fitted is not None and (best is None or fitted.score > best.score):
                best = fitted
    return None if best is None else best.corners


def _best_completed(
    layout: Layout, candidates: list[list[Mark]], plane: TargetPlane
) -> Points | None:
    """The corners by the three corner marks with the best agreement.

    The fourth corner is the intersection of its neighbours' arms.
    """
    best: _ScoredCorners | None = None
    for hidden in range(4):
        opposite = 3 - hidden
        first, second = (i for i in range(4) if i not in (hidden, opposite))
        for across, a, b in product(candidates[opposite], candidates[first], candidates[second]):
            guess = _meeting(across, a, b)
            if guess is None:
                continue
            chosen = {hidden: guess, opposite: across, first: a, second: b}
            fitted = _fit_four(
                UNIT_CORNERS, [chosen[i] for i in range(4)], layout, candidates, plane
            )
            if fitted is not None and (best is None or fitted.score > best.score):
                best = fitted
    return None if best is None else best.corners


def _meeting(opposite: Mark, first: Mark, second: Mark) -> Mark | None:
    """The corner where two marks' arms intersect, except the arms towards ``opposite``."""
    arms = []
    for mark in (first, second):
        toward = [
            float(arm @ (opposite.point - mark.point)) / float(np.linalg.norm(arm))
            for arm in mark.arms
        ]
        arms.append(mark.arms[int(np.argmin(toward))])
    point = intersection((first.point, arms[0]), (second.point, arms[1]))
    return (
        None if point is None else Mark("L", (opposite.quarter + 2) % 4, point, -opposite.arms, 0.0)
    )


def _spread(points: Points) -> float:
    """Twice the smallest triangle area among four points; zero if three are collinear."""
    return min(abs(_cross(b - a, c - a)) for a, b, c in combinations(points, 3))


def _fit_four(
    source: Points,
    chosen: list[Mark],
    layout: Layout,
    candidates: list[list[Mark]],
    plane: TargetPlane,
) -> _ScoredCorners | None:
    """Fit a homography through four marks; None if it is implausible."""
    sizes = np.array([mark.size for mark in chosen])
    if sizes.max() > 1.8 * sizes.min():
        return None
    points = np.array([mark.point for mark in chosen])
    transform = np.asarray(
        cv2.getPerspectiveTransform(source.astype(np.float32), points.astype(np.float32)),
        dtype=np.float64,
    )
    corners = project(transform, UNIT_CORNERS)
    if not _plausible(corners, sizes, plane) or not all(
        _arms_agree(transform, mark, place) for mark, place in zip(chosen, source, strict=True)
    ):
        return None
    agreeing = _agreeing(transform, layout, candidates, float(sizes.mean()))
    score = sum(mark.score for mark in agreeing.values())
    return _ScoredCorners(score, _settled(corners, agreeing, layout))


def _agreeing(
    transform: Points, layout: Layout, candidates: list[list[Mark]], size: float
) -> dict[int, Mark]:
    """The best mark near each position that the homography predicts, by index in the layout."""
    found = {}
    for index, (place, marks) in enumerate(zip(layout, candidates, strict=True)):
        expected = project(transform, np.array([[place.x, place.y]]))[0]
        near = [mark for mark in marks if np.linalg.norm(mark.point - expected) < _AGREEMENT * size]
        if near:
            found[index] = max(near, key=lambda mark: mark.score)
    return found


def _settled(corners: Points, agreeing: dict[int, Mark], layout: Layout) -> Points:
    """The corners: measured if their mark is visible, else by the homography through all marks."""
    if len(agreeing) > 4:
        source = np.array([[layout[i].x, layout[i].y] for i in agreeing], dtype=np.float64)
        points = np.array([mark.point for mark in agreeing.values()])
        transform, _ = cv2.findHomography(source, points)
        corners = project(np.asarray(transform, dtype=np.float64), UNIT_CORNERS)
    return np.array([agreeing[i].point if i in agreeing else corners[i] for i in range(4)])


def _cross(a: Points, b: Points) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _plausible(corners: Points, sizes: Points, plane: TargetPlane) -> bool:
    """Check if a quadrilateral can be the photograph of this target with these marks."""
    top, bottom, left, right = (
        float(np.linalg.norm(corners[b] - corners[a])) for a, b in ((0, 1), (2, 3), (0, 2), (1, 3))
    )
    if (
        smallest_turn(corners) <= 0
        or max(top / bottom, bottom / top, left / right, right / left) > 1.6
    ):
        return False
    aspect = np.log((top + bottom) / (left + right)) - np.log(plane.width / plane.height)
    arm = sizes.mean() / ((top + bottom + left + right) / 4)
    return bool(abs(aspect) < _ASPECT_TOLERANCE and _MIN_ARM_RATIO < arm < _MAX_ARM_RATIO)


def _arms_agree(transform: Points, mark: Mark, place: Points) -> bool:
    """Check if a mark's arms point along the target's edges according to the homography."""
    quarter = mark.quarter * np.pi / 2
    along = (
        np.array([np.cos(quarter), np.sin(quarter)]),
        np.array([-np.sin(quarter), np.cos(quarter)]),
    )
    base = project(transform, place[None])[0]
    for arm, direction in zip(mark.arms, along, strict=True):
        edge = project(transform, (place + 0.1 * direction)[None])[0] - base
        angle = np.degrees(np.arctan2(_cross(arm, edge), float(arm @ edge)))
        if abs(angle) > _ARM_TOLERANCE_DEG:
            return False
    return True
