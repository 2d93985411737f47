"""How well the current surfaces forecast what was photographed: heliostat by heliostat, computed once and remembered.

Forecast and photograph are compared in the photograph's own 4 m window about its centre of mass, as everywhere
(DESIGN.md, section 7). A result holds until the heliostat gets another surface or another photograph, or the plant's
model another version.
"""

import logging
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.errors import ModelError
from model.metrics import flux_accuracy
from service import store
from service.base.faults import ServiceError
from service.base.settings import Settings
from service.store.measurements import PREFERENCE
from service.store.tables import DriftRow, HeliostatRow, MeasurementRow, MountRow, SurfaceRow
from service.twin import versions
from service.twin.book import Book
from service.twin.evidence import Array, Evidence, Twin, evidence_of, heights_of, load_twin
from service.twin.runtime import Runtime

logger = logging.getLogger("heliotwin.service")
RECENT = 8
"""How many of a heliostat's newest photographs a forecast is held against."""


# Results that are kept [1]: the field of the largest plant several times over.
_MOST = 200_000

# Heliostats whose comparisons are kept: half a megabyte each, of a span three times that.
_MOST_COMPARED = 64


@dataclass(frozen=True, eq=False)
class Comparison:
    """A photograph and its forecast.

    Attributes
    ----------
    measurement : MeasurementRow
    measured, forecast : (64, 64)
        4 m x 4 m, each with sum 100.
    accuracy : float [1]
    was_used : bool
        Whether the surface was made from this photograph, among others; then it proves less.
    """

    measurement: MeasurementRow
    measured: NDArray[Any]
    forecast: NDArray[Any]
    accuracy: float
    was_used: bool


@dataclass(frozen=True)
class Span:
    """When photographs were taken; None is open."""

    since: datetime | None = None
    until: datetime | None = None


# Newest photographs of a span that are held against forecasts.
_MOST_OF_SPAN = 24

# The newest photographs, this many times as many as are held against a forecast, are looked through for unseen ones.
_LOOKED_THROUGH = 4


def name_of(row: MeasurementRow) -> str:
    """Of the photograph that an image shows: one photograph may be stored in several kinds."""
    return row.external_id or row.identifier


def seen_by(surface: SurfaceRow | None) -> set[str]:
    """Names of the photographs that a surface was made from."""
    return set() if surface is None else {name_of(row) for row in surface.measurements}


def unseen_first(session: Session, heliostat: HeliostatRow, seen: Collection[str]) -> tuple[list[MeasurementRow], int]:
    """A heliostat's newest photographs, with arrays, first those not ``seen``; and how many of them are not."""
    recent = store.recent_measurements(session, heliostat, _LOOKED_THROUGH * RECENT)
    unseen = [row for row in recent if name_of(row) not in seen]
    chosen = (unseen + [row for row in recent if name_of(row) in seen])[:RECENT]
    rows = store.get_measurements(session, heliostat, [row.identifier for row in chosen], arrays=True)
    return rows, min(len(unseen), RECENT)


def _of_span(session: Session, heliostat: HeliostatRow, span: Span) -> list[MeasurementRow]:
    """A heliostat's newest photographs of a span, with arrays, whatever was made from them."""
    recent = store.recent_measurements(session, heliostat, _MOST_OF_SPAN, span.since, span.until)
    return store.get_measurements(session, heliostat, [row.identifier for row in recent], arrays=True)


def compare(runtime: Runtime, name: str, surface: SurfaceRow | None, span: Span | None = None) -> list[Comparison]:
    """The heliostat's newest photographs against forecasts with a stored surface, or the ideal one.

    Those that the surface was not made from come first; of a ``span`` all stand equal.

    Raises
    ------
    NotFoundError
        Where there is no such heliostat.
    ModelError
        Where a photograph or the surface cannot be traced.
    """
    with runtime.database.reading() as session:
        twin = load_twin(session, name)
        rows = (
            unseen_first(session, twin.row, seen_by(surface))[0] if span is None else _of_span(session, twin.row, span)
        )
    return compare_with(runtime, twin, surface, rows) if rows else []


def compare_with(
    runtime: Runtime, twin: Twin, surface: SurfaceRow | None, rows: Sequence[MeasurementRow]
) -> list[Comparison]:
    """Photographs, loaded with their arrays, against forecasts with a stored surface, or the ideal one."""
    shown = [evidence_of(row, twin.origin) for row in rows]
    used, forecasts = seen_by(surface), forecasts_of(runtime, twin, shown, heights_of(surface))
    return [
        Comparison(row, evidence.centered, forecast, flux_accuracy(evidence.centered, forecast), name_of(row) in used)
        for row, evidence, forecast in zip(rows, shown, forecasts, strict=True)
    ]


