"""Find a target without marks: a white rectangle against darker surroundings.

The frame is thresholded at many levels, because spot, shadow and daylight change the sheet's
brightness. Each connected bright region that is nearly a quadrilateral is a hypothesis. Straight
lines are then fitted to its four edges on the full-size image, with sub-pixel accuracy. All of each
edge must be brighter inside than outside, and the sides must fit the declared aspect ratio. Exactly
one rectangle must remain: a photograph with none or several is refused with the reason.

Lines of the sheet, such as its seams, do not count: beyond them the sheet is as bright as before.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import ImageRefusedError
from model.imaging.marks import Gray, Points, edge_line, intersection
from model.locating import smallest_turn
from model.plant import TargetPlane

_WORK_SIZE = 900  # longest side [px] of the searched image
_LEVEL_STEP = 2  # [counts]
_MIN_SHARE = 0.004  # of the frame: least area of a target
_MIN_FILL = 0.9  # of the union of region and quadrilateral: least common area
_MAX_REGIONS = 8  # of one level, the largest
_REACHES = (
    0.03,
    0.012,
    0.006,
    0.006,
)  # search range of an edge, relative to a side, in each iteration
_MIN_REACH = 6.0  # [px]
_ALIKE = 0.03  # largest distance of corners of one hypothesis, relative to its side
_SAME = 0.15  # ... and of corners of one rectangle, of which the clearest is taken
_BAND = (0.015, 0.05)  # strips along both sides of an edge, relative to a side
_MIN_STEP = 0.95  # the strip outside is darker than this share of the one inside ...
_MIN_EDGE = 0.6  # ... along this share of the edge
_ASPECT_TOLERANCE = 0.35  # of the natural logarithm; an oblique view shortens the width
_MAX_TAPER = 1.6  # ratio of opposite sides
_REMEDY = "declare marks or the target's camera, or give the four corners in pixels"


class _Judged(NamedTuple):
    """Corners (4, 2) [px] of a rectangle, and whether it can be the target.

    ``clearness`` is the relative step of brightness at its faintest edge, and ``aspect`` its width
    divided by its height.
    """

    corners: Points
    clearness: float
    aspect: float
    is_target: bool


def find_sheet(
    gray: NDArray[np.uint8], plane: TargetPlane, light: NDArray[np.float32] | None = None
) -> Points:
    """Find the corners of a target without marks in a camera frame, by its edges.

    Parameters
    ----------
    gray : uint8 (rows, columns)
        Counts, for the search.
    plane : TargetPlane
        Its aspect ratio distinguishes it from other rectangles in the frame.
    light : float32 (rows, columns), optional
        The same image in light, for the positions of edges, as in `find_corners`.

    Returns
    -------
    ndarray (4, 2) [px]
        x, y of the upper left, upper right, lower left and lower right corner; pixel centres are
        integers.

    Raises
    ------
    ImageRefusedError
        With reason ``target_not_found``: no rectangle is found, or several.
    """
    image = gray if light is None else light
    measured = [_measured(corners, image) for corners in _hypotheses(gray)]
    judged = [_judged(corners, image, plane) for corners in measured if corners is not None]
    found = _different([one for one in judged if one.is_target])
    if len(found) == 1:
        return found[0].corners
    raise ImageRefusedError("target_not_found", f"{plane.name}: {_problem(found, judged, plane)}")


def _problem(found: list[_Judged], judged: list[_Judged], plane: TargetPlane) -> str:
    """Why a photograph is refused, and the remedy."""
    if found:
        places = " and ".join("({:.0f}, {:.0f})".format(*one.corners.mean(axis=0)) for one in found)
        return f"{len(found)} white rectangles could be it, about the pixels {places}; {_REMEDY}"
    if judged:
        nearest = min(judged, key=lambda one: abs(np.log(one.aspect * plane.height / plane.width)))
        return (
            f"a white rectangle is {nearest.aspect:.2f} times as wide as high, and the target"
            f" {plane.width / plane.height:.2f} times; {_REMEDY}"
        )
    return (
        "no white rectangle with clear edges, all inside of the photograph and brighter than all"
        f" around it, was found; {_REMEDY}"
    )


# --- hypotheses
# --------------------------------------------------------------------------------------------------


def _hypotheses(gray: NDArray[np.uint8]) -> list[Points]:
    """Corners (4, 2) [px] of the bright regions of a frame that are nearly quadrilaterals."""
    scale = min(1.0, _WORK_SIZE / max(gray.shape))
    small = (
        cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if scale < 1
        else gray
    )
    smooth = cv2.medianBlur(np.asarray(small, dtype=np.uint8), 5)
    darkest, brightest = np.percentile(smooth, [2, 99])
    found: list[Points] = []
    for level in range(int(darkest), int(brightest), _LEVEL_STEP):
        for corners in _quadrilaterals((smooth > level).astype(np.uint8)):
            if not any(_is_alike(corners, other, _ALIKE) for other in found):
                found.append(corners)
    return [(corners + 0.5) / scale - 0.5 for corners in found]


def _quadrilaterals(mask: NDArray[np.uint8]) -> list[Points]:
    """Corners of the regions of a mask (rows, columns) that are nearly quadrilaterals."""
    width = max(3, round(0.012 * max(mask.shape)) | 1)
    kernel = np.ones((width, width), np.uint8)
    # Closing bridges seams and wires, opening removes rails.
    clean = cv2.morphologyEx(
        cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)), cv2.MORPH_OPEN, kernel
    )
    contours, _ = cv2.findContours(clean, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = [c for c in contours if cv2.contourArea(c) > _MIN_SHARE * mask.size]
    large.sort(key=cv2.contourArea, reverse=True)
    regions = [np.asarray(contour, dtype=np.int32) for contour in large[:_MAX_REGIONS]]
    made = [_quadrilateral(contour, mask.shape) for contour in regions]
    return [corners for corners in made if corners is not None]


def _quadrilateral(contour: NDArray[np.int32], shape: tuple[int, ...]) -> Points | None:
    """The corners of a contour (n, 1, 2) that is nearly a quadrilateral, else None."""
    hull = cv2.convexHull(contour)
    around = cv2.arcLength(hull, closed=True)
    for tolerance in np.arange(0.01, 0.1, 0.005):
        corners = cv2.approxPolyDP(hull, tolerance * around, closed=True)
        if len(corners) <= 4:
            break
    if len(corners) != 4:
        return None
    drawn = np.zeros((2, *shape), np.uint8)
    cv2.drawContours(drawn[0], [contour], -1, 1, cv2.FILLED)
    cv2.fillConvexPoly(drawn[1], corners, 1)
    if (drawn[0] & drawn[1]).sum() < _MIN_FILL * (drawn[0] | drawn[1]).sum():
        return None
    return _ordered(corners[:, 0].astype(np.float64))


def _ordered(corners: Points) -> Points:
    """Corners (4, 2) as upper left, upper right, lower left, lower right."""
    away = corners - corners.mean(axis=0)
    ring = corners[np.argsort(np.arctan2(away[:, 1], away[:, 0]))]
    start = int(np.argmin((ring - ring.mean(axis=0)).sum(axis=1)))
    upper_left, upper_right, lower_right, lower_left = np.roll(ring, -start, axis=0)
    return np.array([upper_left, upper_right, lower_left, lower_right])


def _is_alike(first: Points, second: Points, share: float) -> bool:
    apart = np.linalg.norm(first - second, axis=1).max()
    return bool(apart < share * min(_mean_side(first), _mean_side(second)))


def _different(judged: list[_Judged]) -> list[_Judged]:
    """Different rectangles, each the clearest of those that are about the same."""
    found: list[_Judged] = []
    for one in sorted(judged, key=lambda one: -one.clearness):
        if not any(_is_alike(one.corners, other.corners, _SAME) for other in found):
            found.append(one)
    return found


# --- judgement
# --------------------------------------------------------------------------------------------------

_SIDES = ((0, 1, 2), (1, 3, 0), (3, 2, 1), (2, 0, 3))
"""Each side's two corners, clockwise, and a corner on the other side of the rectangle."""


