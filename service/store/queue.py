"""The queue: a table of jobs in the store's own database, and the few ways in which a job changes.

A job is queued, then running, then done, failed or cancelled; after a fault it is queued again for later. A worker
works under a lease: it renews it while it lives, and once the lease has run out another worker may take the job. Each
lease has a token of its own, and everything that a worker writes is written only while the job still bears that token.
So a worker that was given up, and only slept, changes nothing any more, and a job ends exactly once.

Every function that writes takes a session of `Database.writing`: on SQLite that holds the only write lock, on
PostgreSQL rows are locked one by one, and those that another worker holds are skipped.
"""

import uuid
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import Select, and_, delete, func, not_, or_, select
from sqlalchemy.orm import Session, defer, undefer

from model.errors import InvalidInputError
from service.base.faults import ConflictError, NotFoundError, TooManyError
from service.store.columns import now
from service.store.job_tables import JobRow, JobStepRow
from service.store.rows import insert

ENDED = ("done", "failed", "cancelled")
"""States that a job does not leave."""


LONGEST_PAUSE_S = 600.0
"""Longest pause before a job is tried again [s]."""


class LeaseLostError(Exception):
    """The job is another worker's by now, or has ended; nothing may be written to it."""


@dataclass(frozen=True)
class Lease:
    """A worker's right to write to a job."""

    job_id: int
    token: str


def clock(session: Session) -> datetime:
    """The present moment by the clock that all workers share: PostgreSQL's, or this machine's for SQLite."""
    if session.get_bind().dialect.name == "postgresql":
        moment: datetime = session.scalars(select(func.clock_timestamp())).one()
        return moment
    return now()


def add_job(
    session: Session,
    kind: str,
    payload: dict[str, Any],
    created_by: str,
    idempotency_key: str | None = None,
    most_queued: int | None = None,
) -> tuple[JobRow, bool]:
    """Queue a job; the second value is False where this sender's ``idempotency_key`` named it before.

    Raises
    ------
    InvalidInputError
        Where the key named another request.
    TooManyError
        Where ``most_queued`` jobs wait already.
    """
    row = _find_repeated(session, kind, payload, created_by, idempotency_key)
    if row is not None:
        return row, False
    if most_queued is not None and _count_queued(session) >= most_queued:
        raise TooManyError(f"{most_queued} jobs are waiting; ask again when some are done")
    at = clock(session)
    row = JobRow(
        kind=kind,
        payload=payload,
        created_by=created_by,
        idempotency_key=idempotency_key,
        created_at=at,
        not_before=at,
    )
    if insert(session, row):
        return row, True
    # Another request with the same key was first; its job is there now.
    known = _find_repeated(session, kind, payload, created_by, idempotency_key)
    assert known is not None
    return known, False


def _count_queued(session: Session) -> int:
    return session.scalars(select(func.count()).select_from(JobRow).where(JobRow.state == "queued")).one()


def _find_repeated(
    session: Session, kind: str, payload: dict[str, Any], created_by: str, idempotency_key: str | None
) -> JobRow | None:
    if idempotency_key is None:
        return None
    query = select(JobRow).where(JobRow.created_by == created_by, JobRow.idempotency_key == idempotency_key)
    row = session.scalar(query)
    if row is not None and (row.kind, row.payload) != (kind, payload):
        raise InvalidInputError(f"Idempotency-Key: it named another request (job {row.id}); choose a new one")
    return row


# What may be megabytes; whoever reads a job in short and asks for one of them made a mistake.
_IN_SHORT = (defer(JobRow.payload, raiseload=True), defer(JobRow.result, raiseload=True))


def get_job(session: Session, number: int, arrays: bool = False) -> JobRow:
    """A job, with its ``arrays`` where wanted; NotFoundError where there is none."""
    query = select(JobRow).where(JobRow.id == number)
    row = session.scalar(query.options(undefer(JobRow.arrays)) if arrays else query)
    if row is None:
        raise NotFoundError(f"there is no job {number}")
    return row


def get_summaries(session: Session, numbers: Collection[int]) -> Sequence[JobRow]:
    """Those of these jobs that there are, in short: without payload and result."""
    return session.scalars(select(JobRow).options(*_IN_SHORT).where(JobRow.id.in_(numbers))).all()


