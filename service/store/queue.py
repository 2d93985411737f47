"""The job queue: a database table, and the functions that change a job's state.

A job is queued, then running, then done, failed or cancelled. After an error it is queued again
with a delay. A worker holds a lease and renews it. When the lease expires, another worker may take
the job. Each lease has a token, and a worker can write only while the job has that token. So a
worker that lost its lease changes nothing, and a job ends exactly once.

Every function that writes takes a session of `Database.writing`. On SQLite this holds the only
write lock. On PostgreSQL rows are locked one by one, and rows that another worker holds are
skipped.

Keys take turns: the next job is the oldest one of the key that has waited longest for a turn. So a
user who queues a thousand jobs delays others by one job at a time.
"""

import uuid
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, Select, and_, delete, func, not_, or_, select, update
from sqlalchemy.orm import Session, aliased, defer, undefer

from service.base.errors import ConflictError, IdempotencyReuseError, NotFoundError, TooManyError
from service.store.columns import now
from service.store.job_tables import JobRow, JobStepRow
from service.store.listing import Portion
from service.store.rows import Added, insert

ENDED = ("done", "failed", "cancelled")
"""Final states of a job."""


LONGEST_PAUSE_S = 600.0
"""Longest delay before a retry [s]."""


class LeaseLostError(Exception):
    """Another worker holds the job, or it has ended. Nothing may be written to it."""


@dataclass(frozen=True)
class Lease:
    """A worker's right to write to a job."""

    job_id: int
    token: str


@dataclass(frozen=True)
class Progress:
    """Progress of a job: the completed ``share`` (0 to 1), and the current activity.

    ``phase`` describes the units of ``n_done`` and ``n_total``. ``remaining_s`` [s] is the expected
    time to the job's end.
    """

    share: float
    message: str = ""
    phase: str = ""
    n_done: int | None = None
    n_total: int | None = None
    remaining_s: float | None = None


@dataclass(frozen=True)
class QueueBounds:
    """Limits of waiting jobs, in total and per key; None means unlimited."""

    queued: int | None = None
    queued_of_key: int | None = None


def database_time(session: Session) -> datetime:
    """The current time of the clock that all workers share.

    This is PostgreSQL's clock, or the machine's clock with SQLite.
    """
    if session.get_bind().dialect.name == "postgresql":
        moment: datetime = session.scalars(select(func.clock_timestamp())).one()
        return moment
    return now()


def add_job(
    session: Session,
    kind: str,
    payload: dict[str, object],
    created_by: str,
    idempotency_key: str | None = None,
    bounds: QueueBounds | None = None,
    is_short: bool = False,
) -> Added[JobRow]:
    """Queue a job, or find that of the same ``idempotency_key``.

    ``is_short`` jobs are expected to take seconds.

    Raises
    ------
    IdempotencyReuseError
        If the same sender used the key for another request.
    TooManyError
        If as many jobs wait already as ``bounds`` allow.
    """
    row = _find_by_idempotency_key(session, kind, payload, created_by, idempotency_key)
    if row is not None:
        return Added(row, False)
    _require_capacity(session, created_by, bounds or QueueBounds())
    at = database_time(session)
    row = JobRow(
        kind=kind,
        payload=payload,
        created_by=created_by,
        idempotency_key=idempotency_key,
        is_short=is_short,
        created_at=at,
        not_before=at,
    )
    if insert(session, row):
        return Added(row, True)
    # A concurrent request with the same key was first, so its job exists now.
    known = _find_by_idempotency_key(session, kind, payload, created_by, idempotency_key)
    assert known is not None
    return Added(known, False)


def _require_capacity(session: Session, created_by: str, bounds: QueueBounds) -> None:
    queued = select(func.count()).select_from(JobRow).where(JobRow.state == "queued")
    if bounds.queued is not None and session.scalars(queued).one() >= bounds.queued:
        raise TooManyError(f"{bounds.queued} jobs are waiting; ask again when some are done")
    of_key = queued.where(JobRow.created_by == created_by)
    if bounds.queued_of_key is not None and session.scalars(of_key).one() >= bounds.queued_of_key:
        raise TooManyError(
            f"{bounds.queued_of_key} jobs of key {created_by} are waiting; ask again when some are"
            " done"
        )


