"""State of the field for the home page: accuracy with its trend, the worst heliostats, jobs."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from heapq import nsmallest
from statistics import fmean
from typing import Literal

from sqlalchemy import case, func, or_, select
from sqlalchemy.orm import Session

from service.store.columns import now
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow, MeasurementRow
from service.twin.alarms.field_overview import HeliostatOverview

Period = Literal["7", "30", "90", "all"]

PERIODS: dict[Period, str] = {
    "7": "7\N{NO-BREAK SPACE}days",
    "30": "30\N{NO-BREAK SPACE}days",
    "90": "90\N{NO-BREAK SPACE}days",
    "all": "all time",
}
"""Time ranges with their labels; all but the last are in days."""

_WORST = 5


@dataclass(frozen=True)
class FieldAccuracy:
    """Accuracies of the active surfaces, as the field overview has them.

    ``mean`` [1] is over the ``evaluated`` heliostats. ``below`` counts those below the limit.
    ``worst`` are the heliostats with the lowest accuracies and their values [1].
    """

    mean: float | None
    evaluated: int
    below: int
    worst: list[tuple[str, float]]


def field_accuracy(lines: Sequence[HeliostatOverview], limit: float) -> FieldAccuracy:
    """Summarize the accuracies of heliostats; ``limit`` [1] is the lowest acceptable one."""
    known = [
        (line.rank.accuracy, line.name)
        for line in lines
        if line.rank is not None and line.rank.accuracy is not None
    ]
    return FieldAccuracy(
        fmean(value for value, _ in known) if known else None,
        len(known),
        sum(value < limit for value, _ in known),
        [(name, value) for value, name in nsmallest(_WORST, known)],
    )


@dataclass(frozen=True)
class RecentWork:
    """What was stored in a time range.

    ``accuracy`` and ``before`` are means [1] of the forecasts of photographs on their arrival, in
    the range and in the one before it; None without such photographs. ``heliostat``,
    ``photograph`` and ``taken_at`` are those of the newest photograph at all. ``failed`` counts
    jobs that failed in the range.
    """

    accuracy: float | None
    before: float | None
    heliostat: str | None
    photograph: str | None
    taken_at: datetime | None
    running: int
    queued: int
    failed: int
    read_at: datetime


def recent_work(session: Session, period: Period) -> RecentWork:
    """Read what was stored in the ``period`` that ends now."""
    at, row = now(), MeasurementRow
    length = None if period == "all" else timedelta(days=int(period))
    since = datetime.min.replace(year=1970, tzinfo=at.tzinfo) if length is None else at - length

    def mean(first: datetime, last: datetime) -> float | None:
        of_arrival = select(func.avg(row.forecast_accuracy)).where(
            row.forecast_accuracy.is_not(None), row.taken_at >= first, row.taken_at < last
        )
        return session.scalar(of_arrival)

    newest = select(HeliostatRow.name, row.identifier, row.taken_at).join(
        HeliostatRow, HeliostatRow.id == row.heliostat_id
    )
    newest = newest.where(row.taken_at.is_not(None), row.image_sha256.is_not(None))
    found = session.execute(newest.order_by(row.taken_at.desc(), row.id.desc()).limit(1)).first()
    is_failed = (JobRow.state == "failed") & (JobRow.finished_at >= since)
    counted = select(
        *(
            func.coalesce(func.sum(case((condition, 1), else_=0)), 0)
            for condition in (JobRow.state == "running", JobRow.state == "queued", is_failed)
        )
    ).where(or_(JobRow.state.in_(("running", "queued")), is_failed))
    running, queued, failed = map(int, session.execute(counted).one())
    return RecentWork(
        mean(since, at),
        None if length is None else mean(since - length, since),
        None if found is None else found[0],
        None if found is None else found[1],
        None if found is None else found[2],
        running,
        queued,
        failed,
        at,
    )
