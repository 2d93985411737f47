"""The parts of a plant: facets, heliostats, target planes, receivers.

Frozen dataclasses in numpy; the tracers convert them to batched tensors (`model.tracing.scene`).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import ImageRefusedError, InvalidInputError, UnreachableError
from model.frames import enu_to_wgs84, wgs84_to_enu
from model.locating import KnownCamera, Locator, corners_by_camera, locator_from_json
from model.mount import Mount
from model.site import Site

Vector = NDArray[np.float64]

MAX_ASPECT = 20.0
"""Largest ratio of the longer to the shorter side of a plane or of an unrolled cylinder."""

MIN_OPENING_DEG = 5.0
"""Smallest opening [deg] of a cylinder."""


def require_plane_shape(width: float, height: float) -> None:
    """Refuse a plane of ``width`` and ``height`` [m] that would need too large a grid.

    For planes of requests and files; the planes of a cylinder are narrower.

    Raises
    ------
    InvalidInputError
    """
    if max(width, height) > MAX_ASPECT * min(width, height):
        raise InvalidInputError(
            f"width {width:g} m and height {height:g} m: one must be no more than {MAX_ASPECT:g}"
            " times the other; give a larger plane, or several"
        )


def require_cylinder_shape(radius: float, height: float, opening_deg: float) -> None:
    """Refuse a cylinder that would need too large a grid, as `require_plane_shape` does.

    ``radius`` and ``height`` [m], ``opening_deg`` [deg].
    """
    if opening_deg < MIN_OPENING_DEG:
        raise InvalidInputError(
            f"opening_deg {opening_deg:g}: must be {MIN_OPENING_DEG:g} or more; give a plane"
            " instead"
        )
    width = math.radians(opening_deg) * radius
    if max(width, height) > MAX_ASPECT * min(width, height, radius):
        raise InvalidInputError(
            f"height {height:g} m, radius {radius:g} m and arc {width:g} m: the longer of height"
            f" and arc must be no more than {MAX_ASPECT:g} times each of the others; give a plane,"
            " or several cylinders"
        )


Outline = tuple[tuple[float, float], ...]
"""Corners (x, y) of a facet's edge in half widths and half heights, in either direction."""


def outline_share(outline: Outline) -> float:
    """Share of the rectangle from -1 to 1 that is inside an outline, by the shoelace formula."""
    x, y = np.array(outline, dtype=np.float64).T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 8)


def inside_outline(x: Vector, y: Vector, outline: ArrayLike) -> NDArray[np.bool_]:
    """Which places (...) are inside a polygon (V, 2), by the even-odd rule."""
    corners = np.asarray(outline, dtype=np.float64)
    inside = np.zeros(np.broadcast_shapes(x.shape, y.shape), dtype=bool)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return inside


