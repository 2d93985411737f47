"""The audit trail: who did what when, written in the same transaction as the deed."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store.job_tables import AuditRow


def record(session: Session, actor: str, action: str, subject: str, **detail: Any) -> None:
    """Note that ``actor`` (a key's name, or who works at the command line) did ``action`` to ``subject``."""
    session.add(AuditRow(actor=actor, action=action, subject=subject, detail=detail))


def entries(session: Session, limit: int, after: int | None = None) -> Sequence[AuditRow]:
    """Up to ``limit`` entries, newest first, those older than entry ``after``."""
    query = select(AuditRow).order_by(AuditRow.id.desc()).limit(limit)
    return session.scalars(query.where(AuditRow.id < after) if after else query).all()
