"""Pylon bending: the pylon leans under the mirror, the more the farther its weight hangs out.

What it is
    Mirror and frame hang before the pivot, and their weight bends the pylon towards where the mirror faces. The moment
    goes with the horizontal lever of the centre of gravity: for a mirror that is balanced about its pivot but for its
    distance from it, with the horizontal part of the normal. A mirror that faces the zenith hangs over its pylon; one
    that stands upright pulls it over by ``amplitude_mrad``. The whole mount leans with it, so that the normal's
    elevation is lower than the drives say by amplitude * cos(elevation). A negative amplitude is that of a
    counterweight that is too heavy.

Source
    The end of a cantilever under a moment M turns by M L / E I, in the direction of the lever. Tilts of pedestals as
    systematic errors of tracking: Stone and Jones, *Analysis of Solar Two heliostat tracking error sources*,
    SAND99-0239C.

In an image
    Nothing but where it lies: with the spot brought back to its place a roll of less than the amplitude is left.

What it scales with
    The cosine of the normal's elevation, twice that angle times the slant range on the target, downwards. So it is the
    greatest under low suns, and the same for mirrors of one kind.

What it is confused with
    - An offset of the first drive's encoder: as much under every sun, and each heliostat's own.
    - Axis tilt: moves spots sidewards as well, by another way in the morning than in the afternoon.
    - A clock error: moves spots sidewards about noon, when the sun's path is level.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Effect, Factor, Stage, parameter
from model.mount import Mount


@dataclass(frozen=True, eq=False)
class PylonBending(Effect):
    """The pylon leans towards where an upright mirror faces by ``amplitude_mrad`` [mrad]."""

    name: ClassVar[str] = "pylon_bending"
    about: ClassVar[str] = "Pylon bending: the pylon leans under the mirror, the more the farther its weight hangs out."
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"elevation"})
    of_heliostats: ClassVar[bool] = True
    only_moves: ClassVar[bool] = True

    amplitude_mrad: float = parameter(0.0, -20.0, 20.0, "mrad")

    def on_mount(self, mount: Mount, heliostat: str) -> Mount:
        """Lean more."""
        return replace(mount, lean=mount.lean + 1e-3 * float(self.amplitude_mrad))
