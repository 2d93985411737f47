"""Forecasts and studies, as they are kept and found again, and how many of everything there are."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import cast

from sqlalchemy import func, select
from sqlalchemy.orm import Session, joinedload, lazyload, load_only, undefer

from service.base.faults import NotFoundError
from service.store.columns import Base
from service.store.job_tables import JobRow
from service.store.queue import KEPT
from service.store.rows import hold
from service.store.tables import ForecastRow, HeliostatRow, ImageRow, MeasurementRow, StudyRow, SurfaceRow, TargetRow

# What a forecast tells of its heliostat and surface is a name and a number; the rest would be megabytes in a list.
_NAMES = (
    joinedload(ForecastRow.heliostat, innerjoin=True).load_only(HeliostatRow.name),
    joinedload(ForecastRow.surface).options(load_only(SurfaceRow.version), lazyload(SurfaceRow.measurements)),
)


def add_forecast(session: Session, row: ForecastRow) -> ForecastRow:
    """Store a forecast; NotFoundError where its heliostat was deleted since it was read."""
    hold(session, HeliostatRow, row.heliostat_id, "its heliostat")
    session.add(row)
    session.flush()
    session.refresh(row, ["heliostat", "surface"])
    return row


def get_forecast(session: Session, number: int) -> ForecastRow:
    """A forecast with its flux; NotFoundError where there is none."""
    row = session.scalar(
        select(ForecastRow).where(ForecastRow.id == number).options(undefer(ForecastRow.flux), *_NAMES)
    )
    if row is None:
        raise NotFoundError(f"there is no forecast {number}")
    return row


def list_forecasts(
    session: Session, limit: int, after: int | None = None, heliostat: HeliostatRow | None = None
) -> Sequence[ForecastRow]:
    """Up to ``limit`` forecasts in the order they were made, those after number ``after``."""
    query = select(ForecastRow).options(*_NAMES).order_by(ForecastRow.id).limit(limit)
    if heliostat is not None:
        query = query.where(ForecastRow.heliostat_id == heliostat.id)
    return session.scalars(query.where(ForecastRow.id > after) if after else query).all()


def recent_forecasts(session: Session, limit: int) -> Sequence[ForecastRow]:
    """The newest ``limit`` forecasts, the newest first."""
    return session.scalars(select(ForecastRow).options(*_NAMES).order_by(ForecastRow.id.desc()).limit(limit)).all()


@dataclass(frozen=True)
class FieldForecast:
    """A forecast of many heliostats in short: a job's, without its map."""

    job: int
    created_at: datetime
    heliostats: int
    target: str | None
    sun_azimuth_deg: float | None
    sun_elevation_deg: float | None
    peak_w_m2: float


def recent_field_forecasts(session: Session, limit: int) -> list[FieldForecast]:
    """The newest ``limit`` forecasts of many heliostats, the newest first; the database picks them out of results."""
    result, payload = JobRow.result, JobRow.payload
    query = select(
        JobRow.id,
        JobRow.created_at,
        result["heliostats"].as_integer(),
        payload["target"].as_string(),
        result["sun"]["azimuth_deg"].as_float(),
        result["sun"]["elevation_deg"].as_float(),
        result["peak_w_m2"].as_float(),
    ).where(JobRow.kind == "forecasts", JobRow.state == "done")
    return [FieldForecast(*row) for row in session.execute(query.order_by(JobRow.id.desc()).limit(limit))]


@dataclass(frozen=True)
class Plan:
    """A plan in short: a job's, without its series."""

    job: int
    name: str
    target: str | None
    begin: str
    state: str
    peak_w_m2: float | None
    created_at: datetime
    created_by: str


def list_plans(session: Session, limit: int, after: int | None = None) -> list[Plan]:
    """Up to ``limit`` plans, the newest first, those before the job ``after``; not what was deleted or cancelled."""
    payload = JobRow.payload
    query = select(
        JobRow.id,
        payload["name"].as_string(),
        payload["target"].as_string(),
        payload["begin"].as_string(),
        JobRow.state,
        JobRow.result["peak_w_m2"].as_float(),
        JobRow.created_at,
        JobRow.created_by,
    ).where(JobRow.kind == KEPT, JobRow.state != "cancelled")
    if after is not None:
        query = query.where(JobRow.id < after)
    return [Plan(*row) for row in session.execute(query.order_by(JobRow.id.desc()).limit(limit))]


def add_study(session: Session, row: StudyRow) -> StudyRow:
    """Store a study."""
    session.add(row)
    session.flush()
    return row


def get_study(session: Session, number: int, page: bool = False) -> StudyRow:
    """A study with its report, and its ``page`` where wanted; NotFoundError where there is none."""
    columns = [undefer(StudyRow.report), undefer(StudyRow.skipped), *([undefer(StudyRow.html)] if page else [])]
    row = session.scalar(select(StudyRow).where(StudyRow.id == number).options(*columns))
    if row is None:
        raise NotFoundError(f"there is no study {number}")
    return row


def has_study_page(session: Session, number: int) -> bool:
    """Whether a study came with a page, told without its megabytes."""
    query = select(StudyRow.id).where(StudyRow.id == number, StudyRow.html.is_not(None))
    return session.scalar(query) is not None


def list_studies(session: Session, limit: int, after: int | None = None) -> Sequence[StudyRow]:
    """Up to ``limit`` studies without their reports, newest first, those older than study ``after``."""
    query = select(StudyRow).order_by(StudyRow.id.desc()).limit(limit)
    return session.scalars(query.where(StudyRow.id < after) if after else query).all()


_COUNTED: dict[str, type[Base]] = {
    "heliostats": HeliostatRow,
    "targets": TargetRow,
    "images": ImageRow,
    "measurements": MeasurementRow,
    "surfaces": SurfaceRow,
    "forecasts": ForecastRow,
}


def counts(session: Session) -> dict[str, int]:
    """How many of each there are."""
    return {
        name: cast(int, session.scalar(select(func.count()).select_from(table))) for name, table in _COUNTED.items()
    }
