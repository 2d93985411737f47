"""Mounts of stored heliostats: calibrated from stored photographs, and which photographs to take next."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.effects import Effect
from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError, ModelError
from model.frames import sun_direction
from model.plant import Heliostat
from model.pointing import CalibratedMount, FieldMounts, Reading, calibrate_field, days_by_order
from model.pointing.plan import Proposal, best_sun, plan
from model.pointing.report import clock_to_json, day_of, mount_to_json
from service import store
from service.base.faults import ConflictError
from service.store import mounts
from service.store.columns import now
from service.store.tables import HeliostatRow, MeasurementRow, MountRow
from service.twin import versions
from service.twin.evidence import spot_of
from service.twin.mounted import load_mount, mount_of, true_sun, with_drives
from service.twin.photographs import photograph_of
from service.twin.runtime import Runtime

Array = NDArray[np.float64]

MOST_CUT = 0.1
"""Share of a spot's light beside the target up to which the centre of what is seen is that of the spot."""


@dataclass(frozen=True, eq=False)
class StoreMounts:
    """Mounts that are not kept yet, and what was left out of heliostats and measurements with the reasons.

    ``effects`` are those of the plant's model.
    """

    done: FieldMounts
    skipped: dict[str, str]
    effects: Sequence[Effect]


def calibrate_store(
    runtime: Runtime, names: Sequence[str], since: datetime | None = None, until: datetime | None = None
) -> StoreMounts:
    """Mounts of stored heliostats from photographs of a time, by the prior that all heliostats of the store make.

    Raises
    ------
    ConflictError
        Where none has a measurement with motors and a spot.
    """
    wanted = set(names)
    with runtime.database.reading() as session:
        origin, effects = store.get_plant(session).origin, versions.get_model(session).effects
        targets = {row.name: store.target_plane(row) for row in store.list_targets(session)}
        rows = {row.name: row for row in session.scalars(select(HeliostatRow).order_by(HeliostatRow.name))}
        useless = {name: f"there is no heliostat {name}" for name in names if name not in rows}
        heliostats: dict[str, Heliostat] = {}
        readings: dict[str, list[Reading]] = {}
        for name, row in rows.items():
            # The others make the prior, whenever they were photographed.
            taken = mounts.pointing_measurements(session, row, *((since, until) if name in wanted else ()))
            try:
                heliostats[name] = with_drives(row, origin)
            except (ModelError, ConflictError) as error:
                useless[name] = str(error)
                continue
            own, unread = readings_of(heliostats[name], taken, origin, effects)
            useless |= {f"{name}/{identifier}": reason for identifier, reason in unread.items()}
            if own:
                readings[name] = own
            else:
                useless[name] = "no measurement with motor positions and a spot"
    skipped = {key: reason for key, reason in useless.items() if key.partition("/")[0] in wanted}
    if not wanted & readings.keys():
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3])
        raise ConflictError(f"no heliostat can be calibrated ({reasons}); post photographs with motor_position")
    with runtime.computing("calibrate"):
        done = calibrate_field(heliostats, readings, targets, latitude_deg=origin[0], wanted=wanted)
    return StoreMounts(done, skipped, effects)


def keep_mounts(session: Session, calibrated: StoreMounts) -> dict[str, MountRow]:
    """Keep calibrated mounts as their heliostats' next versions, by name; what was found of the clock with each."""
    done, kept = calibrated.done, {}
    clock = {"clock": clock_to_json(done.clock)}
    for name, row in store.get_heliostats(session, list(done.mounts)).items():
        document = mount_to_json(done.mounts[name], done.readings[name], done.contradictions[name], calibrated.effects)
        kept[name] = mounts.add_mount(session, row, document | clock)
    return kept


def readings_of(
    heliostat: Heliostat,
    rows: Sequence[MeasurementRow],
    origin: tuple[float, float, float],
    effects: Sequence[Effect],
) -> tuple[list[Reading], dict[str, str]]:
    """What measurements tell of a mount under the model's sun, and by their identifiers why others tell nothing."""
    readings, useless = [], {}
    days = days_of([row.taken_at for row in rows], [row.external_id or row.identifier for row in rows])
    for row, day in zip(rows, days, strict=True):
        try:
            # A day that nothing tells is taken for that on which the photograph came.
            when = float(day) if np.isfinite(day) else day_of(row.created_at)
            readings.append(_reading(heliostat, row, origin, effects, when))
        except ModelError as error:
            useless[row.identifier] = str(error)
    return readings, useless


def days_of(taken: Sequence[datetime | None], names: Sequence[str]) -> Array:
    """Days since 1970 of measurements; of those without a time by their numbers, which PAINT's plant counts on.

    NaN where neither tells.
    """
    days = np.array([day_of(moment) for moment in taken])
    numbers = np.array([int(name) if name.isdecimal() else np.nan for name in names])
    known = np.isfinite(numbers)
    days[known] = days_by_order(days[known], numbers[known])
    return days


