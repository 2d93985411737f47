"""Corrections of many photographs: a preview, all or none, and undo.

Times and motor positions may be given afterwards as lines, or times by an offset.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import TypeVar
from zoneinfo import ZoneInfo

from pydantic import TypeAdapter, ValidationError
from sqlalchemy import func, select
from sqlalchemy.orm import Session, aliased

from model.errors import InvalidInputError, ModelError
from model.times import format_time
from service.base.errors import ConflictError, InvalidEntriesError, NotFoundError, ServiceError
from service.base.fields import Moment, read_time
from service.base.validation import format_validation_error
from service.sources.text_lines import ForeignLine, csv_lines
from service.store import audit
from service.store.job_tables import AuditRow
from service.store.photographs import PhotographFilter, list_groups
from service.store.tables import CorrectionRow, HeliostatRow, MeasurementRow
from service.twin.photographs.corrections import (
    Corrections,
    GivenCorrection,
    Prepared,
    run_corrections,
)
from service.twin.photographs.ingest import require_past
from service.twin.photographs.metadata import photograph_from_row
from service.twin.runtime import Runtime

MOST_ENTRIES = 2000
"""Most corrections that are given at once."""

TIMES, MOTORS = "times.corrected", "motors.corrected"
"""Actions of the audit trail."""

_UNDONE = {TIMES: "times.undone", MOTORS: "motors.undone"}
_FIELDS = ("taken_at", "motor_position")
Done = TypeVar("Done")


@dataclass(frozen=True)
class CorrectionPreview:
    """What a correction would change in the stored ``row``. ``warning`` is what contradicts it."""

    given: GivenCorrection
    row: MeasurementRow
    warning: str | None


def _each(
    where: str, given: Sequence[GivenCorrection], correct: Callable[[GivenCorrection], Done]
) -> list[Done]:
    """The result for each entry; InvalidEntriesError names all that cannot be corrected."""
    done: list[Done] = []
    wrong: dict[int, str] = {}
    for place, entry in enumerate(given):
        try:
            require_past(entry.taken_at)
            done.append(correct(entry))
        except (ModelError, ServiceError) as error:
            wrong[place] = str(error)
    if wrong:
        raise InvalidEntriesError(where, wrong)
    return done


def preview_many(
    session: Session, where: str, given: Sequence[GivenCorrection]
) -> list[CorrectionPreview]:
    """What `correct_many` would change; raises its errors, and stores nothing."""
    corrections = Corrections(session, "", Prepared())

    def preview(entry: GivenCorrection) -> CorrectionPreview | None:
        row = corrections.find(entry)
        if entry.of(row) == photograph_from_row(row):
            return None
        columns = corrections.columns.of(row, entry)
        quality = columns["quality"] if columns else {}
        assert isinstance(quality, dict)
        return CorrectionPreview(entry, row, quality.get("clock"))

    return [one for one in _each(where, given, preview) if one is not None]


def correct_many(
    runtime: Runtime,
    given: Sequence[GivenCorrection],
    reason: str,
    actor: str,
    action: str,
    version: int | None = None,
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
        If a value changed since ``version``, as in `correct_photograph`.
    """

    def write(corrections: Corrections) -> int:
        return _correct_all(corrections, given, reason, action)

    return run_corrections(runtime, actor, write, version)


def _correct_all(
    corrections: Corrections,
    given: Sequence[GivenCorrection],
    reason: str,
    action: str,
    **about: int,
) -> int:
    """Correct many photographs, and record them together."""
    corrections.lock(entry.heliostat for entry in given)
    done = _each(action.partition(".")[0], given, corrections.apply)
    history = [entry for corrected in done for entry in corrected.history]
    count = sum(bool(corrected.history) for corrected in done)
    if history:
        corrections.session.flush()
        numbers = [entry.id for entry in history]
        about |= {"first": min(numbers), "last": max(numbers)}
        subject, actor = f"{count} photographs", corrections.actor
        audit.record(corrections.session, actor, action, subject, reason=reason, **about)
    return count