def _side_lengths(corners: Points) -> list[float]:
    """Lengths [px] of the upper, right, lower and left side."""
    return [float(np.linalg.norm(corners[b] - corners[a])) for a, b, _ in _SIDES]


def _mean_side(corners: Points) -> float:
    return sum(_side_lengths(corners)) / 4


def _judged(corners: Points, image: Gray, plane: TargetPlane) -> _Judged:
    """Whether a rectangle has the target's shape, as seen from a place before it."""
    top, right, bottom, left = _side_lengths(corners)
    aspect = (top + bottom) / (left + right)
    taper = max(top / bottom, bottom / top, left / right, right / left)
    apart = abs(np.log(aspect * plane.height / plane.width))
    clearness = 1 - max(float(np.median(_steps(corners, image, *side))) for side in _SIDES)
    return _Judged(
        corners, clearness, aspect, bool(apart <= _ASPECT_TOLERANCE and taper <= _MAX_TAPER)
    )


def _measured(corners: Points, image: Gray) -> Points | None:
    """A hypothesis's corners on the full-size image; None if it is no bright rectangle in it."""
    for share in _REACHES:
        reach = max(_MIN_REACH, share * _mean_side(corners))
        better = None if _leaves(corners, image) else _meeting_edges(corners, image, reach)
        if better is None or smallest_turn(better) <= 1.0:
            return None
        if np.linalg.norm(better - corners, axis=1).max() > 4 * reach:
            return None
        corners = better
    is_bright = all(
        (_steps(corners, image, *side) < _MIN_STEP).mean() >= _MIN_EDGE for side in _SIDES
    )
    return corners if is_bright and not _leaves(corners, image) else None


