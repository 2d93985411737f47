"""Removal of a target, receiver or heliostat that nothing refers to."""

from sqlalchemy import ColumnElement, delete, func, select
from sqlalchemy.orm import Session

from service.base.errors import ConflictError
from service.store.columns import Base
from service.store.job_tables import AcknowledgementRow, AlarmRow, JobRow
from service.store.jobs.queue import ENDED
from service.store.plant.geometry import get_heliostat, get_receiver, get_target
from service.store.tables import (
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
)


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