def _find_by_idempotency_key(
    session: Session,
    kind: str,
    payload: dict[str, object],
    created_by: str,
    idempotency_key: str | None,
) -> JobRow | None:
    if idempotency_key is None:
        return None
    query = select(JobRow).where(
        JobRow.created_by == created_by, JobRow.idempotency_key == idempotency_key
    )
    row = session.scalar(query)
    if row is not None and (row.kind, row.payload) != (kind, payload):
        raise IdempotencyReuseError(
            f"Idempotency-Key: it named another request (job {row.id}); choose a new one"
        )
    return row


# Large columns. Reading one of them from a job's summary is a programming error.
_IN_SHORT = (defer(JobRow.payload, raiseload=True), defer(JobRow.result, raiseload=True))


def get_job(session: Session, number: int, arrays: bool = False) -> JobRow:
    """A job, with its ``arrays`` on request; NotFoundError if there is none."""
    query = select(JobRow).where(JobRow.id == number)
    row = session.scalar(query.options(undefer(JobRow.arrays)) if arrays else query)
    if row is None:
        raise NotFoundError(f"there is no job {number}")
    return row


def get_summaries(session: Session, numbers: Collection[int]) -> Sequence[JobRow]:
    """The existing jobs among ``numbers``, without payload and result."""
    return session.scalars(select(JobRow).options(*_IN_SHORT).where(JobRow.id.in_(numbers))).all()


def get_summary(session: Session, number: int) -> JobRow:
    """A job without payload and result; NotFoundError if there is none."""
    for row in get_summaries(session, [number]):
        return row
    raise NotFoundError(f"there is no job {number}")


def list_jobs(
    session: Session, portion: Portion, state: str | None = None, kind: str | None = None
) -> Sequence[JobRow]:
    """A portion of the jobs, without payload and result."""
    query = select(JobRow).options(*_IN_SHORT)
    for column, wanted in ((JobRow.state, state), (JobRow.kind, kind)):
        query = query if wanted is None else query.where(column == wanted)
    return session.scalars(portion.of(session, query, JobRow)).all()


def cancel(session: Session, number: int) -> JobRow:
    """Cancel a job: at once if no worker runs it, else by a request to its worker.

    Raises
    ------
    NotFoundError
        If there is no such job.
    ConflictError
        If it is already done or failed.
    """
    row = session.scalar(select(JobRow).where(JobRow.id == number).with_for_update())
    if row is None:
        raise NotFoundError(f"there is no job {number}")
    if row.state in ("done", "failed"):
        raise ConflictError(f"job {number} has ended already: {row.state}")
    at = database_time(session)
    if row.state == "queued" or (
        row.state == "running" and row.lease_until is not None and row.lease_until < at
    ):
        _end(session, row, "cancelled", at)
    elif row.state == "running" and not row.cancel_requested:
        row.cancel_requested = True
        row.revision += 1
    return row


def _claimable(
    kinds: Collection[str], at: datetime, lease_s: float, only_short: bool
) -> ColumnElement[bool]:
    """Condition for jobs that a worker may take.

    A time implausibly far in the future counts as past, because the clock must have been set back.
    """
    too_late, too_long = (
        at + timedelta(seconds=LONGEST_PAUSE_S),
        at + timedelta(seconds=2 * lease_s),
    )
    waiting = and_(
        JobRow.state == "queued", or_(JobRow.not_before <= at, JobRow.not_before > too_late)
    )
    lost = and_(
        JobRow.state == "running", or_(JobRow.lease_until < at, JobRow.lease_until > too_long)
    )
    some = and_(JobRow.kind.in_(kinds), or_(waiting, lost))
    return and_(some, JobRow.is_short) if only_short else some


def _next(claimable: ColumnElement[bool]) -> Select[JobRow]:
    """Select the oldest job of the key that has waited longest for a turn."""
    keys = select(JobRow.created_by).where(claimable).distinct().subquery()
    other = aliased(JobRow)
    last_turn = (
        select(func.max(other.attempted_at))
        .where(other.created_by == keys.c.created_by)
        .scalar_subquery()
    )
    turns = select(keys.c.created_by, last_turn.label("last")).subquery()
    return (
        select(JobRow)
        .join(turns, JobRow.created_by == turns.c.created_by)
        .where(claimable)
        .order_by(turns.c.last.nulls_first(), JobRow.id)
        .limit(1)
    )


