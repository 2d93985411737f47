"""Photographs that are sent again: fill missing fields, ignore different ones, report both."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from model.imaging.light import camera_at
from model.times import format_time
from service import store
from service.base.arrays import to_json_value
from service.base.errors import ConflictError, GoneError
from service.sources.photograph import IncomingPhotograph
from service.store import audit
from service.store.keys import RESERVED
from service.store.photographs import list_corrections, note_change
from service.store.rows import ROUNDS, lock_heliostat
from service.store.tables import NO_IMAGE, CorrectionRow, HeliostatRow, MeasurementRow
from service.twin.measurements import HeliostatContext, load_heliostat_context
from service.twin.photographs.corrections import remeasure
from service.twin.photographs.ingest import ingest, store_position
from service.twin.photographs.metadata import (
    find_sun_contradictions,
    photograph_from_row,
    spot_m,
    stored_metadata,
    submitted_metadata,
    sun_columns,
)
from service.twin.runtime import Runtime

FILLED = "sent again with what was missing"


@dataclass(frozen=True, eq=False)
class ReceivedPhotograph:
    """Result of a sent photograph.

    ``is_new`` is whether it was not stored before. Otherwise ``filled`` and ``ignored`` name its
    fields, and ``changes_flux`` is whether what was filled changes its flux.
    """

    row: MeasurementRow
    is_new: bool
    filled: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()
    changes_flux: bool = False


def receive(
    runtime: Runtime,
    heliostat: str,
    photograph: IncomingPhotograph,
    data: bytes | None,
    is_live: bool = True,
    actor: str = RESERVED,
) -> ReceivedPhotograph:
    """Store a photograph, or a position without an image, or fill a known one.

    ``actor`` is who sent it.

    Raises
    ------
    ConflictError
        As in `ingest`. Also if it is known with another sun, target, time or motor position, or its
        id belongs to another image.
    """
    for _ in range(ROUNDS):
        if data is None:
            row, is_new = store_position(runtime, heliostat, photograph, sent_by=actor)
        else:
            row, is_new = ingest(runtime, heliostat, photograph, data, is_live, sent_by=actor)
        if is_new:
            _record_forced(runtime, heliostat, row, actor)
            return ReceivedPhotograph(row, True)
        received = _fill(runtime, heliostat, row, photograph, actor)
        if received is not None:
            return received
    raise ConflictError(f"measurement {row.identifier} is deleted again and again; send it later")


def _record_forced(runtime: Runtime, heliostat: str, row: MeasurementRow, actor: str) -> None:
    if row.forced is not None:
        with runtime.database.writing() as session:
            subject = f"heliostat {heliostat} {row.identifier}"
            audit.record(session, actor, "measurement.forced", subject, reason=row.forced)


def _fields(photograph: IncomingPhotograph, twin: HeliostatContext) -> dict[str, object]:
    """Fields that may be filled, by REST names, as JSON values; None if unknown."""
    taken, corners = photograph.taken_at, photograph.corners
    known = {
        "taken_at": None if taken is None else format_time(taken),
        "motor_position": photograph.motor_position,
        "focal_spot_m": spot_m(photograph.focal_spot_wgs84, twin.origin),
        "helios_spot_m": spot_m(photograph.helios_spot_wgs84, twin.origin),
        "corners": None if corners is None else {"corners": corners},
        **vars(photograph.weather),
    }
    return {name: to_json_value(value) for name, value in known.items()}


def _assign(row: MeasurementRow, name: str, photograph: IncomingPhotograph, value: Any) -> None:
    """Set a missing field of a stored measurement."""
    if name == "taken_at":
        row.taken_at = photograph.taken_at
    elif name == "motor_position":
        row.motor_axis_1, row.motor_axis_2 = value
    elif name in _SPOTS:
        column = name.replace("_m", "_wgs84")
        setattr(row, column, list(getattr(photograph, column)))
    else:
        setattr(row, "corners_px" if name == "corners" else name, value)


def _lock(
    session: Session, heliostat: HeliostatRow, stored: MeasurementRow
) -> MeasurementRow | None:
    """Lock a known photograph's row for filling; None if it was deleted meanwhile."""
    lock_heliostat(session, heliostat)
    return session.get(MeasurementRow, stored.id)


_SPOTS = ("focal_spot_m", "helios_spot_m")

# Differences [m] that conversions between WGS84 and the plant's frame explain.
_SPOT_TOLERANCE_M = 1e-4


def _differs(name: str, sent: Any, stored: Any) -> bool:
    """Whether two known values of a field contradict each other."""
    if None in (sent, stored):
        return False
    if name in _SPOTS:
        return bool((np.abs(np.subtract(sent, stored)) > _SPOT_TOLERANCE_M).any())
    return bool(sent != stored)


