"""Find the marks on a target: dark L brackets at its corners, and dark T bars.

T bars mark the edge between two targets. A mark is a compact dark shape on a bright sheet. Relative
darkness (black-hat over the local brightness) is thresholded at several levels, because a spot or
glare near a mark lowers its contrast. Each connected shape is compared with ideal marks of
different strokes and tilts, and the best match gives its kind. The reference point is then measured
on the full-size image: straight lines are fitted to the mark's edges with sub-pixel accuracy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Kind = Literal["L", "T"]
Points = NDArray[np.float64]
Gray = NDArray[np.uint8] | NDArray[np.float32]
Line = tuple[Points, Points]  # a point and a unit direction

_WORK_SIZE = 1500  # longest side [px] of the searched image
_LEVELS = (0.1, 0.16, 0.25, 0.35, 0.5)  # relative darkness
_MIN_SIDE, _MAX_SIDE = 12, 220  # of a mark, in the searched image [px]
_CELLS = 32
_MIN_MATCH = 0.62
_REACHES = (0.14, 0.08, 0.05)  # search range of an edge, relative to the arm, in each iteration
_STROKES = (0.14, 0.2, 0.27, 0.34)
_TILTS_DEG = tuple(range(-24, 25, 6))


@dataclass(frozen=True, eq=False)
class Mark:
    """A mark in an image.

    Attributes
    ----------
    kind : "L" or "T"
    quarter : int
        Clockwise quarter turns from the base orientation: an L that opens to the lower right (an
        upper left corner), or a T with its bar on top.
    point : (2,) [px]
        Reference point (x, y): the outer corner of an L, or the middle of the outer edge of a T's
        bar.
    arms : (2, 2) [px]
        Vectors from the reference point: along an L's two arms, or along half of a T's bar and
        along its stem.
    score : float
        Overlap with the ideal mark, 0 to 1.
    """

    kind: Kind
    quarter: int
    point: Points
    arms: Points
    score: float

    @property
    def size(self) -> float:
        """Length of the longer arm [px]."""
        return float(np.linalg.norm(self.arms, axis=1).max())


def _outline(kind: Kind, stroke: float) -> Points:
    """The ideal mark in its base orientation, with the reference point at the origin, y down."""
    if kind == "L":
        return np.array(
            [[0, 0], [1, 0], [1, stroke], [stroke, stroke], [stroke, 1], [0, 1]], dtype=np.float64
        )
    half = stroke / 2
    return np.array(
        [
            [-0.5, 0],
            [0.5, 0],
            [0.5, stroke],
            [half, stroke],
            [half, 1],
            [-half, 1],
            [-half, stroke],
            [-0.5, stroke],
        ]
    )


def _turn(points: Points, degrees: float) -> Points:
    angle = np.radians(degrees)
    return np.asarray(
        points @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    )


@dataclass(frozen=True, eq=False)
class _Template:
    kind: Kind
    quarter: int
    point: Points  # in units of the bounding box
    arms: Points
    cells: NDArray[np.float32]


@cache
def _templates() -> Sequence[_Template]:
    """Ideal marks of all kinds, orientations, strokes and small tilts, in their bounding boxes."""
    kinds: tuple[Kind, ...] = ("L", "T")
    return tuple(_template(*choice) for choice in product(kinds, range(4), _STROKES, _TILTS_DEG))


def _template(kind: Kind, quarter: int, stroke: float, tilt_deg: float) -> _Template:
    ends = np.array(
        [[0, 0], [1, 0], [0, 1]] if kind == "L" else [[0, 0], [0.5, 0], [0, 1]], dtype=np.float64
    )
    outline = _turn(_outline(kind, stroke), 90 * quarter + tilt_deg)
    ends = _turn(ends, 90 * quarter + tilt_deg)
    low, span = outline.min(axis=0), np.ptp(outline, axis=0)
    cells = np.zeros((4 * _CELLS, 4 * _CELLS), dtype=np.uint8)
    cv2.fillPoly(cells, [np.round((outline - low) / span * 4 * _CELLS - 0.5).astype(np.int32)], 1)
    shrunk = cv2.resize(cells.astype(np.float32), (_CELLS, _CELLS), interpolation=cv2.INTER_AREA)
    point = (ends[0] - low) / span
    return _Template(kind, quarter, point, (ends[1:] - ends[0]) / span, shrunk.astype(np.float32))


class _TemplateMatrix(NamedTuple):
    """Cells of the templates (T, n), and their sums (T,)."""

    cells: NDArray[np.float32]
    areas: NDArray[np.float32]


@cache
def _template_matrix() -> _TemplateMatrix:
    cells = np.stack([template.cells.ravel() for template in _templates()])
    return _TemplateMatrix(cells, cells.sum(axis=1))


def find_marks(gray: NDArray[np.uint8], light: Gray | None = None) -> list[Mark]:
    """Find all marks of a gray image (rows, columns), the best first.

    Their reference points have sub-pixel accuracy. They are measured in ``light`` (rows, columns),
    if it is given.
    """
    scale = min(1.0, _WORK_SIZE / max(gray.shape))
    small = (
        cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if scale < 1
        else gray
    )
    found: list[Mark] = []
    for darkness in _darkness(np.asarray(small, dtype=np.uint8)):
        for level in _LEVELS:
            found += _marks_of_mask((darkness > level).astype(np.uint8))
    kept: list[Mark] = []
    for mark in sorted(found, key=lambda mark: -mark.score):
        if all(np.linalg.norm(mark.point - other.point) > 0.5 * other.size for other in kept):
            kept.append(mark)
    return [_refined(gray if light is None else light, _scaled(mark, 1 / scale)) for mark in kept]


def _darkness(gray: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
    """Relative darkness compared with the surroundings, for narrow and for wide strokes."""
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.0)
    maps = []
    for width in (17, 41):
        closed = cv2.morphologyEx(
            smooth, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_RECT, (width, width))
        )
        relative = (closed.astype(np.float32) - smooth) / np.maximum(closed, 20)
        maps.append(np.asarray(relative, dtype=np.float32))
    return maps


def _marks_of_mask(mask: NDArray[np.uint8]) -> list[Mark]:
    """The connected shapes of a mask that look like marks."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    marks = []
    for label in range(1, len(stats)):
        left, top, width, height, area = (int(value) for value in stats[label])
        sides = sorted((width, height))
        fill = area / (width * height)
        if (
            sides[0] >= _MIN_SIDE
            and sides[1] <= min(_MAX_SIDE, 2.5 * sides[0])
            and 0.15 < fill < 0.75
        ):
            shape = labels[top : top + height, left : left + width] == label
            mark = _matched(
                shape.astype(np.float32), np.array([left, top, width, height], dtype=np.float64)
            )
            if mark is not None:
                marks.append(mark)
    return marks


