"""Types of heliostats: mount, facets, canting and errors, from which each heliostat is made.

A plant has a few types and many heliostats. `HeliostatType.heliostat` places one of them: canting,
focal lengths and a target-aligned mount depend on where it is and what it aims at.

Mirror coordinates are x to the right seen from the front, y up the mirror and z out of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.actuator import Actuators
from model.errors import InvalidInputError
from model.frames import sun_direction
from model.mount import AxisName, Mount, bisector
from model.plant import PERFECT, REFERENCE_SINE, Facet, Heliostat, MirrorOptics, Outline

Array = NDArray[np.float64]

CIRCLE_CORNERS = 48
"""Corners of the polygon in place of a round facet; it has the circle's area."""

Size = tuple[float, float]
"""Width and height [m]."""

# --- mounts
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MountDesign:
    """The mount of a type.

    Attributes
    ----------
    kind : str
        A key of `MOUNT_KINDS`.
    pivot_height : float [m]
        Of both axes above the foot of the pylon.
    mirror_offset : float [m]
        From the pivot to the mirror's middle, along its normal.
    drives : pair of Actuator, or None
        None for axes whose drives are not known.
    axis_zero : (2,) [rad]
        Axis angles at which the drives' angles are zero.
    jitter_axis : "first" or "second"
        As of `model.mount.Mount`.
    """

    kind: str = "azimuth_elevation"
    pivot_height: float = 0.0
    mirror_offset: float = 0.0
    drives: Actuators | None = None
    axis_zero: tuple[float, float] = (0.0, 0.0)
    jitter_axis: AxisName = "first"

    def __post_init__(self) -> None:
        if self.kind not in MOUNT_KINDS:
            raise InvalidInputError(
                f"mount kind {self.kind!r} is none of {', '.join(sorted(MOUNT_KINDS))}"
            )

    def mount(self, foot: Array, aim: Array) -> Mount:
        """The mount of a heliostat whose pylon has its ``foot`` (3,) [m], aiming at ``aim`` (3,)
        [m].
        """
        joint = np.array([0.0, 0.0, self.pivot_height])
        frame = MOUNT_KINDS[self.kind](aim - foot - joint)
        return Mount(
            frame.first_axis,
            frame.second_axis,
            frame.zero_attitude,
            joint,
            np.array([0.0, 0.0, self.mirror_offset]),
            self.drives,
            axis_zero=self.axis_zero,
            jitter_axis=self.jitter_axis,
        )


class MountFrame(NamedTuple):
    """Axes (3,) in ENU and the mirror's attitude (3, 3) at zero angles, as of `Mount`."""

    first_axis: Array
    second_axis: Array
    zero_attitude: Array


def _azimuth_elevation(_: Array) -> MountFrame:
    mount = Mount.azimuth_elevation()
    return MountFrame(mount.first_axis, mount.second_axis, mount.zero_attitude)


def _pitch_roll(_: Array) -> MountFrame:
    """Pitch about the east axis, then roll about the mirror's own upward axis; zero faces the
    zenith.
    """
    return MountFrame(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.eye(3))


def _juelich(_: Array) -> MountFrame:
    mount = Mount.juelich()
    return MountFrame(mount.first_axis, mount.second_axis, mount.zero_attitude)


def _target_aligned(outgoing: Array) -> MountFrame:
    """Spin about the line to the target, then tilt about the mirror's x axis, across that line.

    At zero the mirror faces the target. Source: Zaibel, Dagan, Karni and Dorot, *An astigmatic
    corrected target-aligned heliostat for high concentration*, Solar Energy Materials and Solar
    Cells 37 (1995).
    """
    normal = outgoing / np.linalg.norm(outgoing)
    across = np.cross([0.0, 0.0, 1.0], normal)
    if np.linalg.norm(across) < 1e-6:
        across = np.array([1.0, 0.0, 0.0])
    across = across / np.linalg.norm(across)
    attitude = np.stack([across, np.cross(normal, across), normal], axis=-1)
    return MountFrame(normal, across, attitude)


MOUNT_KINDS: dict[str, Callable[[Array], MountFrame]] = {
    "azimuth_elevation": _azimuth_elevation,
    "pitch_roll": _pitch_roll,
    "juelich": _juelich,
    "target_aligned": _target_aligned,
}
"""The kinds of mounts; each makes its axes of the vector (3,) [m] from the pivot to the aim."""


# --- facets
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FacetDesign:
    """A facet of a type.

    Attributes
    ----------
    center : (3,) [m]
        In mirror coordinates.
    width, height : float [m]
        Of its bounding rectangle.
    outline : tuple of (x, y), or None
        As of `model.plant.Facet`.
    normal : (3,) or None
        Its unit normal in mirror coordinates; None if the type's canting gives it.
    focal_length : float or None [m]
        None if the type gives it.
    """

    center: Array
    width: float
    height: float
    outline: Outline | None = None
    normal: Array | None = None
    focal_length: float | None = None


def facet_grid(
    rows: int, columns: int, width: float, height: float, gap: float
) -> Sequence[FacetDesign]:
    """Equal facets in rows and columns; from the upper left, row by row.

    ``width``, ``height`` and ``gap`` [m] are those of a facet and between two of them.
    """
    x = (np.arange(columns) - (columns - 1) / 2) * (width + gap)
    y = ((rows - 1) / 2 - np.arange(rows)) * (height + gap)
    return tuple(FacetDesign(np.array([i, j, 0.0]), width, height) for j in y for i in x)


