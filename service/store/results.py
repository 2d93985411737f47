"""Storage of forecasts and studies, and row counts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple, cast

from sqlalchemy import func, select
from sqlalchemy.orm import Session, joinedload, lazyload, load_only, undefer

from service.base.errors import NotFoundError
from service.store.columns import Base
from service.store.job_tables import JobRow
from service.store.listing import Portion
from service.store.plant import get_target
from service.store.queue import KEPT
from service.store.rows import lock_row
from service.store.tables import (
    ForecastRow,
    HeliostatRow,
    ImageRow,
    MeasurementRow,
    StudyRow,
    SurfaceRow,
    TargetRow,
)

# A list of forecasts needs only the heliostat's name and the surface's version. Full rows would be
# megabytes.
_NAMES = (
    joinedload(ForecastRow.heliostat, innerjoin=True).load_only(HeliostatRow.name),
    joinedload(ForecastRow.surface).options(
        load_only(SurfaceRow.version), lazyload(SurfaceRow.measurements)
    ),
)


def add_forecast(session: Session, row: ForecastRow) -> ForecastRow:
    """Store a forecast.

    Raises
    ------
    NotFoundError
        If its heliostat was deleted since it was read.
    """
    lock_row(session, HeliostatRow, row.heliostat_id, "its heliostat")
    session.add(row)
    session.flush()
    session.refresh(row, ["heliostat", "surface"])
    return row


def get_forecast(session: Session, number: int) -> ForecastRow:
    """A forecast with its flux; NotFoundError if there is none."""
    row = session.scalar(
        select(ForecastRow)
        .where(ForecastRow.id == number)
        .options(undefer(ForecastRow.flux), *_NAMES)
    )
    if row is None:
        raise NotFoundError(f"there is no forecast {number}")
    return row


def list_forecasts(
    session: Session,
    portion: Portion,
    heliostat: HeliostatRow | None = None,
    target: str | None = None,
) -> Sequence[ForecastRow]:
    """A portion of the forecasts."""
    query = select(ForecastRow).options(*_NAMES)
    if heliostat is not None:
        query = query.where(ForecastRow.heliostat_id == heliostat.id)
    if target is not None:
        query = query.where(ForecastRow.target_name == get_target(session, target).name)
    return session.scalars(portion.of(session, query, ForecastRow)).all()


@dataclass(frozen=True)
class ForecastLine:
    """A forecast in a list, without its map: of one heliostat, or of many by the ``job``."""

    number: int
    job: bool
    heliostats: str
    target: str | None
    sun: Mapping[str, float]
    peak_w_m2: float
    created_at: datetime


def recent_forecasts(session: Session, limit: int) -> list[ForecastLine]:
    """The newest ``limit`` forecasts of one heliostat and of many, newest first.

    The database extracts the values from the JSON results of jobs.
    """
    newest = select(ForecastRow).options(*_NAMES).order_by(ForecastRow.id.desc()).limit(limit)
    lines = [
        ForecastLine(
            row.id,
            False,
            row.heliostat.name,
            row.target_name,
            row.document["sun"],
            row.document["peak_w_m2"],
            row.created_at,
        )
        for row in session.scalars(newest)
    ]
    result = JobRow.result
    query = select(
        JobRow.id,
        result["heliostats"].as_integer(),
        JobRow.payload["target"].as_string(),
        result["sun"].as_json(),
        result["peak_w_m2"].as_float(),
        JobRow.created_at,
    ).where(JobRow.kind == "forecasts", JobRow.state == "done")
    lines += [
        ForecastLine(number, True, f"{heliostats} together", *more)
        for number, heliostats, *more in session.execute(
            query.order_by(JobRow.id.desc()).limit(limit)
        )
    ]
    return sorted(lines, key=lambda line: line.created_at, reverse=True)[:limit]


@dataclass(frozen=True)
class Plan:
    """Summary of a plan: its job, without the time series."""

    job: int
    name: str
    target: str | None
    first_at: str
    state: str
    peak_w_m2: float | None
    created_at: datetime
    created_by: str


def list_plans(session: Session, limit: int, after: int | None = None) -> list[Plan]:
    """Up to ``limit`` plans before the job ``after``, newest first, without deleted or cancelled
    ones.
    """
    payload = JobRow.payload
    query = select(
        JobRow.id,
        payload["name"].as_string(),
        payload["target"].as_string(),
        payload["first_at"].as_string(),
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
    """A study with its report, and its HTML if ``page``; NotFoundError if there is none."""
    columns = [
        undefer(StudyRow.report),
        undefer(StudyRow.skipped),
        *([undefer(StudyRow.html)] if page else []),
    ]
    row = session.scalar(select(StudyRow).where(StudyRow.id == number).options(*columns))
    if row is None:
        raise NotFoundError(f"there is no study {number}")
    return row


def newest_study(session: Session) -> StudyRow | None:
    """The newest study; None without any."""
    return session.scalar(select(StudyRow).order_by(StudyRow.id.desc()).limit(1))


class Studied(NamedTuple):
    """Heliostats of a study, and its last photograph; None if its photographs have no times."""

    heliostats: list[str]
    last_taken_at: datetime | None


def list_studied(session: Session, model: int) -> list[Studied]:
    """What each study with a version of the model was of, the oldest first."""
    query = select(StudyRow.heliostats, StudyRow.last_taken_at).order_by(StudyRow.id)
    query = query.where(StudyRow.model == model)
    return [Studied(names, last) for names, last in session.execute(query)]


def has_study_page(session: Session, number: int) -> bool:
    """Whether a study has an HTML page, without loading it."""
    query = select(StudyRow.id).where(StudyRow.id == number, StudyRow.html.is_not(None))
    return session.scalar(query) is not None


def list_studies(
    session: Session, portion: Portion, verdict: str | None = None
) -> Sequence[StudyRow]:
    """A portion of the studies, without reports."""
    query = select(StudyRow)
    if verdict is not None:
        query = query.where(StudyRow.verdict == verdict)
    return session.scalars(portion.of(session, query, StudyRow)).all()


@dataclass(frozen=True)
class StudyFindings:
    """Parts of a study's report: the effects found, and the share of the error that is left.

    ``transfer`` and ``explained_share`` are those of its discrepancy, None without one.
    """

    verdict: str
    effects: Sequence[Mapping[str, Any]]
    unexplained_share: float
    transfer: Mapping[str, Any] | None = None
    explained_share: float | None = None

    @property
    def is_correction(self) -> bool:
        """Whether a correction without a cause would be adopted, instead of effects."""
        return self.verdict == "unexplained" and self.transfer is not None

    @property
    def share_left(self) -> float:
        """Share of the error that is left by what would be adopted."""
        share = self.explained_share if self.is_correction else None
        return self.unexplained_share if share is None else 1 - share


def study_findings(session: Session, studies: Sequence[int]) -> dict[int, StudyFindings]:
    """Findings by study id. The database extracts them from the reports."""
    report = StudyRow.report
    query = select(
        StudyRow.id,
        StudyRow.verdict,
        report["effects"],
        report["unexplained_share"].as_float(),
        report[("discrepancy", "transfer")],
        report[("discrepancy", "explained_share")].as_float(),
    )
    rows = session.execute(query.where(StudyRow.id.in_(studies)))
    return {number: StudyFindings(*found) for number, *found in rows}


def times_of_photographs(session: Session, keys: Iterable[str]) -> dict[str, datetime | None]:
    """When photographs were taken, by ``heliostat/id`` as in reports; deleted ones are missing."""
    pairs = [key.partition("/")[::2] for key in keys]
    query = (
        select(HeliostatRow.name, MeasurementRow.identifier, MeasurementRow.taken_at)
        .join(MeasurementRow, MeasurementRow.heliostat_id == HeliostatRow.id)
        .where(HeliostatRow.name.in_({name for name, _ in pairs}))
        .where(MeasurementRow.identifier.in_({identifier for _, identifier in pairs}))
    )
    return {f"{name}/{identifier}": at for name, identifier, at in session.execute(query)}


_COUNTED: dict[str, type[Base]] = {
    "heliostats": HeliostatRow,
    "targets": TargetRow,
    "images": ImageRow,
    "measurements": MeasurementRow,
    "surfaces": SurfaceRow,
    "forecasts": ForecastRow,
}


def counts(session: Session) -> dict[str, int]:
    """The number of rows of the main tables."""
    return {
        name: cast(int, session.scalar(select(func.count()).select_from(table)))
        for name, table in _COUNTED.items()
    }
