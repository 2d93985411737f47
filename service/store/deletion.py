"""Deletion of photographs, of parts of the plant that nothing refers to, and of old records.

Photographs that were sent wrongly go with everything that only they need. Old jobs, forecasts and
audit entries go in batches, oldest first.
"""

from collections.abc import Sequence
from datetime import timedelta

from pydantic import Field
from sqlalchemy import ColumnElement, delete, func, select
from sqlalchemy.orm import Session

from service.base.errors import ConflictError
from service.store import audit, image_files, queue
from service.store.columns import Base
from service.store.job_tables import AcknowledgementRow, AlarmRow, AuditRow, JobRow
from service.store.keys import RESERVED
from service.store.measurements import get_measurement, images_of_photograph
from service.store.photographs import MadeFrom, delete_drift, made_from, note_change
from service.store.plant import get_heliostat, get_receiver, get_target
from service.store.queue import ENDED
from service.store.rows import lock_heliostat
from service.store.tables import (
    AliasRow,
    CorrectionRow,
    DecisionRow,
    DriftRow,
    ForecastRow,
    HeliostatRow,
    HeliostatStateRow,
    MeasurementRow,
    MountRow,
    ReceiverRow,
    StudyRow,
    SurfaceRow,
    TargetRow,
    surface_measurements,
)


class Deleted(MadeFrom):
    """A deleted photograph, and what was made from it."""

    deleted: list[str] = Field(description="Ids of the images that were deleted.")


def delete_photograph(
    session: Session,
    heliostat: str,
    identifier: str,
    reason: str,
    actor: str,
    only_this: bool = False,
) -> Deleted:
    """Delete the photograph of an image in all its kinds, or ``only_this`` image.

    Surfaces from it remain and name it as deleted. Its image files are marked for
    `service.store.image_files.remove_marked`.

    Raises
    ------
    NotFoundError
        If the heliostat or measurement is not stored.
    """
    owner = get_heliostat(session, heliostat)
    lock_heliostat(session, owner)
    row = get_measurement(session, owner, identifier)
    derived = made_from(session, row)
    every = [row] if only_this else images_of_photograph(session, row).values()
    rows = sorted(every, key=lambda image: image.id)  # in the order in which they came
    _name_in_surfaces(session, rows)
    delete_drift(session, rows)
    numbers = [image.id for image in rows]
    session.execute(delete(CorrectionRow).where(CorrectionRow.measurement_id.in_(numbers)))
    session.execute(delete(AliasRow).where(AliasRow.measurement_id.in_(numbers)))
    subject = f"heliostat {heliostat} {row.identifier}"
    audit.record(
        session,
        actor,
        "measurement.deleted",
        subject,
        reason=reason,
        images=[_about(image) for image in rows],
    )
    note_change(session, owner.id)
    for image in rows:
        session.delete(image)
    session.flush()
    for sha256 in sorted({image.image_sha256 for image in rows if image.image_sha256 is not None}):
        image_files.mark_unused(session, sha256)
    return Deleted(**dict(derived), deleted=[image.identifier for image in rows])


def _name_in_surfaces(session: Session, rows: Sequence[MeasurementRow]) -> None:
    """Replace the references of surfaces to these images by the names of deleted photographs."""
    links, identifiers = surface_measurements.c, {row.identifier for row in rows}
    names = {row.external_id or row.identifier for row in rows}
    of = links.measurement_id.in_([row.id for row in rows])
    made = select(SurfaceRow).where(SurfaceRow.id.in_(select(links.surface_id).where(of)))
    for surface in session.scalars(made):
        surface.deleted = sorted({*(surface.deleted or ()), *names})
        surface.suspicious = surface.suspicious and [
            name for name in surface.suspicious if name not in identifiers
        ]
    session.flush()
    session.execute(delete(surface_measurements).where(of))


def _about(row: MeasurementRow) -> dict[str, object]:
    """Description of an image in the audit trail."""
    return {
        "id": row.identifier,
        "external_id": row.external_id,
        "kind": row.kind,
        "sha256": row.image_sha256,
    }


def remove_target(session: Session, name: str) -> None:
    """Delete a target plane.

    Raises
    ------
    NotFoundError
        If there is none of this name.
    ConflictError
        If something refers to it. The message lists what.
    """
    row = get_target(session, name)
    _lock(session, TargetRow, row.id)
    users = {
        "measurements": _count(session, MeasurementRow, MeasurementRow.target_id == row.id),
        **_users_of_name(session, name),
    }
    _delete_unused(session, row, f"target {name}", users)


def remove_receiver(session: Session, name: str) -> None:
    """Delete a receiver. Raises the errors of `remove_target`."""
    row = get_receiver(session, name)
    _delete_unused(session, row, f"receiver {name}", _users_of_name(session, name))


def remove_heliostat(session: Session, name: str) -> None:
    """Delete a heliostat. Raises the errors of `remove_target`."""
    row = get_heliostat(session, name)
    _lock(session, HeliostatRow, row.id)
    users = {
        table.__tablename__: _count(session, table, table.heliostat_id == row.id)
        for table in (MeasurementRow, SurfaceRow, DecisionRow, MountRow, ForecastRow, DriftRow)
    }
    # A study refers to names, because its photographs may be deleted before the study.
    studied = sum(name in heliostats for heliostats in session.scalars(select(StudyRow.heliostats)))
    # The history of alarms does not prevent removal. If the removal fails, it is restored.
    for table in (AcknowledgementRow, AlarmRow, HeliostatStateRow):
        session.execute(delete(table).where(table.heliostat_id == row.id))
    _delete_unused(session, row, f"heliostat {name}", {**users, "studies": studied})


def _lock(session: Session, table: type[TargetRow] | type[HeliostatRow], number: int) -> None:
    """Wait for transactions that start to refer to the row, and block new ones."""
    session.execute(select(table.id).where(table.id == number).with_for_update())


def _count(session: Session, table: type[Base], condition: ColumnElement[bool]) -> int:
    return session.scalars(select(func.count()).select_from(table).where(condition)).one()


def _users_of_name(session: Session, name: str) -> dict[str, int]:
    """Count users of a target's name: forecasts, and jobs that have not ended."""
    waiting = JobRow.state.not_in(ENDED) & (JobRow.payload["target"].as_string() == name)
    return {
        "forecasts": _count(session, ForecastRow, ForecastRow.target_name == name),
        "jobs": _count(session, JobRow, waiting),
    }


def _delete_unused(
    session: Session, row: TargetRow | ReceiverRow | HeliostatRow, label: str, users: dict[str, int]
) -> None:
    found = [f"{name} ({count})" for name, count in users.items() if count]
    if found:
        raise ConflictError(f"{label} stays: it is referred to by {', '.join(found)}")
    session.delete(row)
    session.flush()


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
