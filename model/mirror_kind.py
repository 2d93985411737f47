"""Kinds of mirrors: what a network was trained for, and which heliostats have such mirrors."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.images import FLUX_WINDOW
from model.mount import Mount
from model.plant import Heliostat

Array = NDArray[np.float64]

TOLERANCE = 0.2
"""Difference of facets' sides and places, relative to the side, within one kind."""

MAX_AXIS_TILT_DEG = 10.0
"""Angle between a mount's first axis and the vertical or east up to which it counts as such."""

AXES = ("vertical", "east", "other")
"""First axes of mounts: they decide how an image rolls with the sun."""


@dataclass(frozen=True, eq=False)
class MirrorKind:
    """Mirrors of the same facets on the same mount.

    Attributes
    ----------
    centers : (F, 2) [m]
        Of the facets, in mirror coordinates.
    half_sizes : (F, 2) [m]
        Half sides of the facets.
    first_axis : str
        One of `AXES`.
    windows : tuple of float [m]
        Widths of the flux images.
    name : str
        Of the heliostat type.
    """

    centers: Array
    half_sizes: Array
    first_axis: str
    windows: tuple[float, ...] = (FLUX_WINDOW,)
    name: str = "juelich"

    @classmethod
    def of(
        cls, heliostat: Heliostat, windows: tuple[float, ...] = (FLUX_WINDOW,), name: str = ""
    ) -> "MirrorKind":
        """The kind of a heliostat's mirror."""
        frames = heliostat.facet_frames
        axis = first_axis_of(heliostat.mount)
        return cls(frames.centers[:, :2], frames.half_sizes, axis, windows, name)

    @classmethod
    def from_json(cls, values: Any) -> "MirrorKind":
        """Read the form of `to_json`.

        Raises
        ------
        InvalidInputError
            If a key is missing, or a value is of the wrong form.
        """
        try:
            centers, half_sizes = (
                np.array(values[key], dtype=np.float64).reshape(-1, 2)
                for key in ("facet_centers_m", "facet_half_sizes_m")
            )
            windows = tuple(float(window) for window in values["windows_m"])
            kind = cls(centers, half_sizes, str(values["first_axis"]), windows, values["type"])
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(
                f"mirrors: must have type, facet_centers_m, facet_half_sizes_m, first_axis and"
                f" windows_m ({type(error).__name__}: {error})"
            ) from error
        if len(centers) != len(half_sizes) or not len(centers):
            raise InvalidInputError(
                f"mirrors: {len(centers)} facet_centers_m and {len(half_sizes)} facet_half_sizes_m;"
                " write as many of both, one or more"
            )
        return kind

    def to_json(self) -> dict[str, Any]:
        """For a model card."""
        return {
            "type": self.name,
            "facet_centers_m": self.centers.round(4).tolist(),
            "facet_half_sizes_m": self.half_sizes.round(4).tolist(),
            "first_axis": self.first_axis,
            "windows_m": list(self.windows),
        }

    def has_facets_of(self, heliostat: Heliostat) -> bool:
        """Whether a heliostat has as many facets, of about the same sizes and places."""
        frames = heliostat.facet_frames
        if frames.half_sizes.shape != self.half_sizes.shape:
            return False
        sizes = np.abs(frames.half_sizes / self.half_sizes - 1)
        places = np.abs(frames.centers[:, :2] - self.centers) / (2 * self.half_sizes)
        return bool(sizes.max() <= TOLERANCE and places.max() <= TOLERANCE)

    def includes(self, heliostat: Heliostat) -> bool:
        """Whether a heliostat has such facets on such a mount."""
        return self.has_facets_of(heliostat) and first_axis_of(heliostat.mount) == self.first_axis


def first_axis_of(mount: Mount) -> str:
    """The first axis of a mount, one of `AXES`; calibrated axes are tilted a little."""
    least = np.cos(np.radians(MAX_AXIS_TILT_DEG))
    east, _, up = np.abs(np.asarray(mount.first_axis, dtype=np.float64))
    return "vertical" if up >= least else "east" if east >= least else "other"


def mirror_order(heliostat: Heliostat) -> list[int] | None:
    """The facet at the mirrored place of each facet, with left and right exchanged.

    None for mirrors that are not symmetric, or whose facets have outlines.
    """
    frames = heliostat.facet_frames
    places = frames.centers[:, :2]
    apart = np.linalg.norm(places[:, None] * [-1, 1] - places, axis=-1)
    order = apart.argmin(axis=1)
    near = apart.min(axis=1) <= TOLERANCE * frames.half_sizes.min()
    alike = np.abs(frames.half_sizes[order] / frames.half_sizes - 1).max() <= TOLERANCE
    rectangular = all(facet.outline is None for facet in heliostat.facets)
    if not (near.all() and alike and rectangular and len(set(order.tolist())) == len(order)):
        return None
    return [int(place) for place in order]
