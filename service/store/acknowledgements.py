"""Storage of acknowledged alarms, and of the history of alarms."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session, load_only

from service.base.errors import ConflictError, NotFoundError
from service.store import audit
from service.store.columns import now
from service.store.job_tables import AcknowledgementRow, AlarmRow
from service.store.rows import assign
from service.store.tables import HeliostatRow


class Key(NamedTuple):
    """What identifies an alarm; ``heliostat`` is None for the plant."""

    heliostat: str | None
    reason: str
    fingerprint: str


class StoredAlarm(NamedTuple):
    """An alarm with its heliostat's name and, in its history, acknowledgements, oldest first."""

    heliostat: str | None
    row: AlarmRow
    acknowledgements: Sequence[AcknowledgementRow] = ()


def acknowledged(session: Session) -> dict[Key, AcknowledgementRow]:
    """Return all acknowledgements that were not undone."""
    rows = _acknowledgements().where(AcknowledgementRow.undone_at.is_(None))
    return {_key(name, row): row for name, row in session.execute(rows)}


def _acknowledgements() -> Select[str, AcknowledgementRow]:
    query = select(HeliostatRow.name, AcknowledgementRow).select_from(AcknowledgementRow)
    return query.outerjoin(HeliostatRow, HeliostatRow.id == AcknowledgementRow.heliostat_id)


def _alarms() -> Select[str, AlarmRow]:
    query = select(HeliostatRow.name, AlarmRow).select_from(AlarmRow)
    return query.outerjoin(HeliostatRow, HeliostatRow.id == AlarmRow.heliostat_id)


def _key(heliostat: str | None, row: AcknowledgementRow | AlarmRow) -> Key:
    return Key(heliostat, row.reason, row.fingerprint)


def acknowledge(
    session: Session, keys: Sequence[Key], actor: str, comment: str
) -> list[AcknowledgementRow]:
    """Record that ``actor`` has seen alarms, as one batch. Earlier acknowledgements remain.

    Raises
    ------
    NotFoundError
        If a heliostat was deleted.
    """
    held, ids = acknowledged(session), _heliostat_ids(session)
    rows = {key: held[key] for key in keys if key in held}
    new = {
        key: AcknowledgementRow(
            heliostat_id=_heliostat_id(ids, key),
            reason=key.reason,
            fingerprint=key.fingerprint,
            made_by=actor,
            comment=comment,
        )
        for key in dict.fromkeys(keys)
        if key not in rows
    }
    session.add_all(new.values())
    session.flush()
    batch = min((row.id for row in new.values()), default=None)
    for key, row in new.items():
        row.batch = batch
        _audit(session, actor, "alarm.acknowledged", key, comment=comment)
    return [(rows | new)[key] for key in keys]


def _heliostat_ids(session: Session) -> dict[str, int]:
    rows = session.scalars(select(HeliostatRow).options(load_only(HeliostatRow.name)))
    return {row.name: row.id for row in rows}


def _heliostat_id(ids: Mapping[str, int], key: Key) -> int | None:
    if key.heliostat is not None and key.heliostat not in ids:
        raise NotFoundError(f"Heliostat {key.heliostat} not found.")
    return None if key.heliostat is None else ids[key.heliostat]


def _audit(session: Session, actor: str, action: str, key: Key, **more: object) -> None:
    subject = "plant" if key.heliostat is None else f"heliostat {key.heliostat}"
    about = {"reason": key.reason, "fingerprint": key.fingerprint, **more}
    audit.record(session, actor, action, subject, **about)


def undo(session: Session, batch: int, actor: str) -> list[Key]:
    """Undo the acknowledgements of a batch; return what they were of.

    Raises
    ------
    NotFoundError
        If there is no such batch.
    ConflictError
        If it was undone before.
    """
    rows = session.execute(_acknowledgements().where(AcknowledgementRow.batch == batch))
    found = {_key(name, row): row for name, row in rows}
    if not found:
        raise NotFoundError(f"Acknowledgement {batch} not found.")
    for key, row in found.items():
        if row.undone_at is not None:
            raise ConflictError(
                f"acknowledgement {batch} was undone by {row.undone_by}; acknowledge again"
            )
        row.undone_at, row.undone_by = now(), actor
        _audit(session, actor, "alarm.undone", key, acknowledgement=batch)
    return list(found)