def get_summary(session: Session, number: int) -> JobRow:
    """A job in short; NotFoundError where there is none."""
    for row in get_summaries(session, [number]):
        return row
    raise NotFoundError(f"there is no job {number}")


def list_jobs(
    session: Session, limit: int, after: int | None = None, state: str | None = None, kind: str | None = None
) -> Sequence[JobRow]:
    """Up to ``limit`` jobs in short, newest first, those older than job ``after``."""
    query = select(JobRow).options(*_IN_SHORT).order_by(JobRow.id.desc()).limit(limit)
    for column, wanted in ((JobRow.state, state), (JobRow.kind, kind)):
        query = query if wanted is None else query.where(column == wanted)
    return session.scalars(query.where(JobRow.id < after) if after else query).all()


def cancel(session: Session, number: int) -> JobRow:
    """Cancel a job: at once where nobody works at it, else its worker is asked to stop.

    Raises
    ------
    NotFoundError
    ConflictError
        Where it has ended otherwise.
    """
    row = session.scalar(select(JobRow).where(JobRow.id == number).with_for_update())
    if row is None:
        raise NotFoundError(f"there is no job {number}")
    if row.state in ("done", "failed"):
        raise ConflictError(f"job {number} has ended already: {row.state}")
    at = clock(session)
    if row.state == "queued" or (row.state == "running" and row.lease_until is not None and row.lease_until < at):
        _end(row, "cancelled", at)
    elif row.state == "running" and not row.cancel_requested:
        row.cancel_requested = True
        row.revision += 1
    return row


def _claimable(kinds: Collection[str], at: datetime, lease_s: float) -> Select[JobRow]:
    """Jobs that may be taken; also where a moment lies so far ahead that the clock must have been set back since."""
    too_late, too_long = at + timedelta(seconds=LONGEST_PAUSE_S), at + timedelta(seconds=2 * lease_s)
    waiting = and_(JobRow.state == "queued", or_(JobRow.not_before <= at, JobRow.not_before > too_late))
    lost = and_(JobRow.state == "running", or_(JobRow.lease_until < at, JobRow.lease_until > too_long))
    return select(JobRow).where(JobRow.kind.in_(kinds), or_(waiting, lost)).order_by(JobRow.id).limit(1)


def has_claimable(session: Session, kinds: Collection[str], lease_s: float) -> bool:
    """Whether there is something to take, told without a lock."""
    return session.scalar(_claimable(kinds, clock(session), lease_s).with_only_columns(JobRow.id)) is not None


def claim(session: Session, kinds: Collection[str], worker: str, lease_s: float, attempts: int) -> JobRow | None:
    """Take the oldest job that waits or whose worker was lost; None where there is none.

    A job that was tried ``attempts`` times and lost its worker each time ends failed: it may be what kills them.
    """
    at = clock(session)
    while (row := session.scalar(_claimable(kinds, at, lease_s).with_for_update(skip_locked=True))) is not None:
        if row.cancel_requested:
            _end(row, "cancelled", at)
        elif row.attempts >= attempts:
            row.reason = f"its worker was lost {row.attempts} times, the last one {row.worker}"
            _end(row, "failed", at)
        else:
            _begin(row, worker, at, lease_s)
            return row
        session.flush()
    return None


def _begin(row: JobRow, worker: str, at: datetime, lease_s: float) -> None:
    row.state = "running"
    row.attempts += 1
    row.worker = worker
    row.lease_token = uuid.uuid4().hex
    row.lease_until = at + timedelta(seconds=lease_s)
    row.started_at = row.started_at or at
    row.revision += 1


def lease_of(row: JobRow) -> Lease:
    """The lease of a job that `claim` just gave."""
    assert row.lease_token is not None
    return Lease(row.id, row.lease_token)


def _held(session: Session, lease: Lease) -> JobRow:
    """The job, locked, while it bears the lease's token; LeaseLostError otherwise."""
    query = select(JobRow).where(JobRow.id == lease.job_id, JobRow.lease_token == lease.token)
    row = session.scalar(query.options(*_IN_SHORT).with_for_update())
    if row is None:
        raise LeaseLostError(f"job {lease.job_id}")
    return row


def renew(session: Session, lease: Lease, lease_s: float) -> bool:
    """Hold the job for another ``lease_s``; whether it shall be cancelled."""
    row = _held(session, lease)
    row.lease_until = clock(session) + timedelta(seconds=lease_s)
    return row.cancel_requested


