"""Photographs from outside: their metadata, and marks and crops of the Solar Tower Juelich.

Metadata come from a calibration system over HTTP or from a folder. PAINT publishes the photographs
of Juelich: the name of a target gives its layout of marks. The tower's upper and lower targets
share an edge. T bars are at the ends of that edge, and L brackets only at the corners of the pair.
The marks of the pair together locate either target. A separate target has four brackets.
"""

from dataclasses import dataclass, field
from datetime import datetime

from model.imaging import ImageKind
from model.imaging.rectify import BRACKETS, Layout, MarkPlace
from model.pointing import Weather
from service.base.fields import Sun


@dataclass(frozen=True)
class IncomingPhotograph:
    """Metadata of an incoming image; units as in `service.store.tables.MeasurementRow`.

    - ``kind`` is None if there is no image, only motors and a spot.
    - ``focal_spot_wgs84`` is the centroid that is used: by PAINT's method UTIS, otherwise by
      HeliOS.
    - ``helios_spot_wgs84`` is the centroid by HeliOS, which is kept for exports.
    - ``forced`` is the reason to accept an image that another heliostat already has.
    - ``corners`` are pixels (x, y) of the target's upper left, upper right, lower left, lower right
      corner.
    """

    target: str
    kind: ImageKind | None
    sun: Sun
    external_id: str | None = None
    taken_at: datetime | None = None
    motor_position: tuple[float, float] | None = None
    focal_spot_wgs84: tuple[float, float, float] | None = None
    helios_spot_wgs84: tuple[float, float, float] | None = None
    corners: tuple[tuple[float, float], ...] | None = None
    weather: Weather = field(default_factory=Weather)
    forced: str | None = None


CENTERED_WINDOW = 6.1
"""Side [m] of PAINT's ``flux-centered`` images, which are centered on the centroid.

Of 20 images that also have the whole target, the side that agrees best is 6.095 to 6.101 m.
"""

CENTERED_SIZE_ERROR = 0.01
"""Standard deviation [1] of that side, as it is not documented: a nuisance of refinement."""

_UPPER: Layout = (
    MarkPlace("L", 0, 0, 0),
    MarkPlace("L", 1, 1, 0),
    MarkPlace("T", 3, 0, 1),
    MarkPlace("T", 1, 1, 1),
    MarkPlace("T", 0, 0.5, 0),
    MarkPlace("L", 3, 0, 2),
    MarkPlace("L", 2, 1, 2),
    MarkPlace("T", 2, 0.5, 2),
)
# The lower target has the same marks, shifted up by one side; its own corners come first.
_LOWER: Layout = tuple(
    MarkPlace(place.kind, place.quarter, place.x, place.y - 1)
    for place in (*_UPPER[2:4], *_UPPER[5:7], *_UPPER[:2], _UPPER[4], _UPPER[7])
)


def mark_layouts(target_name: str) -> tuple[Layout, ...]:
    """Layouts of marks to try for a target, in order.

    The targets of a pair are named ``..._upper`` and ``..._lower``.
    """
    name = target_name.lower()
    if name.endswith("upper"):
        return _UPPER, BRACKETS
    if name.endswith("lower"):
        return _LOWER, BRACKETS
    return (BRACKETS,)
