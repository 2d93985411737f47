"""Corrections of many photographs: a preview, all or none, and undo."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.errors import ModelError
from service.base.errors import ConflictError, InvalidEntriesError, NotFoundError, ServiceError
from service.store import audit
from service.store.job_tables import AuditRow
from service.store.rows import Change
from service.store.tables import CorrectionRow, HeliostatRow, MeasurementRow
from service.twin.heliostats.metadata import photograph_from_row, stored_metadata
from service.twin.photographs.corrections import (
    PhotographChanges,
    PreparedCorrection,
    apply_correction,
    prepare_correction,
)
from service.twin.photographs.ingest import require_past
from service.twin.runtime.runtime import Runtime

MOST_ENTRIES = 2000
"""Most corrections that are given at once."""

TIMES, MOTORS = "times.corrected", "motors.corrected"
"""Actions of the audit trail."""

_UNDONE = {TIMES: "times.undone", MOTORS: "motors.undone"}
_FIELDS = ("taken_at", "motor_position")


@dataclass(frozen=True)
class GivenCorrection:
    """The corrected metadata of a heliostat's measurement."""

    heliostat: str
    identifier: str
    changes: PhotographChanges


@dataclass(frozen=True)
class CorrectionPreview:
    """What a correction would change in the stored ``row``. ``warning`` is what contradicts it."""

    given: GivenCorrection
    row: MeasurementRow
    warning: str | None


def _prepare(
    runtime: Runtime, where: str, given: Sequence[GivenCorrection]
) -> list[PreparedCorrection]:
    prepared: list[PreparedCorrection] = []
    wrong: dict[int, str] = {}
    named: set[tuple[str, str]] = set()
    for place, entry in enumerate(given):
        try:
            require_past(entry.changes.taken_at)
            ready = prepare_correction(runtime, entry.heliostat, entry.identifier, entry.changes)
        except (ModelError, ServiceError) as error:
            wrong[place] = str(error)
            continue
        images = {(entry.heliostat, name) for name in ready.fresh}
        if named & images:
            wrong[place] = (
                f"measurement {entry.identifier} of {entry.heliostat} is named twice; name it once"
            )
        named |= images
        prepared.append(ready)
    if wrong:
        raise InvalidEntriesError(where, wrong)
    return prepared


def preview_many(
    runtime: Runtime, where: str, given: Sequence[GivenCorrection]
) -> list[CorrectionPreview]:
    """What `correct_many` would change; raises its errors, and stores nothing."""
    return [
        CorrectionPreview(entry, ready.row, _contradiction(ready))
        for entry, ready in zip(given, _prepare(runtime, where, given), strict=True)
        if entry.changes.of(ready.row) != photograph_from_row(ready.row)
    ]


def _contradiction(ready: PreparedCorrection) -> str | None:
    quality = next(iter(ready.fresh.values()))["quality"]
    assert isinstance(quality, dict)
    clock = quality.get("clock")
    return clock if isinstance(clock, str) else None


def correct_many(
    runtime: Runtime,
    given: Sequence[GivenCorrection],
    reason: str,
    actor: str,
    action: str,
    **about: int,
) -> int:
    """Correct many photographs for one ``reason``, all or none; return how many changed.

    The audit trail records them together as ``action``, such as ``times.corrected``, so that
    `undo_batch` finds them.

    Raises
    ------
    InvalidEntriesError
        If a heliostat or measurement is not stored, a measurement is named twice, a time is in the
        future, or an image that must be re-measured is deleted. The error names all wrong entries.
    ConflictError
        If another image of a photograph came meanwhile.
    """
    prepared = _prepare(runtime, action.partition(".")[0], given)
    with runtime.database.writing() as session:
        last = session.scalar(select(func.max(CorrectionRow.id))) or 0
        changes = [apply_correction(session, entry, actor).change for entry in prepared]
        changed = changes.count(Change.CHANGED)
        made = session.execute(
            select(func.min(CorrectionRow.id), func.max(CorrectionRow.id)).where(
                CorrectionRow.id > last,
                CorrectionRow.created_by == actor,
                CorrectionRow.reason == reason,
            )
        ).one()
        if changed:
            span = {"first": made[0], "last": made[1], "reason": reason}
            audit.record(session, actor, action, f"{changed} photographs", **span, **about)
    return changed


def list_batches(session: Session, limit: int) -> list[tuple[AuditRow, bool]]:
    """The newest entries that `undo_batch` accepts, and whether each is undone."""
    row = AuditRow
    query = select(row).order_by(row.id.desc())
    rows = session.scalars(query.where(row.action.in_(_UNDONE)).limit(limit)).all()
    first = min((one.id for one in rows), default=0)
    undone = session.scalars(query.where(row.action.in_(_UNDONE.values()), row.id > first))
    numbers = {one.detail.get("undone") for one in undone}
    return [(one, one.id in numbers) for one in rows]


def undo_batch(runtime: Runtime, number: int, actor: str) -> int:
    """Restore the metadata before an entry of the audit trail; return how many changed.

    Photographs that were corrected again since keep their values.

    Raises
    ------
    NotFoundError
        If there is no such entry.
    ConflictError
        If it is undone already, or everything was corrected again.
    """
    with runtime.database.reading() as session:
        entry = session.get(AuditRow, number)
        if entry is None or entry.action not in _UNDONE:
            raise NotFoundError(f"there is no correction of many photographs {number}")
        reason = f"undone: {entry.detail['reason']}"[:200]
        done, measured = CorrectionRow, MeasurementRow
        found = session.execute(
            select(done, measured, HeliostatRow.name)
            .join(measured, measured.id == done.measurement_id)
            .join(HeliostatRow, HeliostatRow.id == measured.heliostat_id)
            .where(
                done.id.between(entry.detail["first"], entry.detail["last"]),
                done.created_by == entry.actor,
                done.reason == entry.detail["reason"],
            )
        ).all()
        given = {
            (name, row.external_id or row.identifier): GivenCorrection(
                name, row.identifier, _restoring(correction, reason)
            )
            for correction, row, name in found
            if all(
                stored_metadata(row)[field] == correction.after[field]
                for field in _FIELDS
                if field in correction.after
            )
        }
    if not given:
        raise ConflictError(f"correction {number} is undone, or all was corrected again")
    return correct_many(
        runtime, list(given.values()), reason, actor, _UNDONE[entry.action], undone=number
    )


def _restoring(correction: CorrectionRow, reason: str) -> PhotographChanges:
    before = {name: correction.before[name] for name in _FIELDS if name in correction.before}
    taken_at, motors = before.get("taken_at"), before.get("motor_position")
    return PhotographChanges(
        reason,
        taken_at=None if taken_at is None else datetime.fromisoformat(taken_at),
        motor_position=None if motors is None else (motors[0], motors[1]),
        without=tuple(name for name, value in before.items() if value is None),
    )
