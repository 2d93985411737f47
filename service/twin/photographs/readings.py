"""Stored measurements as readings of the pointing: motor positions, sun and spot."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError, ModelError
from model.frames import sun_direction
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.pointing import Reading, Weather
from model.pointing.report import day_of
from service import store
from service.store.tables import MeasurementRow
from service.twin.measurements import spot_position
from service.twin.stored_mount import true_sun

Array = NDArray[np.float64]

MAX_CUT = 0.1
"""Largest share of a spot's light off the target for a valid centre.

Up to this share, the centre of the visible part is used as the spot's centre.
"""


class StoredReadings(NamedTuple):
    """Readings, and the reasons for unusable measurements by identifier."""

    usable: list[Reading]
    unusable: dict[str, str]


def load_readings(
    heliostat: Heliostat,
    rows: Sequence[MeasurementRow],
    model: PlantModel,
    targets: Mapping[str, TargetPlane],
) -> StoredReadings:
    """Convert measurements to readings of a mount under the model's sun."""
    readings, useless = [], {}
    for row in rows:
        try:
            plane = store.target_plane(row.target)
            readings.append(reading_of(heliostat, row, model, plane, targets.values()))
        except ModelError as error:
            useless[row.identifier] = str(error)
    return StoredReadings(readings, useless)


def reading_of(
    heliostat: Heliostat,
    row: MeasurementRow,
    model: PlantModel,
    plane: TargetPlane,
    targets: Iterable[TargetPlane],
) -> Reading:
    """The reading of a measurement on ``plane``, one of the ``targets``.

    Raises
    ------
    InvalidInputError
        If motor positions or the spot are missing or impossible.
    """
    spot, motors = spot_position(row, plane, model.site.origin), motors_of(heliostat, row)
    if spot is None:
        raise InvalidInputError("no place of its spot on the target")
    require_on_target(spot, targets)
    if float(row.quality.get("cut_share") or 0) > MAX_CUT:
        raise InvalidInputError(
            "its spot runs over the target's edge, and where the centre of all of it lies is unseen"
        )
    sun = true_sun(model, sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg), row.taken_at)
    day = day_of(row.taken_at)
    return Reading(row.identifier, plane.name, motors, sun, spot, day, Weather.of(row))


def motors_of(heliostat: Heliostat, row: MeasurementRow) -> Array:
    """Motor positions (2,) [steps] within the drives' travel."""
    if row.motor_axis_1 is None or row.motor_axis_2 is None:
        raise InvalidInputError("no motor_position")
    motors = np.array([row.motor_axis_1, row.motor_axis_2])
    heliostat.mount.require_within(motors)
    return motors


# Tolerance [m] of a spot's distance from a target's plane and edge, for rounding and survey errors.
_OFF_M = 0.5


def require_on_target(spot: Array, targets: Iterable[TargetPlane]) -> None:
    """Raise InvalidInputError if a submitted spot (3,) [m] is not on any target."""
    if not any(_is_on_target(plane, spot) for plane in targets):
        raise InvalidInputError("the focal spot lies off every target")


def _is_on_target(plane: TargetPlane, spot: Array) -> bool:
    aside = np.abs(plane.to_plane(spot)) - np.array([plane.width, plane.height]) / 2
    return bool((aside < _OFF_M).all() and abs((spot - plane.center) @ plane.normal) < _OFF_M)