def _vector(name: str, value: ArrayLike) -> Vector:
    vector = np.array(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InvalidInputError(f"{name} must be three finite numbers, got {value!r}")
    vector.flags.writeable = False
    return vector


@dataclass(frozen=True, eq=False)
class Facet:
    """One mirror facet and its ideal pose.

    Attributes
    ----------
    position : (3,) [m]
        Its centre in mirror coordinates (x right, y up, z out of the mirror).
    canting_x, canting_y : (3,) [m]
        Half its width and half its height, as vectors in mirror coordinates (PAINT's ``canting_e``,
        ``canting_n``).
    focal_length : float or None [m]
        Of the paraboloid that it is; None for a flat facet.
    outline : tuple of (x, y), or None
        Corners of its edge in half widths and half heights; None for the whole rectangle.
    """

    position: Vector
    canting_x: Vector
    canting_y: Vector
    focal_length: float | None = None
    outline: Outline | None = None

    def __post_init__(self) -> None:
        for name in ("position", "canting_x", "canting_y"):
            object.__setattr__(self, name, _vector(f"facet {name}", getattr(self, name)))
        if not self._quarter > 1e-9:
            raise InvalidInputError("facet canting vectors must span an area")
        if self.focal_length is not None and not self.focal_length > 0:
            raise InvalidInputError(f"facet focal_length must be positive, got {self.focal_length}")

    @property
    def _quarter(self) -> float:
        """A quarter of the rectangle's area [m2]; a field has a hundred thousand facets."""
        (ax, ay, az), (bx, by, bz) = self.canting_x.tolist(), self.canting_y.tolist()
        return math.hypot(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)

    @property
    def area(self) -> float:
        """Area [m2] within its outline, as if it were flat."""
        rectangle = 4 * self._quarter
        return rectangle if self.outline is None else rectangle * outline_share(self.outline)


@dataclass(frozen=True)
class MirrorOptics:
    """What a heliostat's mirror does to light besides its shape.

    Attributes
    ----------
    reflectance : float
        Multiplies the plant's, `model.tracing.Optics.reflectivity`.
    slope_error : float [rad]
        Standard deviation of the normals per axis.
    pointing_error : float [rad]
        Standard deviation of the reflected beam's direction per axis.
    cleanliness : float
        Share of the reflected light that soiling leaves.
    """

    reflectance: float = 1.0
    slope_error: float = 0.0
    pointing_error: float = 0.0
    cleanliness: float = 1.0

    def __post_init__(self) -> None:
        for name in ("reflectance", "cleanliness"):
            if not 0 < getattr(self, name) <= 1:
                raise InvalidInputError(f"{name} must lie in (0, 1], got {getattr(self, name):g}")
        for name in ("slope_error", "pointing_error"):
            if not 0 <= getattr(self, name) < 0.1:
                raise InvalidInputError(
                    f"{name} [rad] must lie in [0, 0.1), got {getattr(self, name):g}"
                )


REFERENCE_SINE = 0.5
"""Sine of 30 degrees, the mean elevation of normals in Juelich's field north of its tower."""

PERFECT = MirrorOptics()
"""A mirror that reflects all light where it should."""


class FacetFrames(NamedTuple):
    """Centres (F, 3) [m], axes (F, 3 axes, 3) and half sizes (F, 2) [m] of facets.

    The axes are orthonormal: x along ``canting_x``, z normal, y to complete them.
    """

    centers: NDArray[np.float64]
    axes: NDArray[np.float64]
    half_sizes: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Heliostat:
    """A heliostat: position, mount and facets.

    Attributes
    ----------
    name : str
    position : (3,) [m]
        The mount's reference point in ENU.
    mount : Mount
    facets : tuple of Facet
        In PAINT's order: upper left, upper right, lower left, lower right, seen from the front.
    width, height : float [m]
        Of the whole mirror.
    optics : MirrorOptics
    reference_sine : float
        Sine of the elevation of the mirror's normal at which its surface is the known one: where it
        was canted or measured. Elsewhere it sags (`model.effects.gravity_bending`).
    """

    name: str
    position: Vector
    mount: Mount
    facets: tuple[Facet, ...]
    width: float = 3.22
    height: float = 2.56
    optics: MirrorOptics = PERFECT
    reference_sine: float = REFERENCE_SINE

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", _vector(f"position of {self.name}", self.position))
        if not self.facets:
            raise InvalidInputError(f"heliostat {self.name} has no facets")

    @classmethod
    def juelich(
        cls,
        name: str,
        position: ArrayLike,
        focal_length: float | None = None,
        *,
        mount: Mount | None = None,
        facet_depth: float = 0.0402,
    ) -> "Heliostat":
        """A heliostat of the Solar Tower Juelich's type: four facets of 1.605 m x 1.275 m.

        The facets are canted to ``focal_length`` [m], or lie in one plane without it. They are
        ``facet_depth`` [m] in front of the mirror's reference plane; ``position`` (3,) [m].
        """
        curvature = 0.0 if focal_length is None else 1 / (2 * focal_length)
        facets = tuple(
            Facet(
                np.array([x, y, facet_depth]),
                np.array([0.8025, 0.0, 0.8025 * x * curvature]),
                np.array([0.0, 0.6375, 0.6375 * y * curvature]),
            )
            for x, y in ((-0.8075, 0.6425), (0.8075, 0.6425), (-0.8075, -0.6425), (0.8075, -0.6425))
        )
        return cls(name, np.asarray(position, dtype=np.float64), mount or Mount.juelich(), facets)

    @property
    def area(self) -> float:
        """Area [m2] of its facets."""
        return sum(facet.area for facet in self.facets)

    @property
    def has_facets_in_order(self) -> bool:
        """Whether four facets in two rows and two columns have the order of `facets`; true for
        other mirrors.

        Surfaces are lists of facets: a facet in another place would be confused with another one.
        """
        if len(self.facets) != 4:
            return True
        places = np.array([facet.position[:2] for facet in self.facets])
        quarters = [(bool(x), bool(y)) for x, y in places > places.mean(axis=0)]
        return len(set(quarters)) < 4 or quarters == [
            (False, True),
            (True, True),
            (False, False),
            (True, False),
        ]

    @property
    def facet_frames(self) -> FacetFrames:
        """Frames of the ideal facets in mirror coordinates."""
        half_x = np.array([facet.canting_x for facet in self.facets])
        half_y = np.array([facet.canting_y for facet in self.facets])
        half_sizes = np.stack(
            [np.linalg.norm(half_x, axis=-1), np.linalg.norm(half_y, axis=-1)], axis=-1
        )
        x = half_x / half_sizes[:, :1]
        z = np.cross(half_x, half_y)
        z /= np.linalg.norm(z, axis=-1, keepdims=True)
        axes = np.stack([x, np.cross(z, x), z], axis=-2)
        centers = np.array([facet.position for facet in self.facets])
        return FacetFrames(centers, axes, half_sizes)

    @property
    def facet_normals(self) -> NDArray[np.float64]:
        """Unit normals (F, 3) of the ideal facets: the directions of heights."""
        return np.asarray(self.facet_frames.axes[:, 2])


def _orient(surface: "TargetPlane | Cylinder", kind: str) -> None:
    """Check ``normal``, ``up`` and ``center``, and make the first two orthonormal."""
    normal, up = _vector(f"{kind} normal", surface.normal), _vector(f"{kind} up", surface.up)
    normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
    up = up - (up @ normal) * normal
    if np.linalg.norm(normal) < 0.5 or np.linalg.norm(up) < 1e-6:
        raise InvalidInputError(
            f"{kind} {surface.name}: normal must not vanish and up must not be parallel to it"
        )
    object.__setattr__(surface, "center", _vector(f"{kind} center", surface.center))
    object.__setattr__(surface, "normal", _vector(f"{kind} normal", normal))
    object.__setattr__(surface, "up", _vector(f"{kind} up", up / np.linalg.norm(up)))


class SurfaceGrid(NamedTuple):
    """Places of a receiver's map: points [m] and unit normals (rows, columns, 3), areas (rows,
    columns) [m2].
    """

    points: Vector
    normals: Vector
    areas: Vector


@dataclass(frozen=True, eq=False)
class TouchingPlanes:
    """Planes in front of a receiver, one for each of B mirrors, that its light passes.

    Attributes
    ----------
    centers : (B, 3) [m]
        Middles of the windows.
    axes : (B, 3, 3)
        Right, up and normal as rows; the normal points to the mirror.
    size : (width, height) [m]
        Of windows that show the whole receiver from each mirror.
    opening : callable or None
        Share of light that passes each cell of a window of (rows, columns).
    outline : (V, 2) [m] or None
        Corners of the opening, right and up of the windows' middles.
    screens : (K, 3, 3) [m] or None
        Rectangles, centre and half sides, behind which the receiver gets no light.
    """

    centers: Vector
    axes: Vector
    size: tuple[float, float]
    opening: Callable[[int, int], Vector] | None = None
    outline: Vector | None = None
    screens: Vector | None = None


def windows_on(grid: SurfaceGrid, mirrors: Vector, origins: Vector, axes: Vector) -> TouchingPlanes:
    """Windows on planes that show all places of a grid which face the mirrors.

    Parameters
    ----------
    grid : SurfaceGrid
        A few places, those on the surface's edges among them.
    mirrors, origins : (B, 3) [m]
        Middles of the mirrors, and points of their planes.
    axes : (B, 3, 3)
        Of the planes.

    Raises
    ------
    UnreachableError
        If a mirror sees nothing of the surface.
    """
    ways = grid.points.reshape(-1, 3) - mirrors[:, None]
    faces = (ways * grid.normals.reshape(-1, 3)).sum(axis=-1) < 0
    apart = np.einsum("bij,bj->bi", axes, origins - mirrors)
    turned = np.einsum("bij,bpj->bpi", axes, ways)
    is_seen = faces & (turned[..., 2] < 0)
    if not is_seen.any(axis=1).all():
        raise UnreachableError(
            "a mirror is behind the lit part of the receiver; leave it out or aim it elsewhere"
        )
    scale = apart[:, None, 2] / np.where(is_seen, turned[..., 2], -1.0)
    places = turned[..., :2] * scale[..., None] - apart[:, None, :2]
    low = np.where(is_seen[..., None], places, np.inf).min(axis=1)
    high = np.where(is_seen[..., None], places, -np.inf).max(axis=1)
    middles = (low + high) / 2
    width, height = _MARGIN * (high - low).max(axis=0)
    centers = origins + np.einsum("bi,bij->bj", middles, axes[:, :2])
    return TouchingPlanes(centers, axes, (float(width), float(height)))


_MARGIN = 1.04
"""Windows are larger than the receiver by this factor, so that its edges are inside."""


@dataclass(frozen=True, eq=False)
class TargetPlane:
    """A rectangle that light falls on: a calibration target, or another plane.

    Attributes
    ----------
    name : str
    center : (3,) [m]
        In ENU.
    normal : (3,)
        Unit normal of the lit side.
    up : (3,)
        Unit vector of the image's upward direction, made perpendicular to ``normal``.
    width, height : float [m]
    absorptance : float
        Share of the light on it that it takes up.
    locator : Locator or None
        How photographs show where it is; None if it declares nothing.
    """

    name: str
    center: Vector
    normal: Vector
    up: Vector
    width: float
    height: float
    absorptance: float = 1.0
    locator: Locator | None = None

    def __post_init__(self) -> None:
        if not (0 < self.width < 1e4 and 0 < self.height < 1e4):
            raise InvalidInputError(f"target {self.name}: width and height must be positive metres")
        _orient(self, "target")

    @classmethod
    def from_corners(
        cls,
        name: str,
        upper_left: Vector,
        upper_right: Vector,
        lower_left: Vector,
        lower_right: Vector,
    ) -> "TargetPlane":
        """The plane of four corners (3,) [m] as in the image, by the means of opposite edges.

        Raises
        ------
        InvalidInputError
            If it has no area, or `require_plane_shape` refuses it.
        """
        corners = np.array([upper_left, upper_right, lower_left, lower_right], dtype=np.float64)
        right = (corners[1] + corners[3] - corners[0] - corners[2]) / 2
        up = (corners[0] + corners[1] - corners[2] - corners[3]) / 2
        width, height = float(np.linalg.norm(right)), float(np.linalg.norm(up))
        plane = cls(name, corners.mean(axis=0), np.cross(right, up), up, width, height)
        try:
            require_plane_shape(width, height)
        except InvalidInputError as error:
            raise InvalidInputError(f"target {name}: {error}") from None
        return plane

    @property
    def right(self) -> Vector:
        """Unit vector along the image's columns: west on a target that faces north."""
        return np.asarray(np.cross(self.up, self.normal))

    @property
    def axes(self) -> NDArray[np.float64]:
        """Right, up and normal as rows (3, 3)."""
        return np.stack([self.right, self.up, self.normal])

    @property
    def middle(self) -> "TargetPlane":
        """The plane."""
        return self

    @property
    def shape(self) -> dict[str, float]:
        """No numbers besides those of the rectangle."""
        return {}

    def aim_of(self, mirrors: Vector) -> Vector:
        """Its middle (..., 3) [m], for all mirrors (..., 3) [m]."""
        return np.broadcast_to(self.center, mirrors.shape)

    def grid(self, rows: int, columns: int) -> SurfaceGrid:
        """Places of the map."""
        x = ((np.arange(columns) + 0.5) / columns - 0.5) * self.width
        y = (0.5 - (np.arange(rows) + 0.5) / rows) * self.height
        points = self.to_enu(np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1))
        area = self.width * self.height / (rows * columns)
        return SurfaceGrid(
            points, np.broadcast_to(self.normal, points.shape), np.full((rows, columns), area)
        )

    def touching(self, mirrors: Vector) -> TouchingPlanes:
        """The plane itself, for each mirror."""
        n = len(mirrors)
        return TouchingPlanes(
            np.tile(self.center, (n, 1)), np.tile(self.axes, (n, 1, 1)), (self.width, self.height)
        )

    def to_plane(self, points: ArrayLike) -> NDArray[np.float64]:
        """Coordinates (..., 2) [m] right and up of the centre, of ENU points (..., 3)."""
        return np.asarray((np.asarray(points, dtype=np.float64) - self.center) @ self.axes[:2].T)

    def to_enu(self, coordinates: ArrayLike) -> NDArray[np.float64]:
        """ENU points (..., 3) of coordinates (..., 2) [m] right and up of the centre."""
        return np.asarray(self.center + np.asarray(coordinates, dtype=np.float64) @ self.axes[:2])

    def located_by(self, declared: Mapping[str, Any]) -> "TargetPlane":
        """The target with a locator, declared as `model.locating.locator_from_json` has it.

        Raises
        ------
        InvalidInputError
            If a declared camera cannot see it; it begins with the key of the mistake.
        """
        locator = locator_from_json(declared)
        if isinstance(locator, KnownCamera):
            try:
                corners_by_camera(locator, self)
            except ImageRefusedError as refusal:
                raise InvalidInputError(f"image_size_px: {refusal.detail}") from None
        return replace(self, locator=locator)

    def contains(self, point: ArrayLike) -> bool:
        """Whether a point (3,) [m] of the plane lies within the rectangle."""
        return bool((np.abs(self.to_plane(point)) <= np.array([self.width, self.height]) / 2).all())


