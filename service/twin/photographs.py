"""What is known of a photograph beside its image: as it was sent, as it is stored, and what of it may be corrected."""

from typing import Any, cast

from model.imaging import ImageKind
from model.pointing import Weather
from service.sources.photograph import Photograph
from service.store.tables import MeasurementRow


def told_of(photograph: Photograph) -> dict[str, Any]:
    """What was sent with an image, by REST's names, as JSON has it."""
    taken, motors = photograph.taken_at, photograph.motor_position
    return {
        "target_name": photograph.target_name,
        "sun_azimuth": photograph.sun_azimuth_deg,
        "sun_elevation": photograph.sun_elevation_deg,
        "taken_at": None if taken is None else taken.isoformat(),
        "motor_position": None if motors is None else [float(motor) for motor in motors],
    }


def values_of(row: MeasurementRow) -> dict[str, Any]:
    """The same of a stored measurement."""
    motors = (row.motor_axis_1, row.motor_axis_2)
    return {
        "target_name": row.target.name,
        "sun_azimuth": row.sun_azimuth_deg,
        "sun_elevation": row.sun_elevation_deg,
        "taken_at": None if row.taken_at is None else row.taken_at.isoformat(),
        "motor_position": None if None in motors else list(motors),
    }


def photograph_of(row: MeasurementRow) -> Photograph:
    """A stored measurement's photograph, as it could be sent."""
    return photograph_with(row, row.target.name)


def photograph_with(known: Any, target_name: str) -> Photograph:
    """The same of what has a measurement's columns, or a record of them."""
    motors = (known.motor_axis_1, known.motor_axis_2)
    spot, helios = known.focal_spot_wgs84, known.helios_spot_wgs84
    return Photograph(
        target_name=target_name,
        kind=cast(ImageKind, known.kind),
        sun_azimuth_deg=known.sun_azimuth_deg,
        sun_elevation_deg=known.sun_elevation_deg,
        external_id=known.external_id,
        taken_at=known.taken_at,
        motor_position=None if None in motors else cast(tuple[float, float], motors),
        focal_spot_wgs84=None if spot is None else tuple(spot),
        helios_spot_wgs84=None if helios is None else tuple(helios),
        corners=None if known.corners_px is None else known.corners_px["corners"],
        weather=Weather(known.wind_speed_m_s, known.wind_from_deg, known.temperature_c),
    )
