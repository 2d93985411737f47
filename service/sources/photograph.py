"""What the sender of an image says of it, whoever sends it: a calibration system over HTTP, or a folder."""

from dataclasses import dataclass, field
from datetime import datetime

from model.imaging import ImageKind
from model.pointing import Weather


@dataclass(frozen=True)
class Photograph:
    """What is known of an image that comes in; units as in `service.store.tables.MeasurementRow`.

    ``focal_spot_wgs84`` is what is used: where PAINT's method UTIS found the spot's centre of mass, else HeliOS;
    ``helios_spot_wgs84``, which is kept for an export, is HeliOS's own.
    ``corners``: pixels (x, y) of the target's upper left, upper right, lower left, lower right corner.
    """

    target_name: str
    kind: ImageKind
    sun_azimuth_deg: float
    sun_elevation_deg: float
    external_id: str | None = None
    taken_at: datetime | None = None
    motor_position: tuple[float, float] | None = None
    focal_spot_wgs84: tuple[float, float, float] | None = None
    helios_spot_wgs84: tuple[float, float, float] | None = None
    corners: tuple[tuple[float, float], ...] | None = None
    weather: Weather = field(default_factory=Weather)