class Receiver(Protocol):
    """A surface that the light of a field falls on; its map is the unrolled surface."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def absorptance(self) -> float:
        """Share of the light on it that it takes up."""

    @property
    def center(self) -> Vector:
        """Middle of the lit surface (3,) [m] in ENU."""

    def aim_of(self, mirrors: Vector) -> Vector:
        """Default aims (..., 3) [m] of mirrors (..., 3) [m], in ENU."""

    @property
    def normal(self) -> Vector:
        """Unit normal (3,) there."""

    @property
    def up(self) -> Vector:
        """Unit vector (3,) along the map's rows there, upwards."""

    @property
    def width(self) -> float:
        """Length of the map [m]."""

    @property
    def height(self) -> float:
        """Height of the map [m]."""

    @property
    def shape(self) -> dict[str, float]:
        """Further numbers of the surface, by the names that stored forecasts use."""

    @property
    def middle(self) -> TargetPlane:
        """A plane that touches the surface in its middle."""

    def grid(self, rows: int, columns: int) -> SurfaceGrid:
        """Places of a map of (rows, columns)."""

    def touching(self, mirrors: Vector) -> TouchingPlanes:
        """Planes in front of it toward mirrors whose middles are (B, 3) [m].

        Raises
        ------
        UnreachableError
            If a mirror sees nothing of it.
        """