def forecasts_of(runtime: Runtime, twin: Twin, shown: Sequence[Evidence], z: Array | None) -> NDArray[Any]:
    """What heights (4, 8, 8) [m], None the ideal ones, throw where photographs show spots: (n, 64, 64), sum 100."""
    observations, model = [evidence.observation() for evidence in shown], twin.model
    with runtime.computing("compare") as operations:
        return operations.render(
            twin.heliostat,
            observations,
            z,
            model.optics,
            model.effects,
            latitude_deg=twin.origin[0],
        )


@dataclass(frozen=True)
class Rank:
    """Mean accuracy [1] on photographs that the surface was not made from, and how many there are; None without any."""

    accuracy: float | None
    photographs: int


def rank_of(comparisons: Sequence[Comparison]) -> Rank:
    """What comparisons prove of a surface: those that it was made from prove nothing."""
    unseen = [comparison.accuracy for comparison in comparisons if not comparison.was_used]
    return Rank(fmean(unseen) if unseen else None, len(unseen))


@dataclass(frozen=True)
class State:
    """What a heliostat's accuracy depends on.

    Its surface and its newest photograph, by their rows' ids, when one was last corrected, the version of the plant's
    model, and when its mount was calibrated.
    """

    heliostat: str
    surface: int
    newest: int
    corrected: datetime | None
    model: int
    calibrated_at: datetime | None = None


class AccuracyBook:
    """How well heliostats are forecast, by `State`; what is missing is worked out in the background."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._book: Book[State, Rank] = Book(self._rank, Rank(None, 0), "accuracy", _MOST)

    def look_up(self, states: Iterable[State]) -> tuple[dict[str, Rank], int]:
        """What is known, by heliostat, and how many are still being worked out."""
        known, missing = self._book.look_up(states)
        return {state.heliostat: rank for state, rank in known.items()}, missing

    def close(self) -> None:
        """Stop working, and wait for what is under way."""
        self._book.close()

    def _rank(self, state: State) -> Rank:
        """Of the surface that is current by now; where it cannot be told the log explains why."""
        try:
            with self._runtime.database.reading() as session:
                surface = store.get_surface_at(session, store.get_heliostat(session, state.heliostat))
            return rank_of(compare(self._runtime, state.heliostat, surface))
        except (ModelError, ServiceError) as error:
            logger.warning("the accuracy of heliostat %s cannot be told: %s", state.heliostat, error)
        return Rank(None, 0)


@dataclass(frozen=True)
class Shown:
    """What a heliostat's comparisons depend on; ``surface`` is a version, None the ideal mirror.

    ``span`` is when the photographs were taken, where they are not the newest.
    """

    heliostat: str
    surface: int | None
    newest: int
    corrected: datetime | None
    model: int
    calibrated_at: datetime | None = None
    span: Span | None = None


@dataclass(frozen=True)
class Compared:
    """Comparisons with the newest photographs, or why there are none."""

    comparisons: tuple[Comparison, ...] = ()
    trouble: str | None = None


class ComparisonBook:
    """Comparisons by what they depend on: traced once, however often and by however many they are looked at."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        failed = Compared(trouble="the comparison failed; the log says why")
        self._book: Book[Shown, Compared] = Book(self._compared, failed, "comparisons", _MOST_COMPARED)

    def read(
        self, session: Session, heliostat: HeliostatRow, surface: SurfaceRow | None, span: Span | None = None
    ) -> Shown | None:
        """What the comparisons of a heliostat with a surface depend on by now; None where there is no photograph."""
        photographs = select(func.max(MeasurementRow.id)).where(MeasurementRow.heliostat_id == heliostat.id)
        newest = session.scalar(photographs.where(MeasurementRow.accepted))
        if newest is None:
            return None
        corrections = select(func.max(MeasurementRow.corrected_at)).where(MeasurementRow.heliostat_id == heliostat.id)
        calibrations = select(func.max(MountRow.created_at)).where(MountRow.heliostat_id == heliostat.id)
        return Shown(
            heliostat.name,
            None if surface is None else surface.version,
            newest,
            session.scalar(corrections),
            versions.current_number(session),
            session.scalar(calibrations),
            span,
        )

    def wait_for(self, shown: Shown, seconds: float = 5.0) -> Compared | None:
        """Them; None where they are still being worked out after so many seconds."""
        return self._book.wait_for(shown, seconds)

    def close(self) -> None:
        """Stop working, and wait for what is under way."""
        self._book.close()

    def _compared(self, shown: Shown) -> Compared:
        try:
            with self._runtime.database.reading() as session:
                heliostat = store.get_heliostat(session, shown.heliostat)
                surface = None if shown.surface is None else store.get_surface(session, heliostat, shown.surface)
            return Compared(tuple(compare(self._runtime, shown.heliostat, surface, shown.span)))
        except (ModelError, ServiceError) as error:
            logger.warning("heliostat %s cannot be compared with its photographs: %s", shown.heliostat, error)
            return Compared(trouble=str(error))


