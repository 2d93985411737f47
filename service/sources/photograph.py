"""Metadata of a photograph, from a calibration system over HTTP or from a folder."""

from dataclasses import dataclass, field
from datetime import datetime

from model.imaging import ImageKind
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
