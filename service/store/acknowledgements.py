"""Storage of acknowledged alerts."""

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store import audit
from service.store.job_tables import AcknowledgementRow
from service.store.rows import serialize_writers
from service.store.tables import HeliostatRow

Key = tuple[str | None, str, str]
"""Heliostat name (None for the plant), reason and fingerprint of an alert."""


def acknowledged(session: Session) -> dict[Key, AcknowledgementRow]:
    """Return all acknowledgements."""
    query = select(HeliostatRow.name, AcknowledgementRow).select_from(AcknowledgementRow)
    rows = session.execute(
        query.outerjoin(HeliostatRow, HeliostatRow.id == AcknowledgementRow.heliostat_id)
    )
    return {(name, row.reason, row.fingerprint): row for name, row in rows}


def acknowledge(
    session: Session, heliostat: HeliostatRow | None, reason: str, fingerprint: str, actor: str
) -> AcknowledgementRow:
    """Record that ``actor`` has seen an alert. An earlier acknowledgement remains."""
    serialize_writers(session)
    row = AcknowledgementRow(
        heliostat_id=heliostat and heliostat.id,
        reason=reason,
        fingerprint=fingerprint,
        made_by=actor,
    )
    same = select(AcknowledgementRow).where(
        AcknowledgementRow.reason == reason, AcknowledgementRow.fingerprint == fingerprint
    )
    held = session.scalar(
        same.where(AcknowledgementRow.heliostat_id.is_not_distinct_from(row.heliostat_id)).limit(1)
    )
    if held is not None:
        return held
    session.add(row)
    session.flush()
    subject = "plant" if heliostat is None else f"heliostat {heliostat.name}"
    audit.record(
        session, actor, "attention.acknowledged", subject, reason=reason, fingerprint=fingerprint
    )
    return row
