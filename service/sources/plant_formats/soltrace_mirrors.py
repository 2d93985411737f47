"""Elements of SolTrace as mirrors: which ones are facets of one heliostat, and its pose."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from model.errors import InvalidInputError
from service.base.validation import NAME
from service.sources.plant_formats.imported import FacetedMirror, Tolerance, design_of
from service.sources.plant_schema import MAX_FACETS
from service.sources.text_lines import ForeignLine

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

# SolTrace's program writes six digits.
SOLTRACE_TOLERANCE = Tolerance(slope=5e-5, power=2e-2)
_SAME_PLACE = 2e-2  # [m], of facets in their mirror
_SAME_SIZE = 2e-3  # [m]
_ROLL = 1e-4  # largest deviation of a mirror's x axis from the horizontal [rad]
TURNED = 1e-3
"""Angle [rad] of a facet's side in its mirror that is not worth a word."""
# Programs give canted facets the rotation of their mirror. It turns them by their canting times the
# tangent of the normal's angle from the horizontal plane through x and z.
_TURNED_BY_CANTING = 3.0
_CANTED = 0.3  # largest angle between the normals of facets of one heliostat [rad]
# Heliostats turn freely: their middles are further apart than they are large.
_FREE = 0.97
# Largest gap between neighbouring facets, in their shorter side.
_GAP = 0.25

NAMED_STAGE = "Heliostat field, comments are names"
"""The name of a stage whose elements have their heliostat's name as comment, as we write it."""


@dataclass(frozen=True, eq=False)
class Element:
    """A surface of a stage.

    Attributes
    ----------
    line : ForeignLine
    origin : (3,) [m]
    axes : (3, 3)
        Unit vectors along its x, y and z, as rows.
    aperture, surface : str
        Letters of their kinds.
    size, shape : sequence of float
        Parameters of aperture and surface.
    optics : str
        Name of its optical pair.
    comment : str
    is_enabled : bool
    """

    line: ForeignLine
    origin: Array
    axes: Array
    aperture: str
    size: Sequence[float]
    surface: str
    shape: Sequence[float]
    optics: str
    comment: str = ""
    is_enabled: bool = True


class Pose(NamedTuple):
    """Middle (3,) [m] of a mirror, and unit vectors (3, 3) along its x, y and z, as rows."""

    middle: Array
    axes: Array


# --- which elements are one heliostat
# --------------------------------------------------------------------------------------------------


def heliostat_groups(
    elements: Sequence[Element], has_names: bool = False
) -> dict[str, list[Element]]:
    """Elements by heliostat: those of one comment, or those that touch.

    Comments that differ within elements that touch name facets, unless ``has_names``.

    Raises
    ------
    InvalidInputError
        If elements that touch are no heliostats that can turn. It names their lines.
    """
    by_comment: dict[str, list[Element]] = {}
    for element in elements:
        by_comment.setdefault(element.comment, []).append(element)
    by_label: dict[int, list[Element]] = {}
    for element, label in zip(elements, _touching(elements).tolist(), strict=True):
        by_label.setdefault(label, []).append(element)
    groups = list(by_label.values())
    are_facets = any(len({element.comment for element in group}) > 1 for group in groups)
    are_names = has_names or not are_facets or not all(map(_is_one_mirror, groups))
    if "" not in by_comment and are_names and all(map(_is_one_mirror, by_comment.values())):
        names = list(by_comment)
        if not all(re.fullmatch(NAME, name) for name in names):
            names = [f"H{number}" for number in range(1, len(names) + 1)]
        return dict(zip(names, by_comment.values(), strict=True))
    for group in groups:
        if not _is_one_mirror(group):
            raise group[1].line.refuse(
                f"{len(group)} elements touch, the first of {group[0].line.place}, and are not the"
                " facets of one heliostat; write the name of its heliostat into each one's comment"
            )
    return {f"H{number}": group for number, group in enumerate(groups, start=1)}