def _require_same(
    session: Session, twin: HeliostatContext, row: MeasurementRow, photograph: IncomingPhotograph
) -> None:
    """Raise ConflictError if a known photograph came with different values.

    Values from before a correction may come again.
    """
    sent, stored = submitted_metadata(photograph), stored_metadata(row)
    is_position = photograph.kind is None and row.kind == NO_IMAGE
    if is_position:
        # No image shows the spot again, so the stored spot must be the same.
        sent["focal_spot_m"] = spot_m(photograph.focal_spot_wgs84, twin.origin)
        stored["focal_spot_m"] = spot_m(row.focal_spot_wgs84, twin.origin)
    apart = {name: value for name, value in sent.items() if _differs(name, value, stored[name])}
    corrections = list_corrections(session, row) if apart else ()
    corrected = {
        name
        for name, value in apart.items()
        if any(value == one.before.get(name) for one in corrections)
    }
    apart = {name: value for name, value in apart.items() if name not in corrected}
    if not apart:
        return
    address = f"/v1/heliostats/{twin.row.name}/measurements/{row.identifier}"
    said = "; ".join(
        f"{name}: {stored[name]} is stored, {value} was sent" for name, value in apart.items()
    )
    remedy = f"to correct what is known of it, PATCH {address}"
    if "focal_spot_m" in apart:
        remedy = f"if what is stored is wrong, DELETE {address}?reason=... and post it again"
    what = "measurement" if is_position else "image"
    raise ConflictError(f"{said}. The {what} is known already; {remedy}")


def _fill(
    runtime: Runtime,
    heliostat: str,
    present: MeasurementRow,
    photograph: IncomingPhotograph,
    actor: str,
) -> ReceivedPhotograph | None:
    """Fill a known photograph in one transaction; None if it was deleted meanwhile.

    It is re-measured if the new values change its flux.

    Raises
    ------
    ConflictError
        If it is known with another sun, target, time or motor position, or its id belongs to
        another image.
    """
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, heliostat)

    def fill(session: Session) -> ReceivedPhotograph | None:
        row = _lock(session, twin.row, present)
        if row is None:
            return None
        _require_same(session, twin, row, photograph)
        before = photograph_from_row(row)
        stored, sent = _fields(before, twin), _fields(photograph, twin)
        missing = {
            name: value
            for name, value in sent.items()
            if value is not None and stored[name] is None
        }
        ignored = [name for name, value in sent.items() if _differs(name, value, stored[name])]
        for name, value in missing.items():
            _assign(row, name, photograph, value)
        filled = list(missing)
        if photograph.external_id not in (None, row.external_id) and store.add_alias(
            session, twin.row, row, photograph.external_id
        ):
            filled.append("id")
        received = ReceivedPhotograph(row, False, tuple(filled), tuple(ignored))
        if not filled:
            return received
        now_known = photograph_from_row(row)
        (contradiction,) = find_sun_contradictions([now_known], twin.origin)
        for name, value in sun_columns(row, now_known, contradiction).items():
            setattr(row, name, value)
        after = missing | ({"id": photograph.external_id} if "id" in filled else {})
        session.add(
            CorrectionRow(
                measurement_id=row.id,
                created_by=actor,
                reason=FILLED,
                before=dict.fromkeys(after),
                after=after,
            )
        )
        note_change(session, row.heliostat_id)
        subject = f"heliostat {heliostat} {row.identifier}"
        audit.record(session, actor, "measurement.filled", subject, fields=filled)
        return replace(received, changes_flux=_changes_flux(twin, before, now_known))

    done = runtime.database.run_in_transaction(fill)
    if done is None or not done.changes_flux:
        return done
    return replace(done, row=_remeasured(runtime, heliostat, done.row, actor))


def _changes_flux(
    twin: HeliostatContext, before: IncomingPhotograph, after: IncomingPhotograph
) -> bool:
    """Whether new corners, or the camera of a new time, change the flux.

    A measurement without an image has no flux.
    """
    if before.kind is None:
        return False
    if before.kind == "raw" and before.corners != after.corners:
        return True
    cameras = [camera_at(twin.model.cameras, one.target, one.taken_at) for one in (before, after)]
    return cameras[0] != cameras[1]


def _remeasured(
    runtime: Runtime, heliostat: str, row: MeasurementRow, actor: str
) -> MeasurementRow:
    try:
        remeasure(runtime, heliostat, row.identifier, FILLED, actor)
    except GoneError:
        return row  # its image is deleted, so its flux stays as measured
    with runtime.database.reading() as session:
        return store.get_measurement(
            session, store.get_heliostat(session, heliostat), row.identifier
        )
