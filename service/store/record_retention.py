"""Deletion of old jobs, forecasts and audit entries, in batches, oldest first."""

from datetime import timedelta

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from service.store import audit
from service.store.job_tables import AuditRow
from service.store.jobs import queue
from service.store.keys import RESERVED
from service.store.tables import ForecastRow


def prune_jobs(session: Session, age: timedelta, most: int = 500) -> int:
    """Delete and audit up to ``most`` jobs that ended before ``age``; return their number."""
    return _audited(session, "jobs", queue.purge(session, age, most), age)


def prune_plans(session: Session, age: timedelta, most: int = 50) -> int:
    """Delete and audit up to ``most`` plans, with their flux maps, that ended longer than ``age``
    ago; return their number.
    """
    return _audited(session, "plans", queue.purge(session, age, most, plans=True), age)


def prune_forecasts(session: Session, age: timedelta, most: int = 500) -> int:
    """Delete and audit up to ``most`` forecasts older than ``age``; return their number."""
    return _audited(session, "forecasts", _prune(session, ForecastRow, age, most), age)


def prune_audit(session: Session, age: timedelta, most: int = 500) -> int:
    """Delete and audit up to ``most`` audit entries older than ``age``; return their number."""
    return _audited(session, "audit", _prune(session, AuditRow, age, most), age, "entries")


def _audited(session: Session, what: str, count: int, age: timedelta, unit: str = "") -> int:
    """Audit that ``count`` records of a kind were deleted, if any were; return ``count``."""
    if count:
        days = age / timedelta(days=1)
        audit.record(
            session, RESERVED, f"{what}.pruned", f"{count} {unit or what}", older_than_days=days
        )
    return count


def _prune(
    session: Session, table: type[ForecastRow] | type[AuditRow], age: timedelta, most: int
) -> int:
    """Delete the rows older than ``age`` among the ``most`` oldest ones; return their number.

    The newest row always remains, so that no id is used twice. Only the first ``most`` ids are
    read, which are in order of time. So a table of millions of rows costs no more than a small one.
    """
    oldest = select(table.id, table.created_at).order_by(table.id).limit(most).subquery()
    newest = select(func.max(table.id)).scalar_subquery()
    wanted = select(oldest.c.id).where(
        oldest.c.created_at < queue.database_time(session) - age, oldest.c.id < newest
    )
    numbers = session.scalars(wanted).all()
    session.execute(delete(table).where(table.id.in_(numbers)))
    return len(numbers)
