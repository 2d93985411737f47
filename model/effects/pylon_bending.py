"""Pylon bending: the pylon leans under the mirror, more if its weight is far out.

What it is
    Mirror and frame are in front of the pivot, and their weight bends the pylon towards the
    direction that the mirror faces. The moment is proportional to the horizontal lever of the
    centre of gravity. If only the mirror's distance from the pivot is unbalanced, this lever is
    proportional to the horizontal part of the normal. A mirror that faces the zenith
    is above its pylon; a vertical one bends it by ``amplitude_mrad``. The whole mount leans with
    the pylon, so the normal's elevation is lower than the drives show by amplitude *
    cos(elevation). The amplitude is negative if a counterweight is too heavy.

Source
    The end of a cantilever under a moment M turns by M L / E I, in the direction of the lever.
    Tilts of pedestals as systematic errors of tracking: Stone and Jones, *Analysis of Solar Two
    heliostat tracking error sources*, SAND99-0239C.

In an image
    Only the spot's position: after the alignment to the spot, a roll of less than the amplitude is
    left.

What it scales with
    The cosine of the normal's elevation. The spot moves down by twice that angle times the slant
    range. So it is largest for low suns, and the same for mirrors of one type.

What it is confused with
    - An offset of the first drive's encoder: the same for every sun, and different for each
      heliostat.
    - Axis tilt: moves spots sideways as well, differently in the morning and in the afternoon.
    - A clock error: moves spots sideways about noon, when the sun's path is level.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from model.effects.base import Effect, Factor, Stage, parameter
from model.mount import Mount


@dataclass(frozen=True, eq=False)
class PylonBending(Effect):
    """The pylon of a vertical mirror leans by ``amplitude_mrad`` [mrad] to its front."""

    name: ClassVar[str] = "pylon_bending"
    about: ClassVar[str] = (
        "Pylon bending: the pylon leans under the mirror, more if its weight lies far out."
    )
    stage: ClassVar[Stage] = "geometry"
    scales_with: ClassVar[frozenset[Factor]] = frozenset({"elevation"})
    of_heliostats: ClassVar[bool] = True
    only_moves: ClassVar[bool] = True

    amplitude_mrad: float = parameter(0.0, -20.0, 20.0, "mrad")

    def on_mount(self, mount: Mount, heliostat: str) -> Mount:
        """Add the bending to the mount's lean."""
        return replace(mount, lean=mount.lean + 1e-3 * float(self.amplitude_mrad))