def has_claimable(
    session: Session, kinds: Collection[str], lease_s: float, only_short: bool = False
) -> bool:
    """Whether there is a job to take, checked without a lock."""
    query = (
        select(JobRow.id)
        .where(_claimable(kinds, database_time(session), lease_s, only_short))
        .limit(1)
    )
    return session.scalar(query) is not None


def claim(
    session: Session,
    kinds: Collection[str],
    worker: str,
    lease_s: float,
    attempts: int,
    only_short: bool = False,
) -> JobRow | None:
    """Take a waiting job or one whose worker was lost; None if there is none. Keys take turns.

    ``only_short`` restricts this to jobs that are expected to take seconds. A job fails if it lost
    its worker ``attempts`` times without progress, because the job may be what kills its workers.
    """
    at = database_time(session)
    query = _next(_claimable(kinds, at, lease_s, only_short)).with_for_update(
        skip_locked=True, of=JobRow
    )
    while (row := session.scalar(query)) is not None:
        if row.cancel_requested:
            _end(session, row, "cancelled", at)
        elif (lost := row.attempts - row.attempts_before_progress) >= attempts:
            row.reason = f"its worker was lost {lost} times, the last one {row.worker}"
            _end(session, row, "failed", at)
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
    row.attempted_at = at
    row.revision += 1


def lease_of(row: JobRow) -> Lease:
    """The lease of a job from `claim`."""
    assert row.lease_token is not None
    return Lease(row.id, row.lease_token)


def _leased(session: Session, lease: Lease) -> JobRow:
    """The locked job of a lease; LeaseLostError if the lease is no longer valid."""
    query = select(JobRow).where(JobRow.id == lease.job_id, JobRow.lease_token == lease.token)
    row = session.scalar(query.options(*_IN_SHORT).with_for_update())
    if row is None:
        raise LeaseLostError(f"job {lease.job_id}")
    return row


def renew(session: Session, lease: Lease, lease_s: float) -> bool:
    """Extend the lease by ``lease_s``, and return whether cancellation was requested."""
    row = _leased(session, lease)
    row.lease_until = database_time(session) + timedelta(seconds=lease_s)
    return row.cancel_requested


def report(session: Session, lease: Lease, progress: Progress) -> bool:
    """Store the progress, and return whether cancellation was requested."""
    row = _leased(session, lease)
    row.progress, row.message = min(max(progress.share, 0.0), 1.0), _text(progress.message, 200)
    row.phase, row.n_done, row.n_total = (
        _text(progress.phase, 100),
        progress.n_done,
        progress.n_total,
    )
    row.remaining_s = progress.remaining_s
    row.revision += 1
    return row.cancel_requested


def is_cancelled(session: Session, lease: Lease) -> bool:
    """Whether cancellation was requested, read without a lock.

    Raises
    ------
    LeaseLostError
        If another worker holds the job.
    """
    query = select(JobRow.cancel_requested).where(
        JobRow.id == lease.job_id, JobRow.lease_token == lease.token
    )
    requested = session.scalar(query)
    if requested is None:
        raise LeaseLostError(f"job {lease.job_id}")
    return requested


def _text(text: str, most: int) -> str:
    """Make text storable in both databases: no NUL, no lone surrogates, at most ``most``
    characters.
    """
    return text.encode("utf-8", "replace").decode("utf-8").replace("\x00", "")[:most]


def save_checkpoint(
    session: Session,
    lease: Lease,
    name: str,
    result: Mapping[str, object],
    arrays: bytes | None = None,
) -> None:
    """Store a completed step of the job, in the same transaction as its effects.

    This resets the count of attempts without progress.
    """
    row = _leased(session, lease)
    row.attempts_before_progress = row.attempts - 1
    session.add(JobStepRow(job_id=lease.job_id, name=name, result=dict(result), arrays=arrays))


def delete_checkpoint(session: Session, lease: Lease, name: str) -> None:
    """Delete a step of the job that is no longer needed."""
    _leased(session, lease)
    session.execute(
        delete(JobStepRow).where(JobStepRow.job_id == lease.job_id, JobStepRow.name == name)
    )


def checkpoint_arrays(session: Session, number: int, name: str) -> bytes | None:
    """The arrays of one step of a job; None if there are none."""
    return session.scalar(
        select(JobStepRow.arrays).where(JobStepRow.job_id == number, JobStepRow.name == name)
    )