def _matched(shape: NDArray[np.float32], box: Points) -> Mark | None:
    """The ideal mark with the best overlap (intersection over union); None if it is too small."""
    interpolation = cv2.INTER_AREA if min(shape.shape) >= _CELLS else cv2.INTER_LINEAR
    cells = cv2.resize(shape, (_CELLS, _CELLS), interpolation=interpolation).ravel()
    matrix, areas = _template_matrix()
    common = matrix @ cells
    overlap = common / (areas + cells.sum() - common)
    best = int(np.argmax(overlap))
    if overlap[best] < _MIN_MATCH:
        return None
    template = _templates()[best]
    # The box spans pixel edges; pixel centres lie at integers.
    point = box[:2] - 0.5 + template.point * box[2:]
    return Mark(
        template.kind, template.quarter, point, template.arms * box[2:], float(overlap[best])
    )


def _scaled(mark: Mark, factor: float) -> Mark:
    return Mark(
        mark.kind, mark.quarter, (mark.point + 0.5) * factor - 0.5, mark.arms * factor, mark.score
    )


def _refined(gray: Gray, mark: Mark) -> Mark:
    """The mark with its reference point measured on its edges; unchanged if they are not clear."""
    for reach in _REACHES:
        measure = _edge_corner if mark.kind == "L" else _edge_tee
        better = measure(gray, mark, max(2.0, reach * mark.size))
        if better is None or np.linalg.norm(better.point - mark.point) > 0.3 * mark.size:
            return mark
        mark = better
    return mark


