"""Asking for a job and cancelling one, on somebody's behalf or on the service's own."""

from typing import Any

from service.jobs.kind import Kinds
from service.store import audit
from service.store.job_tables import JobRow
from service.store.keys import ITSELF
from service.store.queue import add_job, cancel, forget
from service.twin.runtime import Runtime


def ask_for(
    runtime: Runtime, kind: str, payload: dict[str, Any], actor: str, idempotency_key: str | None = None
) -> JobRow:
    """Queue a job as `add_job` does, with its entry in the audit trail, and wake a worker of this process."""
    with runtime.database.writing() as session:
        most = runtime.settings.max_queued_jobs
        row, is_new = add_job(session, kind, payload, actor, idempotency_key, most)
        if is_new:
            audit.record(session, actor, "job.created", f"job {row.id}", kind=kind)
    runtime.job_came.release()
    return row


def begin_due(runtime: Runtime, kinds: Kinds) -> None:
    """Queue the jobs that are due by themselves, each once, however many workers ask and however many others wait."""
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


def forget_for(runtime: Runtime, number: int, actor: str) -> JobRow:
    """Delete a plan as `forget` does, with its entry in the audit trail."""
    with runtime.database.writing() as session:
        row = forget(session, number, actor)
        audit.record(session, actor, "plan.deleted", f"job {number}", name=str(row.payload.get("name", "")))
        return row


def cancel_for(runtime: Runtime, number: int, actor: str) -> JobRow:
    """Cancel a job as `cancel` does, with its entry in the audit trail."""
    with runtime.database.writing() as session:
        row = cancel(session, number)
        audit.record(session, actor, "job.cancelled", f"job {number}", kind=row.kind)
        return row
