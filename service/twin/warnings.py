"""Warnings of measurements: documents with ``type``, ``detail`` and figures."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from model.ephemeris import SunContradiction, clock_faults
from model.frames import sun_direction
from service.sources.photograph import IncomingPhotograph
from service.store.tables import SUN_CONTRADICTS_TIME, MeasurementRow

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