def _moved(mark: Mark, first: Line | None, second: Line | None) -> Mark | None:
    """The mark with its point at the intersection of two lines and its arms along them, or None."""
    if first is None or second is None:
        return None
    point = intersection(first, second)
    if point is None:
        return None
    lengths = np.linalg.norm(mark.arms, axis=1, keepdims=True)
    return Mark(
        mark.kind, mark.quarter, point, np.stack([first[1], second[1]]) * lengths, mark.score
    )


def _edge_corner(gray: Gray, mark: Mark, reach: float) -> Mark | None:
    """The outer corner of an L: the intersection of the outer edges of its two arms."""
    first = edge_line(
        gray, mark.point + 0.15 * mark.arms[0], 0.7 * mark.arms[0], mark.arms[1], reach
    )
    second = edge_line(
        gray, mark.point + 0.15 * mark.arms[1], 0.7 * mark.arms[1], mark.arms[0], reach
    )
    return _moved(mark, first, second)


def _edge_tee(gray: Gray, mark: Mark, reach: float) -> Mark | None:
    """Reference point of a T: the intersection of its stem's axis and its bar's outer edge."""
    half, stem = mark.arms
    bar = edge_line(gray, mark.point - 0.85 * half, 1.7 * half, stem, reach)
    start, run = mark.point + 0.4 * stem, 0.5 * stem
    left = edge_line(gray, start - 0.2 * half, run, half, reach)
    right = edge_line(gray, start + 0.2 * half, run, -half, reach)
    if left is None or right is None:
        return None
    along = (left[1] + right[1]) / np.linalg.norm(left[1] + right[1])
    return _moved(mark, bar, ((left[0] + right[0]) / 2, along))


def edge_line(gray: Gray, start: Points, run: Points, inward: Points, reach: float) -> Line | None:
    """The edge line near ``start`` to ``start + run``, within ``reach``.

    Along the line, brightness falls towards ``inward``.
    """
    across = np.array([-run[1], run[0]]) / np.linalg.norm(run)
    across *= np.sign(across @ inward)
    offsets = np.arange(-reach, reach + 0.25, 0.5)
    along = start + np.linspace(0, 1, max(8, int(np.linalg.norm(run) / 2)))[:, None] * run
    fall = _fall(gray, along[:, None] + offsets[:, None] * across)
    # Edges near the expected one are more likely; a rail or a seam next to the mark may be as
    # sharp.
    fall *= np.exp(-0.5 * ((offsets[:-1] + 0.25) / (0.5 * reach)) ** 2)
    drop = fall.max(axis=1)
    usable = drop > max(0.7, 0.4 * float(np.median(drop)))
    if usable.sum() < 6:
        return None
    fall = np.where(fall >= 0.4 * drop[:, None], fall, 0)[usable]
    shift = fall @ (offsets[:-1] + 0.25) / fall.sum(axis=1)
    return _line_through(along[usable] + shift[:, None] * across, shift, run)


def _fall(gray: Gray, places: Points) -> Points:
    """Fall of brightness (profiles, steps - 1) along profiles at positions (profiles, steps, 2)."""
    x, y = np.moveaxis(places.astype(np.float32), -1, 0)
    profiles = cv2.remap(gray, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # The edge is straight, so neighbouring profiles are averaged along it before the differences.
    steady = cv2.blur(profiles.astype(np.float32), (1, max(1, len(profiles) // 5)))
    return np.maximum(-np.diff(steady.astype(np.float64), axis=1), 0)


def _line_through(points: Points, shift: Points, run: Points) -> Line:
    """The line through edge points (n, 2), without outliers."""
    deviation = np.abs(shift - np.median(shift))
    close = deviation <= max(1.5, 3 * float(np.median(deviation)))
    dx, dy, x, y = (
        float(value)
        for value in cv2.fitLine(
            points[close].astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01
        ).ravel()
    )
    direction = np.array([dx, dy])
    return np.array([x, y]), direction * np.sign(direction @ run)


def intersection(first: Line, second: Line) -> Points | None:
    """The intersection (2,) of two lines, or None if they are nearly parallel."""
    along = [line[1] / np.linalg.norm(line[1]) for line in (first, second)]
    matrix = np.stack([along[0], -along[1]], axis=1)
    if abs(np.linalg.det(matrix)) < 0.2:
        return None
    distance = np.linalg.solve(matrix, second[0] - first[0])[0]
    return np.asarray(first[0] + distance * along[0])
