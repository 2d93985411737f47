"""What is kept for a time only: jobs, forecasts and the audit trail. A few rows at a time, oldest first."""

from datetime import timedelta

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from service.store import audit, queue
from service.store.job_tables import AuditRow
from service.store.keys import RESERVED
from service.store.tables import ForecastRow


def prune_jobs(session: Session, age: timedelta, most: int = 500) -> int:
    """Delete up to ``most`` jobs that ended longer than ``age`` ago, note that, and say how many."""
    count = queue.purge(session, age, most)
    if count:
        audit.record(session, RESERVED, "jobs.pruned", f"{count} jobs", older_than_days=age / timedelta(days=1))
    return count


def prune_forecasts(session: Session, age: timedelta, most: int = 500) -> int:
    """Delete up to ``most`` forecasts that are older than ``age``, note that, and say how many."""
    count = _prune(session, ForecastRow, age, most)
    if count:
        audit.record(
            session, RESERVED, "forecasts.pruned", f"{count} forecasts", older_than_days=age / timedelta(days=1)
        )
    return count


def prune_audit(session: Session, age: timedelta, most: int = 500) -> int:
    """Delete up to ``most`` entries of the audit trail that are older than ``age``, note that, and say how many."""
    count = _prune(session, AuditRow, age, most)
    if count:
        audit.record(session, RESERVED, "audit.pruned", f"{count} entries", days=age / timedelta(days=1))
    return count


def _prune(session: Session, table: type[ForecastRow] | type[AuditRow], age: timedelta, most: int) -> int:
    """Of the oldest rows those that are too old; the newest of all stays, so that no number is given twice.

    Only so many rows are looked at, in the order of their numbers, which is that of time: a table of millions with
    nothing too old in it costs no more than one of a few.
    """
    at = AuditRow.at if table is AuditRow else ForecastRow.created_at
    oldest = select(table.id, at.label("at")).order_by(table.id).limit(most).subquery()
    newest = select(func.max(table.id)).scalar_subquery()
    wanted = select(oldest.c.id).where(oldest.c.at < queue.clock(session) - age, oldest.c.id < newest)
    numbers = session.scalars(wanted).all()
    session.execute(delete(table).where(table.id.in_(numbers)))
    return len(numbers)