def circle_outline() -> Outline:
    """The outline of a round facet: a polygon of the circle's area."""
    angles = np.arange(CIRCLE_CORNERS) * 2 * np.pi / CIRCLE_CORNERS
    radius = np.sqrt(2 * np.pi / CIRCLE_CORNERS / np.sin(2 * np.pi / CIRCLE_CORNERS))
    return tuple((float(radius * np.cos(a)), float(radius * np.sin(a))) for a in angles)


# --- canting and focus
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Canting:
    """How the facets of a type are inclined.

    Attributes
    ----------
    kind : str
        - flat: all in one plane.
        - on_axis: to the focal length, by default the slant range.
        - off_axis: so that the facets' spots fall on each other under a sun of ``sun_deg``.
        - individual: each as its `FacetDesign.normal` says.
    focal_length : float or None [m]
        Of on-axis canting; None for the slant range.
    sun_deg : (azimuth, elevation) or None [deg]
        Of off-axis canting; azimuth from north over east.
    """

    kind: Literal["flat", "on_axis", "off_axis", "individual"] = "on_axis"
    focal_length: float | None = None
    sun_deg: tuple[float, float] | None = None


Focus = float | Literal["flat", "slant_range"]
"""Focal length [m] of facets, flat ones, or those focused to the slant range."""


@dataclass(frozen=True, eq=False)
class HeliostatType:
    """What the heliostats of one type have in common.

    Attributes
    ----------
    name : str
    mount : MountDesign
    facets : tuple of FacetDesign
    focus : float [m], "flat" or "slant_range"
    canting : Canting
    optics : MirrorOptics
    reference_sine : float
        As of `model.plant.Heliostat`.
    """

    name: str
    facets: Sequence[FacetDesign]
    mount: MountDesign = field(default_factory=MountDesign)
    focus: Focus = "flat"
    canting: Canting = Canting()
    optics: MirrorOptics = PERFECT
    reference_sine: float = REFERENCE_SINE

    def __post_init__(self) -> None:
        if not self.facets:
            raise InvalidInputError(f"heliostat type {self.name} has no facets")
        if self.canting.kind == "individual" and any(f.normal is None for f in self.facets):
            raise InvalidInputError(
                f"heliostat type {self.name}: individual canting needs each facet's normal"
            )

    @property
    def size(self) -> Size:
        """Width and height [m] of the rectangle that bounds the whole mirror."""
        reach = [(abs(f.center[:2]) + np.array([f.width, f.height]) / 2) for f in self.facets]
        width, height = 2 * np.max(reach, axis=0)
        return float(width), float(height)

    def heliostat(
        self, name: str, foot: ArrayLike, aim: ArrayLike, focal_length: float | None = None
    ) -> Heliostat:
        """A heliostat of this type.

        Parameters
        ----------
        name : str
        foot, aim : array_like (3,) [m]
            Of its pylon, and what it is canted and focused to, in ENU.
        focal_length : float, optional [m]
            In place of the slant range.
        """
        position, goal = (np.asarray(point, dtype=np.float64) for point in (foot, aim))
        mount = self.mount.mount(position, goal)
        slant_range = focal_length or float(np.linalg.norm(goal - position - mount.joint))
        normals = self._normals(mount, position, goal, slant_range)
        # The x axes of facets have no y component.
        across = _unit(np.stack([normals[:, 2], 0 * normals[:, 1], -normals[:, 0]], axis=-1))
        upward = np.cross(normals, across)
        facets = tuple(
            Facet(
                design.center,
                design.width / 2 * x,
                design.height / 2 * y,
                self._focal_length(design, slant_range),
                design.outline,
            )
            for design, x, y in zip(self.facets, across, upward, strict=True)
        )
        width, height = self.size
        return Heliostat(
            name, position, mount, facets, width, height, self.optics, self.reference_sine
        )

    def _focal_length(self, design: FacetDesign, slant_range: float) -> float | None:
        if design.focal_length is not None:
            return design.focal_length
        if self.focus == "slant_range":
            return slant_range
        return None if self.focus == "flat" else float(self.focus)

    def _normals(self, mount: Mount, foot: Array, aim: Array, slant_range: float) -> Array:
        """Unit normals (F, 3) of the facets in mirror coordinates."""
        centers = np.array([design.center for design in self.facets], dtype=np.float64)
        normals = np.tile([0.0, 0.0, 1.0], (len(centers), 1))
        if self.canting.kind == "on_axis":
            # Halfway between the axis and the direction to the focus.
            focus = np.array([0.0, 0.0, self.canting.focal_length or slant_range])
            normals = _unit(_unit(focus - centers) + normals)
        elif self.canting.kind == "off_axis":
            sun = sun_direction(*(self.canting.sun_deg or (180.0, 45.0)))
            attitude = mount.attitude(mount.align(foot, sun, aim))
            places = mount.mirror_center(foot, attitude) + centers @ attitude.T
            normals = _unit(bisector(np.broadcast_to(sun, places.shape), aim - places)) @ attitude
        for row, design in enumerate(self.facets):
            if design.normal is not None:
                normals[row] = _unit(np.asarray(design.normal, dtype=np.float64))
        return normals


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