def _is_one_mirror(group: Sequence[Element]) -> bool:
    """Whether elements may be the facets of a heliostat: few, near, and of nearly one normal."""
    normals = np.array([element.axes[2] for element in group])
    middle = normals.sum(axis=0)
    slanted = normals @ middle < math.cos(_CANTED) * np.linalg.norm(middle)
    places = np.array([element.origin for element in group])
    reach = np.ptp(places, axis=0).max() <= 2 * math.sqrt(len(group)) * _largest(group)
    return len(group) <= MAX_FACETS and not slanted.any() and bool(reach)


def _largest(group: Sequence[Element]) -> float:
    return max(float(np.hypot(*half_sizes(element))) * 2 for element in group)


def _touching(elements: Sequence[Element]) -> Labels:
    """Numbers (n,) of the groups of elements that touch, or that could not turn separately."""
    places = np.array([element.origin for element in elements])
    half = np.array([half_sizes(element) for element in elements])
    axes = np.array([element.axes for element in elements])
    corners = places[:, None] + np.einsum("ck,nk,nkd->ncd", _SIGNS, half, axes[:, :2])
    labels = _components(places, 2 * half, axes)
    while True:
        middles, reach = _extents(labels, corners)
        pairs = _pairs(middles, 2 * reach.max())
        apart = np.linalg.norm(middles[pairs[:, 0]] - middles[pairs[:, 1]], axis=1)
        joined = pairs[apart < _FREE * reach[pairs].sum(axis=1)]
        if not len(joined):
            return labels
        labels = _labels(joined, len(middles))[labels]


_SIGNS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def _components(places: Array, sizes: Array, axes: Array) -> Labels:
    """Numbers (n,) of groups of elements whose sides meet in one plane, with a gap at most."""
    with_gap = sizes + _GAP * sizes.min(axis=1, keepdims=True)
    pairs = _pairs(places, float(np.hypot(*with_gap.T).max()))
    first, second = pairs.T
    way = np.abs(np.einsum("nij,nj->ni", axes[first], places[second] - places[first]))
    reach = (sizes[first] + sizes[second]) / 2
    touch = (way[:, :2] < reach + _GAP * reach.min(axis=1, keepdims=True)).all(axis=1)
    beside = (way[:, :2] < reach / 2).any(axis=1)
    alike = np.einsum("ni,ni->n", axes[first, 2], axes[second, 2]) > math.cos(_CANTED)
    level = way[:, 2] < _CANTED * reach.max(axis=1)
    return _labels(pairs[touch & beside & alike & level], len(places))


def _extents(labels: Labels, corners: Array) -> tuple[Array, Array]:
    """Middles (g, 3) [m] of groups, and the radii (g,) [m] of spheres that hold their elements of
    ``corners`` (n, 4, 3) [m].
    """
    count = int(labels.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, labels, corners.min(axis=1))
    np.maximum.at(high, labels, corners.max(axis=1))
    middles, reach = (low + high) / 2, np.zeros(count)
    away = np.linalg.norm(corners - middles[labels][:, None], axis=-1)
    np.maximum.at(reach, labels, away.max(axis=1))
    return middles, reach


def _pairs(places: Array, distance: float) -> Labels:
    found: Labels = cKDTree(places).query_pairs(distance, output_type="ndarray")
    return found.reshape(-1, 2)


def _labels(pairs: Labels, count: int) -> Labels:
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


# --- poses and facets
# --------------------------------------------------------------------------------------------------


def half_sizes(element: Element) -> Array:
    """Half width and half height (2,) [m] of an element, which must be a rectangle."""
    if element.aperture != "r":
        raise element.line.refuse(
            f"aperture {element.aperture[:20]!r} of a heliostat is not read; r, a rectangle, is"
        )
    if not all(0.01 <= size <= 100 for size in element.size[:2]):
        raise element.line.refuse("width and height of a heliostat's element must be 0.01 to 100 m")
    return np.array(element.size[:2]) / 2


class PosedMirror(NamedTuple):
    """A heliostat's pose and its facets in mirror coordinates."""

    pose: Pose
    facets: FacetedMirror