def _reading(
    heliostat: Heliostat,
    row: MeasurementRow,
    origin: tuple[float, float, float],
    effects: Iterable[Effect],
    day: float,
) -> Reading:
    plane = store.target_plane(row.target)
    spot = spot_of(row, plane, origin)
    if row.motor_axis_1 is None or row.motor_axis_2 is None:
        raise InvalidInputError("no motor_position")
    if spot is None:
        raise InvalidInputError("no place of its spot on the target")
    if float(row.quality.get("cut_share") or 0) > MOST_CUT:
        raise InvalidInputError(
            "its spot runs over the target's edge, and where the centre of all of it lies is unseen"
        )
    motors = np.array([row.motor_axis_1, row.motor_axis_2])
    heliostat.mount.require_within(motors)
    sun = true_sun(effects, sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg), row.taken_at, origin[0])
    return Reading(row.identifier, plane.name, motors, sun, spot, day, photograph_of(row).weather)


def sun_at(moment: datetime, origin: tuple[float, float, float]) -> tuple[float, float]:
    """Azimuth and elevation [deg] of the sun; InvalidInputError where it is night."""
    azimuth, elevation = sun_angles_at(moment, origin[0], origin[1])
    if elevation <= 0:
        raise InvalidInputError(f"time: the sun is {-elevation:.1f}° below the horizon then; choose another time")
    return azimuth, elevation


# --- the plan ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Slot:
    """A photograph of a plan, with its moment and sun [deg]."""

    proposal: Proposal
    moment: datetime
    azimuth_deg: float
    elevation_deg: float


def make_plan(runtime: Runtime, begin: datetime | None, minutes: float, photographs: int) -> list[Slot]:
    """So many photographs within some time, evenly, each of the heliostat that it tells most of.

    It begins at the next full minute unless told otherwise.
    Heliostats that were never calibrated are taken by what is believed of any.

    Raises
    ------
    InvalidInputError
        Where it is night for all that time.
    """
    start = begin or now().replace(second=0, microsecond=0) + timedelta(minutes=1)
    moments = [start + timedelta(minutes=minutes * (place + 0.5) / photographs) for place in range(photographs)]
    with runtime.database.reading() as session:
        origin, effects = store.get_plant(session).origin, versions.get_model(session).effects
        planes = [store.target_plane(row) for row in store.list_targets(session)]
        known = {row.name: (row, kept) for row, kept in mounts.current_mounts(session)}
        rows = session.scalars(select(HeliostatRow).order_by(HeliostatRow.name)).all()
    heliostats, calibrated = {}, {}
    for row in rows:
        try:
            heliostats[row.name] = with_drives(row, origin)
            own = known.get(row.name)
            calibrated[row.name] = CalibratedMount.uncalibrated() if own is None else mount_of(*own, effects)
        except ConflictError:  # no drives, or a mount that does not hold any more: nothing to aim with
            continue
    angles = [sun_angles_at(moment, origin[0], origin[1]) for moment in moments]
    days = [(moment, *angle) for moment, angle in zip(moments, angles, strict=True) if angle[1] > 0]
    if not days:
        raise InvalidInputError("at: the sun is below the horizon then; choose another time")
    suns = [true_sun(effects, sun_direction(*angle), moment, origin[0]) for moment, *angle in days]
    with runtime.computing("plan"):
        chosen = plan(heliostats, calibrated, planes, suns, [day_of(moment) for moment, _, _ in days])
    return [Slot(one, *days[one.slot]) for one in chosen]


# A quarter of an hour turns the sun by 4 degrees; below so many [deg] it is too weak for a spot that is seen whole.
_QUARTER = timedelta(minutes=15)
_LEAST_ELEVATION_DEG = 10.0


def best_slot(runtime: Runtime, name: str, begin: datetime | None = None) -> Slot | None:
    """The photograph of one heliostat that would tell most within a day, by suns each quarter of an hour.

    None where no target is in reach then. Raises what `load_mount` raises.
    """
    with runtime.database.reading() as session:
        stored = load_mount(session, name)
        planes = [store.target_plane(row) for row in store.list_targets(session)]
    start = begin or now()
    start += (datetime.min.replace(tzinfo=start.tzinfo) - start) % _QUARTER
    moments = [start + place * _QUARTER for place in range(96)]
    days = [(moment, *sun_angles_at(moment, *stored.origin[:2])) for moment in moments]
    days = [(moment, azimuth, elevation) for moment, azimuth, elevation in days if elevation >= _LEAST_ELEVATION_DEG]
    suns = [stored.sun(sun_direction(azimuth, elevation), moment) for moment, azimuth, elevation in days]
    with runtime.computing("plan"):
        best = best_sun(stored.heliostat, stored.mount, planes, suns, [day_of(moment) for moment, _, _ in days])
    return None if best is None else Slot(best, *days[best.slot])


def mount_out(row: MountRow) -> dict[str, Any]:
    """A stored mount as JSON, without what only the service needs of it."""
    hidden = ("covariance", "history")
    return {name: value for name, value in row.document.items() if name not in hidden}
