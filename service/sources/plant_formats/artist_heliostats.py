"""Heliostats of ARTIST: joints of its rigid body, which mount that is, and mirrors.

A mirror lies with its normal up, x east and y north. It is turned to face south, and then by::

    R_n(tilt_n) R_u(tilt_u) T(first) R_e(angle 1) R_e(tilt_e) R_n(tilt_n) T(second) R_u(angle 2)
    T(concentrator)

The first axis is east and the second is the mirror's upward axis: a mount of kind ``pitch_roll``.
A first tilt of a quarter turn makes the first axis upright. The mirror lies on its side then, and
the mount is ``azimuth_elevation``.

Mirrors are flat facets, paraboloids, or measured surfaces. ARTIST's facets have a place, half sides
and control points. If all heights of a mirror are zero, ARTIST moves and cants the facets.
Otherwise the control points are in mirror coordinates.

Source: ARTIST 2.0, ``artist.field.kinematics_rigid_body`` and ``artist.geometry.transforms``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.mount import Mount
from model.plant import Facet, Heliostat
from model.surface import DEGREE, control_points, evaluate, heights, nominal_heights
from service.sources.folder import MeasuredSurface
from service.sources.plant_formats.imported import MAX_FOCUS, FacetedMirror, facet_axes

Array = NDArray[np.float64]

TRANSLATIONS = tuple(
    f"{part}_translation_{axis}"
    for part in ("first_joint", "second_joint", "concentrator")
    for axis in "enu"
)
TILTS = ("first_joint_tilt_n", "first_joint_tilt_u", "second_joint_tilt_e", "second_joint_tilt_n")

ON_ITS_SIDE = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Our mirror coordinates to ARTIST's, of a mirror whose second axis is its x."""

_QUARTER = np.pi / 2
_SAME_RAD = 1e-6


def first_tilt(tilt_n: float, tilt_u: float) -> Array:
    """The rotation (3, 3) of the first joint in ENU; about north it is left-handed, as ARTIST's."""
    c, s = np.cos(tilt_n), np.sin(tilt_n)
    north = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    c, s = np.cos(tilt_u), np.sin(tilt_u)
    return np.asarray(north @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A rigid body as a mount.

    Attributes
    ----------
    kind : str
        ``pitch_roll`` or ``azimuth_elevation``.
    joint : (3,) [m]
        From the heliostat's position to the pivot, in ENU.
    mirror_offset : float [m]
        From the pivot to the mirror's middle along its normal.
    left_out : mapping
        Deviations [m], [rad] that no mount of plant.yaml has, by name.
    """

    kind: str
    joint: Array
    mirror_offset: float
    left_out: Mapping[str, float]

    @property
    def mirror(self) -> Array:
        """Our mirror coordinates to ARTIST's (3, 3)."""
        return ON_ITS_SIDE if self.kind == "azimuth_elevation" else np.eye(3)


def rigid_body(deviations: Mapping[str, float]) -> RigidBody:
    """The mount of a rigid body with these deviations [m], [rad]."""
    is_upright = abs(deviations["first_joint_tilt_n"] - _QUARTER) < _SAME_RAD
    tilts = {name: deviations[name] for name in TILTS}
    turn = np.eye(3)
    if is_upright:
        del tilts["first_joint_tilt_n"]
        turn = first_tilt(_QUARTER, 0.0)
    first = np.array([deviations[f"first_joint_translation_{axis}"] for axis in "enu"])
    shifts = {name: deviations[name] for name in TRANSLATIONS[3:]}
    offset = -shifts.pop("concentrator_translation_n")
    left_out = {name: value for name, value in {**tilts, **shifts}.items() if abs(value) > 1e-9}
    kind = "azimuth_elevation" if is_upright else "pitch_roll"
    return RigidBody(kind, turn @ first, offset, left_out)


def deviations_of(kind: str, pivot_height: float, mirror_offset: float) -> dict[str, float]:
    """The deviations [m], [rad] of a mount; the reverse of `rigid_body`."""
    found = dict.fromkeys((*TRANSLATIONS, *TILTS), 0.0)
    found["concentrator_translation_n"] = -mirror_offset
    if kind == "azimuth_elevation":
        found["first_joint_tilt_n"] = _QUARTER
        found["first_joint_translation_e"] = pivot_height
    else:
        found["first_joint_translation_u"] = pivot_height
    return found


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
