"""What the store knows of a heliostat, as the model takes it: mirrors, observations, photographs."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from model.forecast import Shot
from model.frames import sun_direction, wgs84_to_enu
from model.observation import Observation, spread_suns
from model.plant import Heliostat, TargetPlane
from model.study import Photograph
from service import store
from service.base.arrays import unpack
from service.base.faults import ConflictError
from service.sources.documents import read_heliostat
from service.store.tables import HeliostatRow, MeasurementRow

CENTERED_SIDE = 4.0
"""Side [m] of a measurement's ``centered`` flux, all that there is of a photograph that shows no more."""


def photograph_of(
    row: MeasurementRow, heliostat: Heliostat, points: np.ndarray[Any, Any], origin: tuple[float, float, float]
) -> Photograph:
    """An accepted measurement, loaded with its arrays, as a study compares it; ``points`` (F, I, J, 3) [m]."""
    image, plane = _flux(row, origin)
    shot = Shot(
        heliostat,
        points,
        sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg),
        plane,
        spot=spot_of(row, store.target_plane(row.target), origin),
        identifier=f"{heliostat.name}/{row.identifier}",
    )
    return Photograph(shot, image, taken_at=row.taken_at)


def _flux(row: MeasurementRow, origin: tuple[float, float, float]) -> tuple[np.ndarray[Any, Any], TargetPlane]:
    """The flux over the whole target, or over the crop that is all there is."""
    plane, arrays = store.target_plane(row.target), unpack(row.arrays or b"")
    if "flux" in arrays:
        return arrays["flux"].astype(np.float64), plane
    if row.focal_spot_wgs84 is None:
        raise InvalidInputError("a centred flux without 'focal_spot' has no place on the target")
    spot = spot_of(row, plane, origin)
    if (np.abs(plane.to_plane(spot)) > np.array([plane.width, plane.height]) / 2).any():
        raise InvalidInputError(f"'focal_spot' lies off its target {plane.name}")
    crop = replace(plane, center=spot, width=CENTERED_SIDE, height=CENTERED_SIDE)
    return arrays["centered"].astype(np.float64), crop


# The newest measurements, this many times as many as are wanted, stand for the mirror's present state; those that
# are used are chosen among them for variety of the sun's position.
_RECENT = 4


def load_heliostat(session: Session, row: HeliostatRow) -> Heliostat:
    """The model's heliostat of a stored one."""
    return read_heliostat(row.name, row.properties, np.array(store.get_plant(session).origin))


def choose_measurements(
    session: Session,
    heliostat: HeliostatRow,
    count: int,
    since: datetime | None = None,
    until: datetime | None = None,
) -> list[MeasurementRow]:
    """Up to ``count`` accepted measurements of a time: recent, and with the sun at different places.

    Raises
    ------
    ConflictError
        Where the heliostat has none.
    """
    recent = store.recent_measurements(session, heliostat, _RECENT * count, since, until)
    if not recent and (since or until):
        raise ConflictError(f"heliostat {heliostat.name} has no accepted measurement of this time")
    if not recent:
        raise ConflictError(f"heliostat {heliostat.name} has no accepted measurement; post target images of it first")

    suns = sun_direction([row.sun_azimuth_deg for row in recent], [row.sun_elevation_deg for row in recent])
    return [recent[index] for index in spread_suns(suns, count)]


def named_measurements(session: Session, heliostat: HeliostatRow, names: Sequence[str]) -> list[MeasurementRow]:
    """Accepted measurements by their identifiers, with their arrays; ConflictError where one was refused."""
    rows = [store.get_measurement(session, heliostat, name, arrays=True) for name in dict.fromkeys(names)]
    for row in rows:
        if not row.accepted or row.arrays is None:
            raise ConflictError(f"measurements: {row.identifier} was refused ({row.reason}); choose accepted ones")
    return rows


def spot_of(row: MeasurementRow, plane: TargetPlane, origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """Centre of mass in ENU: as measured, else as it was given, else the target's centre."""
    if row.center_right_m is not None and row.center_up_m is not None:
        return plane.to_enu((row.center_right_m, row.center_up_m))
    if row.focal_spot_wgs84 is not None:
        return wgs84_to_enu(row.focal_spot_wgs84, origin)
    return np.array(plane.center)


def observation_of(row: MeasurementRow, origin: tuple[float, float, float]) -> Observation:
    """What an accepted measurement, loaded with its arrays, shows the model."""
    plane = store.target_plane(row.target)
    motors = (row.motor_axis_1, row.motor_axis_2)
    return Observation(
        flux=unpack(row.arrays or b"")["centered"],
        sun=sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg),
        center_of_mass=spot_of(row, plane, origin),
        target=plane,
        motor_position=None if None in motors else np.array(motors),
        identifier=row.identifier,
    )