def list_batches(session: Session, limit: int) -> list[tuple[AuditRow, bool]]:
    """The newest entries that `undo_batch` accepts, and whether each is undone."""
    row = AuditRow
    query = select(row).order_by(row.id.desc())
    rows = session.scalars(query.where(row.action.in_(_UNDONE)).limit(limit)).all()
    undone = _undone_by(session, rows)
    return [(one, one.id in undone) for one in rows]


def _undone_by(session: Session, rows: Sequence[AuditRow]) -> dict[int, AuditRow]:
    """The entries that undid these or later ones, by what they undid."""
    first = min((row.id for row in rows), default=0)
    undone = select(AuditRow).where(AuditRow.action.in_(_UNDONE.values()), AuditRow.id > first)
    return {row.detail["undone"]: row for row in session.scalars(undone)}


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

    def write(corrections: Corrections) -> int:
        session = corrections.session
        entry = session.get(AuditRow, number)
        if entry is None or entry.action not in _UNDONE:
            raise NotFoundError(f"there is no correction of many photographs {number}")
        if (undone := _undone_by(session, [entry]).get(number)) is not None:
            raise ConflictError(
                f"correction {number} was undone by {undone.actor} on"
                f" {format_time(undone.created_at)}; it cannot be undone again"
            )
        reason = f"undone: {entry.detail['reason']}"[:200]
        given = _restoring_all(session, entry, reason)
        if not given:
            raise ConflictError(
                f"all photographs of correction {number} were corrected again since; nothing was"
                " undone"
            )
        return _correct_all(corrections, given, reason, _UNDONE[entry.action], undone=number)

    return run_corrections(runtime, actor, write)


def _restoring_all(session: Session, entry: AuditRow, reason: str) -> list[GivenCorrection]:
    """The corrections that restore what was before ``entry``, unless it changed since."""
    done, newer = CorrectionRow, aliased(CorrectionRow)
    row, name = MeasurementRow, HeliostatRow.name
    found = session.execute(
        select(done, row.identifier, func.coalesce(row.external_id, row.identifier), name)
        .join(row, row.id == done.measurement_id)
        .join(HeliostatRow, HeliostatRow.id == row.heliostat_id)
        .where(
            done.id.between(entry.detail["first"], entry.detail["last"]),
            done.created_by == entry.actor,
            done.reason == entry.detail["reason"],
        )
    ).all()
    since = select(newer.measurement_id, newer.after).where(newer.id > entry.detail["last"])
    numbers = [correction.measurement_id for correction, *_ in found]
    rows = session.execute(since.where(newer.measurement_id.in_(numbers)))
    changed = {(measurement, field) for measurement, after in rows for field in after}
    given = {
        (heliostat, photograph): _restoring(heliostat, identifier, correction, reason)
        for correction, identifier, photograph, heliostat in found
        if not any(
            (correction.measurement_id, field) in changed
            for field in _FIELDS
            if field in correction.after
        )
    }
    return list(given.values())


def _restoring(
    heliostat: str, identifier: str, correction: CorrectionRow, reason: str
) -> GivenCorrection:
    before = {name: correction.before[name] for name in _FIELDS if name in correction.before}
    taken_at, motors = before.get("taken_at"), before.get("motor_position")
    return GivenCorrection(
        heliostat,
        identifier,
        reason,
        taken_at=None if taken_at is None else datetime.fromisoformat(taken_at),
        motor_position=None if motors is None else (motors[0], motors[1]),
        without=tuple(name for name, value in before.items() if value is None),
    )


_MOMENT = TypeAdapter(Moment)


def given_time(heliostat: str, identifier: str, at: datetime, reason: str) -> GivenCorrection:
    """The time of a heliostat's measurement, submitted later."""
    return GivenCorrection(heliostat, identifier, reason, taken_at=at)


