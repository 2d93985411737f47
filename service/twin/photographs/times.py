"""Times of many photographs, given afterwards: a preview, all or none, and undo."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

from pydantic import TypeAdapter, ValidationError
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.errors import InvalidInputError, ModelError
from model.times import format_time
from service.base.errors import ConflictError, InvalidEntriesError, NotFoundError, ServiceError
from service.base.fields import Moment
from service.base.validation_messages import format_validation_error
from service.store import audit
from service.store.job_tables import AuditRow
from service.store.photographs.groups import PhotographFilter, list_groups
from service.store.rows import Change
from service.store.tables import CorrectionRow, HeliostatRow, MeasurementRow
from service.twin.photographs.corrections import (
    PhotographChanges,
    PreparedCorrection,
    apply_correction,
    prepare_correction,
)
from service.twin.photographs.ingest import require_past
from service.twin.runtime.runtime import Runtime

MOST_TIMES = 2000
"""Most times that are given at once."""

CORRECTED, UNDONE = "times.corrected", "times.undone"
"""Actions of the audit trail."""

_COLUMNS = ("heliostat", "id", "taken_at")


@dataclass(frozen=True)
class GivenTime:
    """The time of a heliostat's measurement, submitted later; None if it is unknown after all."""

    heliostat: str
    identifier: str
    taken_at: datetime | None


@dataclass(frozen=True)
class TimeChange:
    """What a given time would change. ``warning`` is what contradicts it."""

    given: GivenTime
    before: datetime | None
    warning: str | None


def read_times(lines: Iterable[str], where: str, zone: str | None = None) -> list[GivenTime]:
    """Times of CSV lines with the columns heliostat, id, taken_at.

    Times without a zone are of ``zone``, and are refused without one. The heading may be missing.

    Raises
    ------
    InvalidInputError
        With ``where`` and the first line that is wrong.
    """
    text = [line for line in lines if line.strip()]
    names = {name.strip() for name in text[0].split(",")} if text else set(_COLUMNS)
    has_no_heading = len(names) == len(_COLUMNS) and any(name[:2].isdigit() for name in names)
    if not set(_COLUMNS) <= names and not has_no_heading:
        raise InvalidInputError(
            f"{where}: needs the columns {', '.join(_COLUMNS)} in its first line"
        )
    moment, found = TypeAdapter(Moment), []
    reader = csv.DictReader(text, _COLUMNS if has_no_heading else None, skipinitialspace=True)
    for row in reader:
        try:
            taken_at = moment.validate_python(_with_zone(row["taken_at"], zone))
        except ValidationError as error:
            raise InvalidInputError(
                f"{where}, line {reader.line_num}: {format_validation_error(error, 'taken_at')}"
            ) from None
        found.append(GivenTime(row["heliostat"] or "", row["id"] or "", taken_at))
    if not found:
        raise InvalidInputError(f"{where}: holds no time")
    return found


def _with_zone(text: str | None, zone: str | None) -> object:
    """A time without a zone as one of ``zone``; other text as it is."""
    try:
        at = datetime.fromisoformat((text or "").strip())
    except ValueError:
        return text
    return at.replace(tzinfo=ZoneInfo(zone)) if zone and at.tzinfo is None else text


def shifted_times(session: Session, chosen: PhotographFilter, minutes: float) -> list[GivenTime]:
    """The times of a selection's photographs, ``minutes`` later.

    Raises
    ------
    InvalidInputError
        If it has no photograph of a known time, or too many.
    """
    groups = list_groups(session, replace(chosen, time="known"), MOST_TIMES + 1)
    if not 0 < len(groups) <= MOST_TIMES:
        raise InvalidInputError(
            f"selection: {'more than 2000' if groups else 'no'} photographs of a known time;"
            " choose another heliostat, target or days"
        )
    offset = timedelta(minutes=minutes)
    return [
        GivenTime(group.heliostat, group.best.identifier, group.best.taken_at + offset)
        for group in groups
        if group.best.taken_at is not None
    ]


def _prepare(runtime: Runtime, times: Sequence[GivenTime], reason: str) -> list[PreparedCorrection]:
    prepared: list[PreparedCorrection] = []
    wrong: dict[int, str] = {}
    named: set[tuple[str, str]] = set()
    for place, entry in enumerate(times):
        changes = PhotographChanges(
            reason, taken_at=entry.taken_at, without_time=entry.taken_at is None
        )
        try:
            require_past(entry.taken_at)
            ready = prepare_correction(runtime, entry.heliostat, entry.identifier, changes)
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
        raise InvalidEntriesError("times", wrong)
    return prepared


def preview_times(runtime: Runtime, times: Sequence[GivenTime]) -> list[TimeChange]:
    """What `correct_times` would change; raises its errors, and stores nothing."""
    return [
        TimeChange(entry, ready.taken_at, _contradiction(ready))
        for entry, ready in zip(times, _prepare(runtime, times, "preview"), strict=True)
        if entry.taken_at != ready.taken_at
    ]


def _contradiction(ready: PreparedCorrection) -> str | None:
    quality = next(iter(ready.fresh.values()))["quality"]
    assert isinstance(quality, dict)
    clock = quality.get("clock")
    return clock if isinstance(clock, str) else None


def correct_times(
    runtime: Runtime,
    times: Sequence[GivenTime],
    reason: str,
    actor: str,
    *,
    action: str = CORRECTED,
    **about: int,
) -> int:
    """Correct the times of many measurements, all or none; return how many changed.

    The audit trail records them together, so that `undo_times` finds them.

    Raises
    ------
    InvalidEntriesError
        If a heliostat or measurement is not stored, a measurement is named twice, a time is in the
        future, or an image that must be re-measured is deleted. The error names all wrong entries.
    ConflictError
        If another image of a photograph came meanwhile.
    """
    prepared = _prepare(runtime, times, reason)
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


def list_time_changes(session: Session, limit: int) -> list[tuple[AuditRow, bool]]:
    """The newest entries that `undo_times` accepts, and whether each is undone."""
    row = AuditRow
    query = select(row).order_by(row.id.desc())
    rows = session.scalars(query.where(row.action == CORRECTED).limit(limit)).all()
    undone = session.scalars(query.where(row.action == UNDONE).limit(10 * limit))
    numbers = {one.detail.get("undone") for one in undone}
    return [(one, one.id in numbers) for one in rows]


def undo_times(runtime: Runtime, number: int, actor: str) -> int:
    """Restore the times before an entry of the audit trail; return how many changed.

    Photographs whose time was corrected again since keep it.

    Raises
    ------
    NotFoundError
        If there is no such entry.
    ConflictError
        If it is undone already, or every time was corrected again.
    """
    with runtime.database.reading() as session:
        entry = session.get(AuditRow, number)
        if entry is None or entry.action != CORRECTED:
            raise NotFoundError(f"there is no correction of times {number}")
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
        times = {
            (name, row.external_id or row.identifier): GivenTime(
                name, row.identifier, _moment(correction.before.get("taken_at"))
            )
            for correction, row, name in found
            if "taken_at" in correction.after
            and row.taken_at is not None
            and format_time(row.taken_at) == correction.after["taken_at"]
        }
    if not times:
        raise ConflictError(f"the times of correction {number} are undone or corrected again")
    reason = f"undone: {entry.detail['reason']}"[:200]
    return correct_times(runtime, list(times.values()), reason, actor, action=UNDONE, undone=number)


def _moment(text: str | None) -> datetime | None:
    return None if text is None else datetime.fromisoformat(text).astimezone(UTC)