def report(session: Session, lease: Lease, progress: float, message: str) -> bool:
    """Say how far the job is, 0 to 1; whether it shall be cancelled."""
    row = _held(session, lease)
    row.progress, row.message = min(max(progress, 0.0), 1.0), _text(message, 200)
    row.revision += 1
    return row.cancel_requested


def _text(text: str, most: int) -> str:
    """What both databases hold as text: no NUL, no half characters, no more than the column's length."""
    return text.encode("utf-8", "replace").decode("utf-8").replace("\x00", "")[:most]


def keep_step(session: Session, lease: Lease, name: str, result: dict[str, Any]) -> None:
    """Note a part of the job as done, in the same transaction as what it did."""
    _held(session, lease)
    session.add(JobStepRow(job_id=lease.job_id, name=name, result=result))


def steps(session: Session, number: int) -> dict[str, dict[str, Any]]:
    """The parts of a job that are done, by name, with what they gave."""
    rows = session.scalars(select(JobStepRow).where(JobStepRow.job_id == number).order_by(JobStepRow.name))
    return {row.name: row.result for row in rows}


def _end(row: JobRow, state: str, at: datetime) -> None:
    row.state, row.finished_at = state, at
    row.lease_token = row.lease_until = None
    row.revision += 1


def finish(session: Session, lease: Lease, result: dict[str, Any], arrays: bytes | None = None) -> None:
    """Store the job's result: the one result that it will ever have."""
    row = _held(session, lease)
    row.result, row.arrays, row.progress, row.reason = result, arrays, 1.0, None
    _end(row, "done", clock(session))


def fail(session: Session, lease: Lease, reason: str) -> None:
    """End the job without a result."""
    row = _held(session, lease)
    row.reason = _text(reason, 1000)
    _end(row, "failed", clock(session))


def stop(session: Session, lease: Lease) -> None:
    """End the job because that was asked for."""
    _end(_held(session, lease), "cancelled", clock(session))


def retry(session: Session, lease: Lease, reason: str, delay_s: float) -> None:
    """Queue the job again, to be taken up after ``delay_s``; the fault stands in its ``reason`` meanwhile."""
    row = _held(session, lease)
    row.reason = _text(reason, 1000)
    _requeue(row, clock(session) + timedelta(seconds=delay_s))


def release(session: Session, lease: Lease) -> None:
    """Put the job back because its worker is told to stop; this attempt does not count."""
    row = _held(session, lease)
    row.attempts -= 1
    _requeue(row, clock(session))


KEPT = "plans"
"""The kind of job whose results are kept until somebody deletes them: they have names, and are opened again."""


def purge(session: Session, age: timedelta, most: int = 500) -> int:
    """Delete up to ``most`` jobs that ended longer than ``age`` ago, and say how many; none that is `KEPT`.

    The newest job stays, so that no number is given twice.
    """
    newest = select(func.max(JobRow.id)).scalar_subquery()
    ended = select(JobRow.id).where(JobRow.state.in_(ENDED), JobRow.finished_at < clock(session) - age)
    ended = ended.where(JobRow.id < newest, not_((JobRow.kind == KEPT) & (JobRow.state == "done")))
    numbers = session.scalars(ended.order_by(JobRow.id).limit(most)).all()
    session.execute(delete(JobStepRow).where(JobStepRow.job_id.in_(numbers)))
    session.execute(delete(JobRow).where(JobRow.id.in_(numbers)))
    return len(numbers)


def forget(session: Session, number: int, by: str) -> JobRow:
    """Give up the result of a job that is `KEPT`: from then on it is one that ended as any other.

    Raises
    ------
    NotFoundError
    ConflictError
        Where the job is no such one, or has no result.
    """
    row = session.get(JobRow, number, with_for_update=True)
    if row is None:
        raise NotFoundError(f"job {number} is not known")
    if row.kind != KEPT or row.state != "done":
        raise ConflictError(f"job {number}: only plans that are done can be deleted; cancel what is under way")
    row.state, row.reason = "cancelled", _text(f"deleted by {by}", 1000)
    row.result = row.arrays = None
    row.revision += 1
    return row


def _requeue(row: JobRow, not_before: datetime) -> None:
    row.state, row.not_before = "queued", not_before
    row.lease_token = row.lease_until = None
    row.revision += 1