def read_times(
    lines: Iterable[str], where: str, reason: str, zone: str | None = None
) -> list[GivenCorrection]:
    """Times of CSV lines with the columns heliostat, id, taken_at.

    Times without a zone are of ``zone``, and are refused without one. The heading may be missing.

    Raises
    ------
    InvalidInputError
        With ``where`` and the first line that is wrong.
    """

    def correction(row: dict[str, str]) -> GivenCorrection:
        at = _MOMENT.validate_python(_with_zone(row["taken_at"], zone))
        return given_time(row["heliostat"], row["id"], at, reason)

    return _read(lines, where, ("heliostat", "id", "taken_at"), correction)


def read_motors(lines: Iterable[str], where: str, reason: str) -> list[GivenCorrection]:
    """Motor positions [steps] of CSV lines with the columns heliostat, id, motor_1, motor_2.

    The heading may be missing; the errors are those of `read_times`.
    """

    def correction(row: dict[str, str]) -> GivenCorrection:
        steps = TypeAdapter(tuple[float, float]).validate_python((row["motor_1"], row["motor_2"]))
        if not all(abs(one) <= 1e9 for one in steps):
            raise InvalidInputError("motor positions must lie between -1e9 and 1e9 steps")
        return GivenCorrection(row["heliostat"], row["id"], reason, motor_position=steps)

    return _read(lines, where, ("heliostat", "id", "motor_1", "motor_2"), correction)


def _read(
    lines: Iterable[str],
    where: str,
    columns: tuple[str, ...],
    correction: Callable[[dict[str, str]], GivenCorrection],
) -> list[GivenCorrection]:
    text = "\n".join(line.rstrip("\r\n") for line in lines)
    first, *rows = [*csv_lines(where, text)] or [ForeignLine(where, columns)]
    names = first.cells
    if len(names) == len(columns) and names[-1].lstrip("-")[:1].isdigit():  # there is no heading
        names, rows = columns, [first, *rows]
    if not {*columns} <= {*names}:
        raise InvalidInputError(
            f"{where}: needs the columns {', '.join(columns)} in its first line"
        )
    found = []
    for line in rows:
        if len(line.cells) != len(names):
            raise line.refuse(f"has {len(line.cells)} cells, {len(names)} are the columns")
        row = dict(zip(names, line.cells, strict=True))
        try:
            found.append(correction(row))
        except (ValidationError, InvalidInputError) as error:
            said = (
                format_validation_error(error, columns[-1])
                if isinstance(error, ValidationError)
                else str(error)
            )
            raise line.refuse(said) from None
    if not found:
        raise InvalidInputError(f"{where}: holds no {'time' if 'taken_at' in columns else 'motor'}")
    return found


def _with_zone(text: str, zone: str | None) -> object:
    """A time without a zone as one of ``zone``; other text as it is."""
    try:
        at = read_time(text)
    except ValueError:
        return text
    return at.replace(tzinfo=ZoneInfo(zone)) if zone and at.tzinfo is None else text


def shifted_times(
    session: Session, chosen: PhotographFilter, minutes: float, reason: str
) -> list[GivenCorrection]:
    """The times of a selection's photographs, ``minutes`` later.

    Raises
    ------
    InvalidInputError
        If it has no photograph of a known time, or too many.
    """
    groups = list_groups(session, replace(chosen, is_dated=True), MOST_ENTRIES + 1)
    if not 0 < len(groups) <= MOST_ENTRIES:
        raise InvalidInputError(
            f"selection: {f'more than {MOST_ENTRIES}' if groups else 'no'} photographs of a known"
            " time; choose another heliostat, target or days"
        )
    offset = timedelta(minutes=minutes)
    return [
        given_time(group.heliostat, group.best.identifier, group.best.taken_at + offset, reason)
        for group in groups
        if group.best.taken_at is not None
    ]
