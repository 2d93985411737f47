"""The audit trail: who did what, written in the same transaction as the action."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store.job_tables import AuditRow


def record(session: Session, actor: str, action: str, subject: str, **detail: Any) -> None:
    """Record that ``actor`` did ``action`` to ``subject``.

    ``actor`` is the name of a key, or of the user at the command line.
    """
    session.add(AuditRow(actor=actor, action=action, subject=subject, detail=detail))


def entries(session: Session, limit: int, after: int | None = None) -> Sequence[AuditRow]:
    """Up to ``limit`` entries older than entry ``after``, newest first."""
    query = select(AuditRow).order_by(AuditRow.id.desc()).limit(limit)
    return session.scalars(query.where(AuditRow.id < after) if after else query).all()
