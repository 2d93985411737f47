"""Metadata of a photograph: as submitted, as stored, and as it could be sent."""

from collections.abc import Sequence
from typing import Any, cast

from model.frames import wgs84_to_enu
from model.imaging import ImageKind
from model.pointing import Weather
from model.times import format_time
from service.sources.photograph import IncomingPhotograph
from service.store.tables import NO_IMAGE, MeasurementRow


def spot_m(wgs84: Sequence[float] | None, origin: tuple[float, float, float]) -> list[float] | None:
    """A spot (3,) east, north, up of the tower base [m], to a micrometre; None if unknown."""
    return None if wgs84 is None else wgs84_to_enu(wgs84, origin).round(6).tolist()


def submitted_metadata(photograph: IncomingPhotograph) -> dict[str, object]:
    """Metadata that was sent with an image, by paths of REST fields, as JSON values."""
    taken, motors = photograph.taken_at, photograph.motor_position
    return {
        "target": photograph.target,
        "sun.azimuth_deg": photograph.sun.azimuth_deg,
        "sun.elevation_deg": photograph.sun.elevation_deg,
        "taken_at": None if taken is None else format_time(taken),
        "motor_position": None if motors is None else [float(motor) for motor in motors],
    }


def stored_metadata(row: MeasurementRow) -> dict[str, object]:
    """The same metadata of a stored measurement."""
    return submitted_metadata(photograph_from_row(row))


def metadata_columns(photograph: IncomingPhotograph) -> dict[str, object]:
    """Columns of a measurement's row that a correction may change, but for the target."""
    motors = photograph.motor_position or (None, None)
    return {
        "sun_azimuth_deg": photograph.sun.azimuth_deg,
        "sun_elevation_deg": photograph.sun.elevation_deg,
        "taken_at": photograph.taken_at,
        "motor_axis_1": motors[0],
        "motor_axis_2": motors[1],
        **vars(photograph.weather),
    }


def photograph_from_row(row: MeasurementRow) -> IncomingPhotograph:
    """The photograph of a stored measurement, as it could be sent."""
    return photograph_with_target(row, row.target.name)


def photograph_with_target(known: Any, target: str) -> IncomingPhotograph:
    """The photograph of an object with a measurement's columns, such as a history record."""
    motors = (known.motor_axis_1, known.motor_axis_2)
    spot, helios = known.focal_spot_wgs84, known.helios_spot_wgs84
    return IncomingPhotograph(
        target=target,
        kind=None if known.kind == NO_IMAGE else cast(ImageKind, known.kind),
        sun=known.sun,
        external_id=known.external_id,
        taken_at=known.taken_at,
        motor_position=None if None in motors else cast(tuple[float, float], motors),
        focal_spot_wgs84=None if spot is None else tuple(spot),
        helios_spot_wgs84=None if helios is None else tuple(helios),
        corners=None if known.corners_px is None else known.corners_px["corners"],
        weather=Weather.of(known),
        forced=known.forced,
    )
