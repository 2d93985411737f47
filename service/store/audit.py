"""The audit trail: who did what, written in the same transaction as the action."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import timedelta
from typing import Any

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from model.times import format_time
from service.base.errors import ConflictError
from service.store.columns import now
from service.store.job_tables import AuditRow
from service.store.tables import CorrectionRow


def record(session: Session, actor: str, action: str, subject: str, **detail: Any) -> None:
    """Record that ``actor`` did ``action`` to ``subject``.

    ``actor`` is the name of a key, or of the user at the command line.
    """
    session.add(AuditRow(actor=actor, action=action, subject=subject, detail=detail))


def entries(session: Session, limit: int, after: int | None = None) -> Sequence[AuditRow]:
    """Up to ``limit`` entries older than entry ``after``, newest first."""
    query = select(AuditRow).order_by(AuditRow.id.desc()).limit(limit)
    return session.scalars(query.where(AuditRow.id < after) if after else query).all()


def count_recent(session: Session, subject: str, period: timedelta) -> int:
    """Number of entries about ``subject`` of the latest ``period``."""
    query = select(func.count()).select_from(AuditRow).where(AuditRow.subject == subject)
    return session.scalars(query.where(AuditRow.created_at > now() - period)).one()


def version(session: Session, subject: str, action: str) -> int:
    """Number of the newest ``action`` on ``subject``: the version of what is known of it."""
    return session.scalar(select(func.max(AuditRow.id)).where(*_is(subject, action))) or 0


def _is(subject: str, action: str) -> list[ColumnElement[bool]]:
    return [AuditRow.subject == subject, AuditRow.action == action]


def require_version(session: Session, subject: str, action: str, known: int | None) -> None:
    """Require that ``subject`` is as ``action`` left it at the version ``known``, unless None.

    Raises
    ------
    ConflictError
        If it was changed since. The message names who changed what.
    """
    if known is None:
        return
    newer = select(AuditRow).where(*_is(subject, action), AuditRow.id > known)
    entries = [
        CorrectionRow(
            created_at=row.created_at,
            created_by=row.actor,
            reason=row.detail.get("reason") or action,
            before=row.detail.get("before", {}),
            after=row.detail.get("after", {"it": None}),
        )
        for row in session.scalars(newer.order_by(AuditRow.id))
    ]
    if entries:
        raise ConflictError(f"{'; '.join(list_changes(subject, entries))}. {READ_AGAIN}")


READ_AGAIN = "Nothing of this request was stored; read the new values first"


def list_changes(
    subject: str, entries: Iterable[CorrectionRow], names: Collection[str] | None = None
) -> list[str]:
    """Changes of ``subject`` in words: which of the fields ``names``, by whom, when and why."""
    return [
        f"{subject}: {name} was changed by {entry.created_by} on {format_time(entry.created_at)}"
        f"{_values(name, entry.before, entry.after)} ({entry.reason})"
        for entry in entries
        for name in entry.after
        if names is None or name in names
    ]


def _values(name: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    return f" from {before[name]} to {after[name]}" if name in before else ""