def posed_mirror(facets: Sequence[Element]) -> PosedMirror:
    """The mirror of a heliostat on a mount of azimuth and elevation.

    Its normal is the mean of its facets', or else that of the plane of their middles: with the one
    that makes it canted to a point, or not at all.

    Raises
    ------
    InvalidInputError
        It names the line of a facet that no type has.
    """
    places = np.array([facet.origin for facet in facets])
    mean = np.sum([facet.axes[2] for facet in facets], axis=0)
    _, spread, directions = np.linalg.svd(places - places.mean(axis=0))
    is_plane = len(spread) > 1 and spread[1] > 0.1 * spread[0]
    found, refused = [], []
    for z in (mean, directions[2] * np.sign(directions[2] @ mean))[: 1 + is_plane]:
        pose = _pose(facets, z / np.linalg.norm(z))
        try:
            mirror = PosedMirror(pose, _faceted_mirror(facets, pose))
        except InvalidInputError as error:
            refused.append(error)
            continue
        design = design_of(mirror.facets, SOLTRACE_TOLERANCE).design if is_plane else None
        if design is None or design.canting != "individual":
            return mirror
        found.append(mirror)
    if not found:
        raise refused[0]
    return found[0]


def _pose(facets: Sequence[Element], z: Array) -> Pose:
    """The pose with a normal ``z`` (3,); x is horizontal, and the middle that of the places."""
    x = np.cross([0.0, 0.0, 1.0], z)
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(facets[0].axes[1], z)
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), z])
    local = np.array([facet.origin for facet in facets]) @ axes.T
    return Pose((local.min(axis=0) + local.max(axis=0)) / 2 @ axes, axes)


def _faceted_mirror(facets: Sequence[Element], pose: Pose) -> FacetedMirror:
    """The facets of a heliostat in mirror coordinates."""
    sides = []
    for facet in facets:
        half = half_sizes(facet)
        local: Array = facet.axes @ pose.axes.T
        if abs(local[0, 1]) > abs(local[0, 0]):
            half, local = half[::-1], np.stack([-local[1], local[0], local[2]])
        canting = float(np.hypot(*local[2, :2]))
        limit = _ROLL if len(facets) == 1 else TURNED + _TURNED_BY_CANTING * canting
        if abs(local[0, 1]) > limit:
            raise facet.line.refuse(
                "is rolled about its normal; only mirrors on an azimuth-elevation mount are read"
            )
        if facet.line.cells[28:29] != ["2"]:
            raise facet.line.refuse("must have interaction 2, reflection")
        sides.append(np.sign(local[0, 0]) * half[:, None] * local[:2])
    places = np.array([facet.origin for facet in facets]) - pose.middle
    return FacetedMirror(places @ pose.axes.T, np.array(sides), np.array([*map(_power, facets)]))


def _power(facet: Element) -> float:
    """One over the focal length [m] of a paraboloid; 0 for a flat facet."""
    if facet.surface == "f":
        return 0.0
    c_x, c_y = facet.shape[:2]
    if facet.surface != "p" or c_x != c_y or not 1e-5 < c_x < 1:
        raise facet.line.refuse(
            f"surface {facet.surface[:20]!r} of a heliostat is not read; f, flat, and p, a"
            " paraboloid of revolution, are"
        )
    return 2 * c_x


def like_known(mirror: FacetedMirror, known: list[FacetedMirror]) -> FacetedMirror:
    """A mirror with the places, and if alike the normals, of one that is ``known``; else it is
    added to them.
    """
    lengths = np.linalg.norm(mirror.sides, axis=-1)
    for other in known:
        if (
            len(other.centers) == len(mirror.centers)
            and np.abs(other.centers - mirror.centers).max() < _SAME_PLACE
            and np.abs(np.linalg.norm(other.sides, axis=-1) - lengths).max() < _SAME_SIZE
        ):
            is_alike = np.abs(other.normals - mirror.normals).max() < SOLTRACE_TOLERANCE.slope
            longer = np.linalg.norm(other.sides, axis=-1) / lengths
            sides = other.sides if is_alike else mirror.sides * longer[..., None]
            return FacetedMirror(other.centers, sides, mirror.powers)
    known.append(mirror)
    return mirror
