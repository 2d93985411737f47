"""Mirrors of ARTIST: flat facets, paraboloids, or measured surfaces.

ARTIST's facets have a place, half sides and control points. If all heights of a mirror are zero,
ARTIST moves and cants the facets. Otherwise the control points are in mirror coordinates.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.mount import Mount
from model.plant import Facet, Heliostat
from model.surface import DEGREE, control_points, evaluate, heights, nominal_heights
from service.sources.folder import MeasuredSurface
from service.sources.plant_formats.mirror_design import MAX_FOCUS, FacetedMirror, facet_axes

Array = NDArray[np.float64]

# Differences within which a mirror is as designed; ARTIST's files are in single precision.
_SAME_HEIGHT = 2e-6  # [m], of deviations from a plane or a paraboloid
_SAME_PLACE = 1e-4  # [m], of points
_TURNED = 1e-3  # slope of a facet's horizontal side within the mirror


class ArtistMirror(NamedTuple):
    """The facets of a mirror, and its surface if they are neither flat nor paraboloids."""

    facets: FacetedMirror
    surface: MeasuredSurface | None

    @classmethod
    def of(
        cls, centers: Array, sides: Array, surface: MeasuredSurface, turn: Array
    ) -> "ArtistMirror":
        """The mirror of ARTIST's numbers; ``turn`` (3, 3) leads from our coordinates to ARTIST's.

        The control points of ``surface`` are (F, I, J, 3) [m] with I along x and J along y.

        Raises
        ------
        InvalidInputError
            If sides span nothing, or a facet is turned in the mirror's plane.
        """
        points = surface.points
        lengths = np.linalg.norm(sides, axis=-1)
        if not ((lengths > 0.005) & (lengths < 50)).all():
            raise InvalidInputError("'canting' must be half sides of 0.005 to 50 m")
        if not np.abs(points[..., 2]).max() > 0:
            axes = facet_axes(sides)
            points = centers[:, None, None] + np.einsum("fijc,fcd->fijd", points, axes)
        if turn[0, 0] == 0:
            sides = np.stack([-sides[:, 1], sides[:, 0]], axis=1)
        centers, sides, points = centers @ turn, sides @ turn, _ordered(points @ turn)
        across = np.abs(sides[:, 0, 1]) / lengths.max()
        if across.max() > _TURNED or (sides[:, [0, 1], [0, 1]] <= 0).any():
            raise InvalidInputError(
                "'canting' has a facet that is turned in the mirror's plane; plant.yaml's have"
                " their sides along x and y"
            )
        surface = surface._replace(points=points)
        powers = _powers(centers, sides, surface)
        if powers is None:
            return cls(FacetedMirror(centers, sides, np.zeros(len(centers))), surface)
        return cls(FacetedMirror(centers, sides, powers), None)


def _ordered(points: Array) -> Array:
    """Control points (F, I, J, 3) with I along x and J along y."""
    along = (points[:, -1] - points[:, 0]).mean(axis=(0, 1))
    if abs(along[1]) > abs(along[0]):
        points = points.swapaxes(1, 2)
    if (points[:, -1] - points[:, 0])[..., 0].mean() < 0:
        points = points[:, ::-1]
    if (points[:, :, -1] - points[:, :, 0])[..., 1].mean() < 0:
        points = points[:, :, ::-1]
    return points


def _powers(centers: Array, sides: Array, surface: MeasuredSurface) -> Array | None:
    """Powers (F,) [1/m] of the paraboloids that facets are; None if there are none."""
    facets = tuple(Facet(c, s[0], s[1]) for c, s in zip(centers, sides, strict=True))
    flat = Heliostat("mirror", np.zeros(3), Mount.azimuth_elevation(), facets)
    z = heights(flat, *surface)
    # Heights of paraboloids of focal length one.
    unit = _focused(flat, 1.0)
    powers = (unit * z).sum(axis=(1, 2)) / (unit**2).sum(axis=(1, 2))
    powers[np.abs(powers) < 1 / MAX_FOCUS] = 0.0
    fitted = powers[:, None, None] * unit
    # Over the paraboloid's vertex; a spline's parameters are not its places.
    above = [
        _above(flat, points, degree, powers)
        for points, degree in (surface[:2], (control_points(flat, fitted), DEGREE))
    ]
    corners = [
        points[:, [0, -1]][:, :, [0, -1]] for points in (surface.points, control_points(flat))
    ]
    is_measured = bool(
        np.abs(z - fitted).max() > _SAME_HEIGHT
        or np.ptp(above[0], axis=(1, 2)).max() > 2 * _SAME_HEIGHT
        # Our facets' mean is at their place, others' vertex.
        or np.minimum(np.abs(above[0] - above[1]), np.abs(above[0])).max() > _SAME_PLACE
        or np.abs(corners[0] - corners[1])[..., :2].max() > _SAME_PLACE
        or (powers < 0).any()
    )
    return None if is_measured else powers


def _above(mirror: Heliostat, points: Array, degree: int, powers: Array) -> Array:
    """Heights (F, 9, 9) [m] of splines over the paraboloids (F,) at their places."""
    edges = np.linspace(0, 1, 9)
    centers, axes, _ = mirror.facet_frames
    places = evaluate(points, edges, edges, degree).points - centers[:, None, None]
    x, y, z = np.moveaxis(np.einsum("fnmd,fcd->fnmc", places, axes), -1, 0)
    return np.asarray(z - (x**2 + y**2) * powers[:, None, None] / 4)


def _focused(mirror: Heliostat, focal_length: float) -> Array:
    """Heights (F, 8, 8) [m] of a mirror whose facets have a focal length [m]."""
    facets = tuple(replace(facet, focal_length=focal_length) for facet in mirror.facets)
    return nominal_heights(replace(mirror, facets=facets))