# --- drift ------------------------------------------------------------------------------------------------------------


def judge(runtime: Runtime, twin: Twin, surface: SurfaceRow | None, shown: Evidence) -> float | None:
    """Accuracy [1] with which the current surface, loaded with its arrays, forecasts a photograph that just came.

    None where there is no surface, or it cannot be told, which the log explains: the photograph will be stored, and
    what watches over it must not refuse it.
    """
    if surface is None:
        return None
    try:
        (forecast,) = forecasts_of(runtime, twin, [shown], heights_of(surface))
        return float(flux_accuracy(shown.centered, forecast))
    except ModelError as error:
        logger.warning("the drift of heliostat %s cannot be told: %s", twin.row.name, error)
    except Exception:  # whatever it is, the photograph can be stored, and its sender must be told so
        logger.exception("the drift of heliostat %s cannot be told", twin.row.name)
    return None


@dataclass(frozen=True)
class Fall:
    """Medians of accuracies [1], of the newest photographs and of those before, and the 95 % interval of their drop."""

    recent: float
    earlier: float
    low: float
    high: float


# Newest photographs whose median is held against that of those before: so many at most, and at least as many.
_NEWEST = 5
_BEFORE = 60
_DRAWS = 1000


def fall_of(accuracies: Sequence[float]) -> Fall | None:
    """Whether accuracies (n,) [1], the newest first, fell; None where there are too few to tell.

    The interval is a bootstrap's: Efron and Tibshirani 1993, *An Introduction to the Bootstrap*, chapter 13.
    """
    recent, earlier = np.array(accuracies[:_NEWEST]), np.array(accuracies[_NEWEST : _NEWEST + _BEFORE])
    if len(earlier) < _NEWEST:
        return None
    rng = np.random.default_rng(0)
    before, after = (np.median(rng.choice(some, (_DRAWS, len(some))), axis=1) for some in (earlier, recent))
    low, high = np.quantile(before - after, [0.025, 0.975])
    return Fall(float(np.median(recent)), float(np.median(earlier)), float(low), float(high))


def _came_so(session: Session, heliostat: int) -> list[float]:
    """How well a heliostat's photographs were forecast when they came, one image of each, the newest first."""
    row = MeasurementRow
    moment = func.coalesce(row.taken_at, row.created_at)
    query = select(func.coalesce(row.external_id, row.identifier), row.kind, row.forecast_accuracy)
    query = query.where(row.heliostat_id == heliostat, row.accepted, row.forecast_accuracy.is_not(None))
    query = query.order_by(moment.desc(), row.id.desc()).limit(len(PREFERENCE) * (_NEWEST + _BEFORE))
    shots: dict[str, tuple[int, float]] = {}
    for name, kind, accuracy in session.execute(query):
        shots[name] = min(shots.get(name, (len(PREFERENCE), 0.0)), (PREFERENCE.index(kind), accuracy or 0.0))
    return [accuracy for _, accuracy in shots.values()]


def note(
    session: Session, measurement: MeasurementRow, surface: SurfaceRow, accuracy: float, settings: Settings
) -> None:
    """Keep it as the heliostat's, unless that of a photograph that was taken later stands there.

    Below the settings' least it is poor, and has been since the first of those that came so in a row; where the newest
    ones lie further below the earlier ones than the settings bear, it fell.
    """
    new = DriftRow(
        heliostat_id=measurement.heliostat_id,
        measurement_id=measurement.id,
        surface_id=surface.id,
        taken_at=measurement.taken_at or measurement.created_at,
        accuracy=accuracy,
    )
    new.poor_since = new.taken_at if accuracy < settings.attention_accuracy else None
    fall = fall_of(_came_so(session, measurement.heliostat_id))
    if fall is not None:
        new.recent, new.earlier, new.least_drop = fall.recent, fall.earlier, fall.low
        new.fell_since = new.taken_at if fall.low > settings.attention_accuracy_drop else None
    held = session.get(DriftRow, measurement.heliostat_id, with_for_update=True)
    if held is None and store.insert(session, new):
        return
    held = held or session.get_one(DriftRow, measurement.heliostat_id, with_for_update=True)
    if held.taken_at <= new.taken_at:
        new.poor_since = new.poor_since and (held.poor_since or new.poor_since)
        new.fell_since = new.fell_since and (held.fell_since or new.fell_since)
        session.merge(new)