def _meeting_edges(corners: Points, image: Gray, reach: float) -> Points | None:
    """The corners where lines along the four edges meet; None if an edge is unclear."""
    lines = [
        edge_line(
            image,
            corners[a] + 0.05 * (corners[b] - corners[a]),
            0.9 * (corners[b] - corners[a]),
            corners[a] - corners[opposite],
            reach,
        )
        for a, b, opposite in _SIDES
    ]
    made = []
    for first, second in ((3, 0), (0, 1), (2, 3), (1, 2)):
        one, other = lines[first], lines[second]
        point = None if one is None or other is None else intersection(one, other)
        if point is None:
            return None
        made.append(point)
    return np.array(made)


def _leaves(corners: Points, image: Gray) -> bool:
    """Whether a rectangle is not inside of an image (rows, columns) with its surroundings."""
    margin = _BAND[0] * _mean_side(corners)
    last = np.array([image.shape[1], image.shape[0]]) - 1 - margin
    return bool(((corners < margin) | (corners > last)).any())


def _steps(corners: Points, image: Gray, a: int, b: int, opposite: int) -> Points:
    """Brightness outside divided by that inside, at places (n,) along one side."""
    start, run = corners[a], corners[b] - corners[a]
    across = np.array([-run[1], run[0]]) / np.linalg.norm(run)
    across *= np.sign(across @ (corners[a] - corners[opposite]))
    side = _mean_side(corners)
    along = start + np.linspace(0.04, 0.96, 120)[:, None] * run
    offsets = np.linspace(_BAND[0] * side, _BAND[1] * side, 9)

    def brightness(sign: float) -> Points:
        x, y = np.moveaxis(along[:, None] + sign * offsets[:, None] * across, -1, 0)
        strip = cv2.remap(
            image,
            x.astype(np.float32),
            y.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(np.median(strip.astype(np.float64), axis=1))

    return brightness(1.0) / np.maximum(brightness(-1.0), 1.0)
