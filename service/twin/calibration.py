"""Calibrate mounts from stored photographs, and plan which photographs to take next."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.effects import Effect
from model.ephemeris import sun_positions
from model.errors import InvalidInputError, ModelError
from model.frames import sun_direction
from model.plant import Heliostat
from model.pointing import CalibratedMount, FieldMounts, Reading, calibrate_field
from model.pointing.plan import Proposal, best_sun, plan
from model.pointing.report import clock_to_json, day_of, mount_to_json
from model.times import format_minute
from service import store
from service.base.errors import ConflictError
from service.store import mounts
from service.store.columns import now
from service.store.mounts import CalibrationState
from service.store.tables import HeliostatRow, MountRow
from service.twin import model_versions
from service.twin.photographs.readings import load_readings
from service.twin.runtime import Runtime
from service.twin.stored_mount import load_mount, mount_of, true_sun, with_drive_zeros
from service.twin.surfaces.present_shape import Epoch, waiting_epochs

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StoreMounts:
    """Calibrated mounts that are not stored yet.

    ``skipped`` are heliostats and measurements that were left out, with the reasons. ``effects``
    are those of the plant's model. ``undated`` counts measurements of unknown time.
    """

    done: FieldMounts
    skipped: dict[str, str]
    effects: Sequence[Effect]
    undated: "UndatedCount"


@dataclass(frozen=True)
class UndatedCount:
    """Counts of measurements of unknown time.

    ``left_out`` were not used, because a time span was requested.
    """

    used: int
    left_out: int

    def in_words(self) -> str | None:
        """Both counts in words; None if all times are known."""
        said = []
        if self.used:
            said.append(
                f"{self.used} measurements of an unknown time determine parameters only, not steps"
                " or drift"
            )
        if self.left_out:
            said.append(
                f"{self.left_out} measurements of an unknown time are left out: they may be of any"
                " time"
            )
        return "; ".join(said) or None


def calibrate_store(
    runtime: Runtime,
    names: Sequence[str],
    since: datetime | None = None,
    until: datetime | None = None,
) -> StoreMounts:
    """Calibrate stored heliostats from photographs of a time span.

    The prior is estimated from all heliostats of the store.

    Raises
    ------
    ConflictError
        If no heliostat has a measurement with motors and a spot.
    """
    wanted = set(names)
    with runtime.database.reading() as session:
        model = model_versions.get_model(session)
        targets = {row.name: store.target_plane(row) for row in store.list_targets(session)}
        rows = {
            row.name: row
            for row in session.scalars(select(HeliostatRow).order_by(HeliostatRow.name))
        }
        useless = {name: f"there is no heliostat {name}" for name in names if name not in rows}
        heliostats: dict[str, Heliostat] = {}
        readings: dict[str, list[Reading]] = {}
        left_out = 0
        for name, row in rows.items():
            # The other heliostats are part of the prior, with photographs of any time.
            span = (since, until) if name in wanted else (None, None)
            taken = mounts.pointing_measurements(session, row, *span)
            try:
                heliostats[name] = with_drive_zeros(row, model.site.origin)
            except (ModelError, ConflictError) as error:
                useless[name] = str(error)
                continue
            if span != (None, None):
                every = mounts.pointing_measurements(session, row)
                undated = [one for one in every if one.taken_at is None]
                left_out += len(load_readings(heliostats[name], undated, model, targets)[0])
            own, unread = load_readings(heliostats[name], taken, model, targets)
            useless |= {f"{name}/{identifier}": reason for identifier, reason in unread.items()}
            if own:
                readings[name] = own
            else:
                useless[name] = "no measurement with motor positions and a spot"
    skipped = {key: reason for key, reason in useless.items() if key.partition("/")[0] in wanted}
    if not wanted & readings.keys():
        reasons = [f"{name}: {reason}" for name, reason in list(skipped.items())[:3]]
        if left_out:
            reasons.insert(0, f"{left_out} measurements of an unknown time are left out")
        raise ConflictError(
            f"no heliostat can be calibrated ({'; '.join(reasons)}); add measurements with motor"
            " positions and a spot"
        )
    with runtime.computing("calibrate"):
        done = calibrate_field(heliostats, readings, targets, model.site, requested=wanted)
    used = sum(mount.n_undated for mount in done.mounts.values())
    return StoreMounts(done, skipped, model.effects, UndatedCount(used, left_out))


def store_mounts(session: Session, calibrated: StoreMounts) -> dict[str, MountRow]:
    """Store calibrated mounts as their heliostats' next versions; return them by name.

    Each also stores the clock error that was found.
    """
    field, rows = calibrated.done, {}
    clock = {"clock": clock_to_json(field.clock)}
    for name, row in store.get_heliostats(session, list(field.mounts)).items():
        document = mount_to_json(
            field.mounts[name], field.readings[name], field.contradictions[name], calibrated.effects
        )
        rows[name] = mounts.add_mount(session, row, document | clock)
    return rows


# --- the plan
# --------------------------------------------------------------------------------------------------


_CANDIDATES = 128
"""Heliostats of each kind that a plan considers; each costs some milliseconds."""


def plan_candidates(states: Sequence[CalibrationState], most: int) -> list[str]:
    """Names of the heliostats that a plan considers: all of a small field.

    Of a large field there are up to ``most`` of each of three kinds:

    - those never calibrated, spread evenly over the names,
    - those calibrated by the fewest measurements,
    - those whose last calibration measurement is the oldest.
    """
    if len(states) <= 3 * most:
        return [state.name for state in states]
    never = [state for state in states if state.newest is None]
    calibrated = [state for state in states if state.newest is not None]
    spread = [
        never[place]
        for place in np.unique(np.linspace(0, len(never) - 1, min(most, len(never)), dtype=int))
    ]
    few = sorted(calibrated, key=lambda state: (state.measurements, state.newest or ""))[:most]
    old = sorted(calibrated, key=lambda state: state.newest or "")[:most]
    return list(dict.fromkeys(state.name for state in [*spread, *few, *old]))


@dataclass(frozen=True, eq=False)
class CalibrationSlot:
    """A planned photograph with its time, sun [deg] and the reason for its heliostat in words."""

    proposal: Proposal
    moment: datetime
    azimuth_deg: float
    elevation_deg: float
    reason: str = ""


def make_plan(
    runtime: Runtime, begin: datetime | None, minutes: float, photographs: int
) -> list[CalibrationSlot]:
    """Plan photographs at even intervals, each of the most informative heliostat.

    ``begin`` is by default the next full minute. Heliostats that were never calibrated are planned
    with the prior. Of a large field only the `plan_candidates` are considered. Heliostats whose
    mirror changed come first, until enough photographs show it.

    Raises
    ------
    InvalidInputError
        If it is night for the whole time.
    """
    start = begin or now().replace(second=0, microsecond=0) + timedelta(minutes=1)
    moments = [
        start + timedelta(minutes=minutes * (place + 0.5) / photographs)
        for place in range(photographs)
    ]
    with runtime.database.reading() as session:
        model = model_versions.get_model(session)
        planes = [store.target_plane(row) for row in store.list_targets(session)]
        wanted = waiting_epochs(session, runtime.settings)
        states = mounts.calibration_states(session)
        names = plan_candidates(states, max(_CANDIDATES, 2 * photographs))
        names = list(dict.fromkeys([*wanted, *names]))
        known = {row.name: kept for row, kept in mounts.current_mounts(session, names)}
        rows = store.get_heliostats(session, names)
    heliostats, calibrated = {}, {}
    for name in sorted(rows):
        try:
            heliostats[name] = with_drive_zeros(rows[name], model.site.origin)
            own = known.get(name)
            calibrated[name] = (
                CalibratedMount.uncalibrated()
                if own is None
                else mount_of(rows[name], own, model.effects)
            )
        except (
            ConflictError
        ):  # no drives, or a mount that is not valid any more: nothing to aim with
            continue
    days = _suns_above(0.0, moments, model.site.origin)
    if not days:
        raise InvalidInputError("at: the sun is below the horizon then; choose another time")
    suns = [true_sun(model, sun_direction(*angle), moment) for moment, *angle in days]
    with runtime.computing("plan"):
        chosen = plan(
            heliostats, calibrated, planes, suns, [day_of(moment) for moment, _, _ in days], wanted
        )
    of = {state.name: state for state in states}
    return [
        CalibrationSlot(one, *days[one.slot], _reason(of[one.heliostat], wanted.get(one.heliostat)))
        for one in chosen
    ]


def _reason(state: CalibrationState, epoch: Epoch | None) -> str:
    """Why a heliostat is photographed, in words."""
    if epoch is not None:
        return f"{epoch.said}; {epoch.needs}"
    if state.newest is None:
        return "its mount was never calibrated"
    newest = format_minute(datetime.fromisoformat(state.newest))
    return f"its mount is known by {state.measurements} photographs, the last of {newest}"


def _suns_above(
    elevation_deg: float, moments: Sequence[datetime], origin: tuple[float, float, float]
) -> list[tuple[datetime, float, float]]:
    """Moments when the sun is above an elevation, with azimuth and elevation [deg]."""
    angles = sun_positions(moments, origin).tolist()
    return [
        (at, azimuth, up)
        for at, (azimuth, up) in zip(moments, angles, strict=True)
        if up > elevation_deg
    ]


# Suns are tried each quarter of an hour, in which the sun moves by 4 degrees. Below
# `_MIN_ELEVATION_DEG` the sun is too weak for the whole spot to be visible.
_QUARTER = timedelta(minutes=15)
_MIN_ELEVATION_DEG = 10.0


def best_slot(runtime: Runtime, name: str) -> CalibrationSlot | None:
    """The most informative photograph of one heliostat within a day from now.

    Suns are tried each quarter of an hour. The result is None if no target is in reach. Raises what
    `load_mount` raises.
    """
    with runtime.database.reading() as session:
        stored = load_mount(session, name)
        planes = [store.target_plane(row) for row in store.list_targets(session)]
    start = now()
    start += (datetime.min.replace(tzinfo=start.tzinfo) - start) % _QUARTER
    moments = [start + place * _QUARTER for place in range(96)]
    days = _suns_above(_MIN_ELEVATION_DEG, moments, stored.model.site.origin)
    suns = [
        stored.sun(sun_direction(azimuth, elevation), moment) for moment, azimuth, elevation in days
    ]
    with runtime.computing("plan"):
        best = best_sun(
            stored.heliostat, stored.mount, planes, suns, [day_of(moment) for moment, _, _ in days]
        )
    return None if best is None else CalibrationSlot(best, *days[best.slot])


def mount_out(row: MountRow) -> dict[str, object]:
    """A stored mount as JSON, without fields that only the service needs."""
    hidden = ("covariance", "history")
    return {name: value for name, value in row.document.items() if name not in hidden}