def list_batches(
    session: Session, limit: int, after: int | None = None, number: int | None = None
) -> list[list[AcknowledgementRow]]:
    """Up to ``limit`` batches older than ``after``, newest first, or only batch ``number``."""
    column = AcknowledgementRow.batch
    chosen = select(column).where(column.is_not(None)).distinct().order_by(column.desc())
    if after is not None:
        chosen = chosen.where(column < after)
    if number is not None:
        chosen = chosen.where(column == number)
    numbers = session.scalars(chosen.limit(limit)).all()
    rows: dict[int | None, list[AcknowledgementRow]] = defaultdict(list)
    for row in session.scalars(select(AcknowledgementRow).where(column.in_(numbers))):
        rows[row.batch].append(row)
    return [rows[number] for number in numbers]


def newest_batch(session: Session, heliostat: str, reason: str) -> list[AcknowledgementRow]:
    """The newest batch with an alarm of this reason that was not undone; empty without one."""
    numbers = [
        row.batch
        for key, row in acknowledged(session).items()
        if key[:2] == (heliostat, reason) and row.batch is not None
    ]
    return list_batches(session, 1, number=max(numbers))[0] if numbers else []


# --- history
# --------------------------------------------------------------------------------------------------


def open_with_acknowledgements(*columns: Any) -> Select[Any]:
    """Query columns of present alarms, and of the acknowledgement of each that has one."""
    made, row = AcknowledgementRow, AlarmRow
    is_of_row = (
        (made.fingerprint == row.fingerprint)
        & (made.reason == row.reason)
        & made.heliostat_id.is_not_distinct_from(row.heliostat_id)
        & made.undone_at.is_(None)
    )
    query = select(*columns).select_from(row).outerjoin(made, is_of_row)
    return query.where(row.ended_at.is_(None))


def open_alarms(session: Session) -> list[StoredAlarm]:
    """Return the alarms that are present."""
    query = _alarms().where(AlarmRow.ended_at.is_(None))
    return [StoredAlarm(*found) for found in session.execute(query)]


def count_unacknowledged(session: Session) -> dict[str, int]:
    """The number of present alarms that are not acknowledged, by reason."""
    query = open_with_acknowledgements(AlarmRow.reason, func.count())
    query = query.where(AcknowledgementRow.id.is_(None)).group_by(AlarmRow.reason)
    return {row[0]: row[1] for row in session.execute(query)}


def record_alarms(
    session: Session,
    present: Mapping[Key, Mapping[str, object]],
    ended_at: Callable[[Key, AlarmRow], datetime | None],
) -> set[Key]:
    """Record which alarms are present, each with its columns; return the new ones.

    A recorded one that is not present ends at ``ended_at``, and remains if that is None.
    """
    held = {_key(name, row): row for name, row, _ in open_alarms(session)}
    ids = _heliostat_ids(session)
    for key in held.keys() - present.keys():
        held[key].ended_at = ended_at(key, held[key])
    new = {
        key: AlarmRow(
            heliostat_id=_heliostat_id(ids, key),
            reason=key.reason,
            fingerprint=key.fingerprint,
            **columns,
        )
        for key, columns in present.items()
        if key not in held and (key.heliostat is None or key.heliostat in ids)
    }
    session.add_all(new.values())
    for key in held.keys() & present.keys():
        assign(held[key], dict(present[key]))
    return set(new)


def record_ended(session: Session, ended: Iterable[tuple[Key, Mapping[str, object]]]) -> None:
    """Record alarms that ended before anybody could see them, each once."""
    ids = _heliostat_ids(session)
    for key, columns in ended:
        number, row = ids.get(key.heliostat or ""), AlarmRow
        is_known = (row.heliostat_id == number) & (row.reason == key.reason)
        known = select(row.id).where(is_known, row.since == columns["since"])
        if number is not None and session.scalar(known.limit(1)) is None:
            session.add(
                AlarmRow(
                    heliostat_id=number, reason=key.reason, fingerprint=key.fingerprint, **columns
                )
            )


def list_history(
    session: Session,
    limit: int,
    after: int | None = None,
    reason: str | None = None,
    heliostat: str | None = None,
) -> list[StoredAlarm]:
    """Up to ``limit`` alarms older than record ``after``, the newest first."""
    query = _alarms().order_by(AlarmRow.id.desc()).limit(limit)
    if after is not None:
        query = query.where(AlarmRow.id < after)
    if reason is not None:
        query = query.where(AlarmRow.reason == reason)
    if heliostat is not None:
        query = query.where(HeliostatRow.name == heliostat)
    rows = session.execute(query).all()
    made: dict[Key, list[AcknowledgementRow]] = defaultdict(list)
    seen = _acknowledgements().where(
        AcknowledgementRow.fingerprint.in_({row.fingerprint for _, row in rows})
    )
    for name, row in session.execute(seen.order_by(AcknowledgementRow.id)):
        made[_key(name, row)].append(row)
    return [StoredAlarm(name, row, made[_key(name, row)]) for name, row in rows]
