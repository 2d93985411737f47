"""Creation and cancellation of jobs, for users or by the service itself."""

from service.jobs.kind import Kind, Kinds, Payload, require_stored
from service.jobs.uploads import delete_unused_uploads
from service.store import audit
from service.store.job_tables import JobRow
from service.store.keys import ITSELF
from service.store.queue import QueueBounds, add_job, cancel, delete_plan
from service.store.rows import Added
from service.twin.runtime import Runtime


def enqueue(
    runtime: Runtime,
    kind: Kind[Payload],
    payload: Payload,
    actor: str,
    idempotency_key: str | None = None,
) -> Added[JobRow]:
    """Queue a job like `add_job`, audit it, and wake a worker of this process.

    A payload that has only one job (`Kind.existing`) gets that job.

    Raises
    ------
    NotFoundError
        If the payload of a new job names a heliostat or a target that is not stored.

    The kind's ``require`` may raise others.
    """
    if kind.require is not None:
        kind.require(payload, runtime)
    settings, document = runtime.settings, payload.model_dump(mode="json")
    bounds = QueueBounds(settings.max_queued_jobs, settings.max_queued_jobs_of_key)
    is_short = (
        kind.expected_s is not None and kind.expected_s(payload, runtime) <= settings.short_job_s
    )
    with runtime.database.writing() as session:
        existing = kind.existing and kind.existing(session, payload, settings)
        if existing:
            return Added(existing, False)
        added = row, is_new = add_job(
            session, kind.name, document, actor, idempotency_key, bounds, is_short
        )
        if is_new:
            require_stored(session, document)
            audit.record(session, actor, "job.created", f"job {row.id}", kind=kind.name)
    # A worker for short jobs only may wait, too.
    runtime.job_came.release(2 if row.is_short else 1)
    return added


def enqueue_due(runtime: Runtime, kinds: Kinds) -> None:
    """Queue each periodic job that is due, once for all workers.

    The limits of waiting jobs do not apply.
    """
    for kind in kinds.values():
        if kind.due is None:
            continue
        with runtime.database.reading() as session:
            key = kind.due(session, runtime.settings)
        if key is not None:
            with runtime.database.writing() as session:
                row, is_new = add_job(session, kind.name, {}, ITSELF, key)
                if is_new:
                    audit.record(session, ITSELF, "job.created", f"job {row.id}", kind=kind.name)


def delete_plan_for(runtime: Runtime, number: int, actor: str) -> JobRow:
    """Delete a plan like `delete_plan`, and audit it."""
    with runtime.database.writing() as session:
        row = delete_plan(session, number, actor)
        audit.record(
            session, actor, "plan.deleted", f"job {number}", name=str(row.payload.get("name", ""))
        )
        return row


def cancel_for(runtime: Runtime, number: int, actor: str) -> JobRow:
    """Cancel a job like `cancel`, and audit it."""
    with runtime.database.writing() as session:
        row = cancel(session, number)
        audit.record(session, actor, "job.cancelled", f"job {number}", kind=row.kind)
    delete_unused_uploads(runtime)
    return row