def load_checkpoints(session: Session, number: int) -> dict[str, dict[str, Any]]:
    """The results of a job's completed steps, by name."""
    rows = session.scalars(
        select(JobStepRow).where(JobStepRow.job_id == number).order_by(JobStepRow.name)
    )
    return {row.name: row.result for row in rows}


def load_checkpoint(session: Session, number: int, name: str) -> Mapping[str, Any] | None:
    """The result of one completed step of a job; None if there is none."""
    return session.scalar(
        select(JobStepRow.result).where(JobStepRow.job_id == number, JobStepRow.name == name)
    )


def _end(session: Session, row: JobRow, state: str, at: datetime) -> None:
    row.state, row.finished_at = state, at
    if state != "done":  # Nobody reads these megabytes any more.
        session.execute(update(JobStepRow).where(JobStepRow.job_id == row.id).values(arrays=None))
    row.lease_token = row.lease_until = row.remaining_s = None
    row.revision += 1


def finish(
    session: Session, lease: Lease, result: Mapping[str, object], arrays: bytes | None = None
) -> None:
    """Store the job's result and end it as done."""
    row = _leased(session, lease)
    row.result, row.arrays, row.progress, row.reason = dict(result), arrays, 1.0, None
    _end(session, row, "done", database_time(session))


def fail(session: Session, lease: Lease, reason: str) -> None:
    """End the job as failed."""
    row = _leased(session, lease)
    row.reason = _text(reason, 1000)
    _end(session, row, "failed", database_time(session))


def stop(session: Session, lease: Lease) -> None:
    """End the job as cancelled."""
    _end(session, _leased(session, lease), "cancelled", database_time(session))


def retry(session: Session, lease: Lease, reason: str, delay_s: float) -> None:
    """Queue the job again after ``delay_s`` seconds; ``reason`` describes the error meanwhile."""
    row = _leased(session, lease)
    row.reason = _text(reason, 1000)
    _requeue(row, database_time(session) + timedelta(seconds=delay_s))


def release(session: Session, lease: Lease) -> None:
    """Return the job to the queue because its worker stops. This attempt does not count."""
    row = _leased(session, lease)
    row.attempts -= 1
    row.attempts_before_progress = min(row.attempts_before_progress, row.attempts)
    _requeue(row, database_time(session))


KEPT = "plans"
"""Kind of jobs whose named results are kept, with a separate retention time."""


def purge(session: Session, age: timedelta, most: int = 500, plans: bool = False) -> int:
    """Delete up to ``most`` jobs that ended longer than ``age`` ago, and return their number.

    With ``plans`` these are completed jobs of the kind `KEPT`, else all others. The newest job
    remains, so that no number is used twice.
    """
    is_kept = (JobRow.kind == KEPT) & (JobRow.state == "done")
    newest = select(func.max(JobRow.id)).scalar_subquery()
    ended = select(JobRow.id).where(
        JobRow.state.in_(ENDED), JobRow.finished_at < database_time(session) - age
    )
    ended = ended.where(JobRow.id < newest, is_kept if plans else not_(is_kept))
    numbers = session.scalars(ended.order_by(JobRow.id).limit(most)).all()
    session.execute(delete(JobStepRow).where(JobStepRow.job_id.in_(numbers)))
    session.execute(delete(JobRow).where(JobRow.id.in_(numbers)))
    return len(numbers)


def delete_plan(session: Session, number: int, by: str) -> JobRow:
    """Delete the result of a job of the kind `KEPT`. The job then counts as cancelled.

    Raises
    ------
    NotFoundError
        If there is no such job.
    ConflictError
        If the job is of another kind, or has no result.
    """
    row = session.get(JobRow, number, with_for_update=True)
    if row is None:
        raise NotFoundError(f"job {number} is not known")
    if row.kind != KEPT or row.state != "done":
        raise ConflictError(
            f"job {number}: only plans that are done can be deleted; cancel what is under way"
        )
    row.state, row.reason = "cancelled", _text(f"deleted by {by}", 1000)
    row.result = row.arrays = None
    row.revision += 1
    session.execute(delete(JobStepRow).where(JobStepRow.job_id == number))
    return row


def _requeue(row: JobRow, not_before: datetime) -> None:
    row.state, row.not_before = "queued", not_before
    row.lease_token = row.lease_until = row.remaining_s = None
    row.revision += 1
