"""Who has seen what needs attention, as it is kept and found again."""

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store import audit
from service.store.job_tables import AcknowledgementRow
from service.store.rows import one_at_a_time
from service.store.tables import HeliostatRow

Key = tuple[str | None, str, str]
"""A heliostat's name, None for the plant; the reason; and the mark of what is the reason."""


def acknowledged(session: Session) -> dict[Key, AcknowledgementRow]:
    """All that was acknowledged."""
    query = select(HeliostatRow.name, AcknowledgementRow).select_from(AcknowledgementRow)
    rows = session.execute(query.outerjoin(HeliostatRow, HeliostatRow.id == AcknowledgementRow.heliostat_id))
    return {(name, row.reason, row.mark): row for name, row in rows}


def acknowledge(
    session: Session, heliostat: HeliostatRow | None, reason: str, mark: str, actor: str
) -> AcknowledgementRow:
    """Note that ``actor`` has seen it; the first who did stays."""
    one_at_a_time(session)
    row = AcknowledgementRow(heliostat_id=heliostat and heliostat.id, reason=reason, mark=mark, made_by=actor)
    same = select(AcknowledgementRow).where(AcknowledgementRow.reason == reason, AcknowledgementRow.mark == mark)
    held = session.scalar(same.where(AcknowledgementRow.heliostat_id.is_not_distinct_from(row.heliostat_id)).limit(1))
    if held is not None:
        return held
    session.add(row)
    session.flush()
    subject = "plant" if heliostat is None else f"heliostat {heliostat.name}"
    audit.record(session, actor, "attention.acknowledged", subject, reason=reason, mark=mark)
    return row
