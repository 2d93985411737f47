"""What work would cost before it starts, from the durations of earlier jobs of its kind."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import median

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.effects import CATALOGUE
from service.base.fields import Method
from service.jobs.kinds.predictions import EACH_S
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow, MeasurementRow

# Newest finished jobs of a kind that are read.
_READ_JOBS = 10

# Stated durations without earlier jobs [s]: of a heliostat's mount, of a photograph's import, and
# of one effect tried on a photograph.
_CALIBRATION_S, _IMPORT_S, _TRIAL_S = 1.0, 0.5, 0.15

_IMAGES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"))
_MOST_FILES = 100_000


@dataclass(frozen=True)
class Cost:
    """Expected cost: ``count`` units of ``each_s`` [s], the median of ``n_jobs`` earlier jobs.

    Without earlier jobs ``each_s`` is a stated rate.
    """

    count: int
    each_s: float
    n_jobs: int

    @property
    def total_s(self) -> float:
        """Expected duration [s]."""
        return self.count * self.each_s


def _cost(
    session: Session, kind: str, count: int, stated_s: float, units: Callable[[JobRow], int]
) -> Cost:
    """The cost of ``count`` units; ``units`` counts those of an earlier job."""
    query = select(JobRow).where(JobRow.kind == kind, JobRow.state == "done")
    rates = [
        (row.finished_at - row.attempted_at).total_seconds() / n
        for row in session.scalars(query.order_by(JobRow.id.desc()).limit(_READ_JOBS))
        if row.finished_at and row.attempted_at and row.attempts == 1 and (n := units(row))
    ]
    return Cost(count, median(rates) if rates else stated_s, len(rates))


def _results(row: JobRow, part: str) -> int:
    return len((row.result or {}).get(part, ()))


def prediction_cost(session: Session, heliostat: str | None, method: Method) -> Cost:
    """The cost of surfaces of a heliostat, or of all that have an accepted photograph."""
    photographed = select(func.count(func.distinct(MeasurementRow.heliostat_id)))
    count = session.scalars(photographed.where(MeasurementRow.accepted)).one()
    return _cost(
        session,
        "predictions",
        count if heliostat is None else 1,
        EACH_S[method],
        lambda row: _results(row, "surfaces") * (row.payload.get("method") == method),
    )


def calibration_cost(session: Session, heliostat: str | None) -> Cost:
    """The cost of the mounts of a heliostat, or of all whose photographs have motor positions."""
    driven = select(func.count(func.distinct(MeasurementRow.heliostat_id)))
    driven = driven.where(MeasurementRow.motor_axis_1.is_not(None))
    if heliostat is not None:
        driven = driven.join(HeliostatRow).where(HeliostatRow.name == heliostat)
    count = session.scalars(driven).one()
    return _cost(
        session, "calibrations", count, _CALIBRATION_S, lambda row: _results(row, "mounts")
    )


def study_cost(session: Session, n_photographs: int, effects: Sequence[str] | None) -> Cost:
    """The cost of trying effects, by default all, on photographs."""

    def n_trials(n_photographs: int, effects: Sequence[str] | None) -> int:
        return n_photographs * len(CATALOGUE if effects is None else effects)

    return _cost(
        session,
        "studies",
        n_trials(n_photographs, effects),
        _TRIAL_S,
        lambda row: n_trials(
            (row.result or {}).get("photographs", 0), row.payload.get("candidates")
        ),
    )


def count_images(folder: Path) -> int:
    """The number of images of a folder; at most 100,000 files are counted."""
    files = islice(folder.rglob("*"), _MOST_FILES)
    return sum(path.suffix.lower() in _IMAGES for path in files)


def import_cost(session: Session, n_images: int) -> Cost:
    """The cost of the images of a folder."""
    return _cost(
        session,
        "imports",
        n_images,
        _IMPORT_S,
        lambda row: (row.result or {}).get("counts", {}).get("images new", 0),
    )