_MOST_COLUMNS = 1024


def square_pixels(receiver: Receiver, rows: int) -> tuple[int, int]:
    """Rows and columns of a receiver's map whose pixels are about square."""
    columns = round(rows * receiver.width / receiver.height)
    return rows, min(max(columns, rows // 4), _MOST_COLUMNS)


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A receiver that is a cylinder or a part of one, lit from outside.

    Its map is the unrolled surface: rows along the axis, columns over the angle, equally spaced.

    Attributes
    ----------
    name : str
    center : (3,) [m]
        The middle of the lit surface, in ENU; the axis is ``radius`` behind it.
    normal : (3,)
        Unit normal there, away from the axis.
    up : (3,)
        Unit vector along the axis, upwards in the map; made perpendicular to ``normal``.
    radius, height : float [m]
    opening_deg : float [deg]
        Angle of the lit surface, half of it to each side of the middle; 360 for all around.
    absorptance : float
        As of `TargetPlane`.
    """

    name: str
    center: Vector
    normal: Vector
    up: Vector
    radius: float
    height: float
    opening_deg: float = 360.0
    absorptance: float = 1.0

    def __post_init__(self) -> None:
        if not (0 < self.radius < 1e3 and 0 < self.height < 1e4):
            raise InvalidInputError(
                f"receiver {self.name}: radius and height must be positive metres"
            )
        if not 0 < self.opening_deg <= 360:
            raise InvalidInputError(
                f"receiver {self.name}: opening_deg must lie in (0, 360], got {self.opening_deg}"
            )
        _orient(self, "receiver")

    @property
    def right(self) -> Vector:
        """Unit vector along the map's columns at its middle."""
        return np.asarray(np.cross(self.up, self.normal))

    @property
    def width(self) -> float:
        """Length of the lit arc [m]."""
        return float(np.radians(self.opening_deg)) * self.radius

    def tangent(self, angle: float, left: float, right: float) -> TargetPlane:
        """The plane that touches the surface at ``angle`` [rad] from its middle, positive to the
        right.

        It extends ``left`` and ``right`` [m] from the line of contact.
        """
        normal = np.cos(angle) * self.normal + np.sin(angle) * self.right
        touched = self.center + self.radius * (normal - self.normal)
        aside = (right - left) / 2 * np.cross(self.up, normal)
        return TargetPlane(self.name, touched + aside, normal, self.up, left + right, self.height)

    @property
    def shape(self) -> dict[str, float]:
        """Radius [m] and opening [deg]."""
        return {"radius": self.radius, "opening_deg": self.opening_deg}

    @property
    def middle(self) -> TargetPlane:
        """The plane that touches it in its middle, as wide as the cylinder."""
        return self.tangent(0.0, self.radius, self.radius)

    @property
    def axis(self) -> Vector:
        """The point (3,) [m] of its axis at mid height."""
        return self.center - self.radius * self.normal

    def aim_of(self, mirrors: Vector) -> Vector:
        """The points (..., 3) [m] at mid height that face mirrors (..., 3) [m].

        On a part of a cylinder it is the middle of what a mirror sees, across its beam.
        """
        outward, half = mirrors - self.axis, np.radians(self.opening_deg) / 2
        facing = np.arctan2(outward @ self.right, outward @ self.normal)
        angles = facing
        if self.opening_deg < 360:
            low = np.maximum(-half, facing - np.pi / 2)
            high = np.minimum(half, facing + np.pi / 2)
            across = (np.sin(low - facing) + np.sin(high - facing)) / 2
            angles = np.clip(facing + np.arcsin(across), -half, half)
        return np.asarray(self.axis + self.radius * self._normals(angles))

    def _at(self, angles: Vector, heights: Vector) -> SurfaceGrid:
        """Places at angles [rad] from the middle and heights [m] over it; areas are zero."""
        normals = self._normals(angles)
        points = self.axis + self.radius * normals + heights[:, None, None] * self.up
        return SurfaceGrid(points, np.broadcast_to(normals, points.shape), np.zeros(()))

    def grid(self, rows: int, columns: int) -> SurfaceGrid:
        """Places of the unrolled map."""
        angles = ((np.arange(columns) + 0.5) / columns - 0.5) * np.radians(self.opening_deg)
        heights = (0.5 - (np.arange(rows) + 0.5) / rows) * self.height
        places = self._at(angles, heights)
        area = self.width * self.height / (rows * columns)
        return places._replace(areas=np.full((rows, columns), area))

    def facing(self, points: Vector) -> Vector:
        """Unit normals (..., 3) of the lit surface where it is nearest to points (..., 3) [m]."""
        outward, half = points - self.axis, np.radians(self.opening_deg) / 2
        return self._normals(
            np.arctan2(outward @ self.right, outward @ self.normal).clip(-half, half)
        )

    def _normals(self, angles: Vector) -> Vector:
        """Unit normals (..., 3) at angles (...) [rad] from the middle."""
        return np.asarray(
            np.cos(angles)[..., None] * self.normal + np.sin(angles)[..., None] * self.right
        )

    def touching(self, mirrors: Vector) -> TouchingPlanes:
        """Planes that touch it along the line nearest to each mirror."""
        half, normals = np.radians(self.opening_deg) / 2, self.facing(mirrors)
        axes = np.stack(
            [np.cross(self.up, normals), np.broadcast_to(self.up, normals.shape), normals], axis=1
        )
        origins = self.axis + self.radius * normals
        if (((mirrors - origins) * normals).sum(axis=1) <= 0).any():
            raise UnreachableError(
                "a mirror is behind the lit part of the receiver; leave it out or aim it elsewhere"
            )
        edges = self._at(
            np.linspace(-half, half, _EDGE_PLACES), np.array([0.5, -0.5]) * self.height
        )
        return windows_on(edges, mirrors, origins, axes)


_EDGE_PLACES = 73
"""Places around a cylinder's edges by which its windows are found: five degrees apart."""


@dataclass(frozen=True, eq=False)
class Plant:
    """A tower with heliostats and targets; ``origin`` (3,) is its base in WGS84 [deg, deg, m]."""

    name: str
    origin: Vector
    targets: dict[str, TargetPlane] = field(default_factory=dict)
    heliostats: dict[str, Heliostat] = field(default_factory=dict)
    receivers: Mapping[str, Receiver] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin", _vector("plant origin", self.origin))

    @property
    def site(self) -> Site:
        """Location of the tower base."""
        return Site.from_origin(self.origin)

    def to_enu(self, wgs84: ArrayLike) -> NDArray[np.float64]:
        """ENU (..., 3) [m] of WGS84 positions (..., 3) [deg, deg, m]."""
        return wgs84_to_enu(wgs84, self.origin)

    def to_wgs84(self, enu: ArrayLike) -> NDArray[np.float64]:
        """WGS84 positions (..., 3) [deg, deg, m] of ENU (..., 3) [m]."""
        return enu_to_wgs84(enu, self.origin)


@dataclass(frozen=True)
class Tower:
    """The tower: an upright cylinder on the origin, which casts a shadow.

    Attributes
    ----------
    radius, height : float [m]
    """

    radius: float
    height: float

    def __post_init__(self) -> None:
        if not (0 < self.radius < 1e3 and 0 < self.height < 1e4):
            raise InvalidInputError("tower radius and height must be positive metres")

    def outline(self, sun: Vector) -> TargetPlane:
        """The upright rectangle that casts the tower's shadow under a ``sun`` (3,)."""
        level = np.array([sun[0], sun[1], 0.0])
        normal = level if np.linalg.norm(level) > 1e-9 else np.array([0.0, 1.0, 0.0])
        center = np.array([0.0, 0.0, self.height / 2])
        up = np.array([0.0, 0.0, 1.0])
        return TargetPlane("tower", center, normal, up, 2 * self.radius, self.height)
