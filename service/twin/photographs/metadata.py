"""Metadata of a photograph, as submitted, as stored, and as it could be sent; warnings of them.

Warnings are documents with ``type``, ``detail`` and figures.
"""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from model.ephemeris import SunContradiction, clock_faults
from model.frames import sun_direction, wgs84_to_enu
from model.imaging import ImageKind
from model.pointing import Weather
from model.times import format_time
from service.sources.photograph import IncomingPhotograph
from service.store.tables import NO_IMAGE, SUN_CONTRADICTS_TIME, MeasurementRow


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


Warnings = list[dict[str, object]]


def find_sun_contradictions(
    photographs: Sequence[IncomingPhotograph], origin: ArrayLike
) -> list[SunContradiction | None]:
    """Compare the recorded suns with their positions at the recorded times.

    None if they agree or the time is unknown. ``origin`` is the tower base in WGS84.
    """
    dated = [one for one in photographs if one.taken_at is not None]
    suns = [sun_direction(one.sun.azimuth_deg, one.sun.elevation_deg) for one in dated]
    moments = [one.taken_at for one in dated if one.taken_at is not None]
    temperatures = [one.weather.temperature_c for one in dated]
    faults = iter(clock_faults(np.array(suns), moments, origin, temperatures))
    return [None if one.taken_at is None else next(faults) for one in photographs]


def sun_warnings(contradiction: SunContradiction | None) -> Warnings:
    """The warning of a sun that contradicts its time, or none."""
    if contradiction is None:
        return []
    found = {"angle_deg": round(contradiction.angle_deg, 3), "clock_ahead_h": contradiction.ahead_h}
    return [{"type": SUN_CONTRADICTS_TIME, "detail": contradiction.detail, **found}]


def other_warnings(row: MeasurementRow, photograph: IncomingPhotograph) -> Warnings:
    """Stored warnings except the sun's.

    There are none if ``photograph`` has another sun or target, because they depend on these.
    """
    if (row.target.name, row.sun) != (photograph.target, photograph.sun):
        return []
    return [one for one in row.warnings or () if one["type"] != SUN_CONTRADICTS_TIME]


def sun_columns(
    row: MeasurementRow, photograph: IncomingPhotograph, contradiction: SunContradiction | None
) -> dict[str, object]:
    """The columns of a stored measurement that depend on its time and sun.

    Time and sun are those of ``photograph``, with their ``contradiction``, if any.
    """
    warnings = [*sun_warnings(contradiction), *other_warnings(row, photograph)]
    return {
        "quality": {**row.quality, "clock": contradiction and contradiction.detail},
        "warnings": warnings or None,
    }
