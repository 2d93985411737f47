"""Accuracy of the active surfaces on photographs.

Forecast and photograph are compared in a 4 m window about the photograph's centre of mass
(DESIGN.md, section 7). A result is valid until the heliostat gets another surface or photograph, or
the plant's model another version.
"""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.errors import ModelError
from model.metrics import flux_accuracy
from service import store
from service.base.errors import ServiceError
from service.base.settings import Settings
from service.store.listing import EVER, Period
from service.store.measurements import PREFERENCE
from service.store.tables import (
    SUN_CONTRADICTS_TIME,
    UNLIKE_HELIOSTAT,
    DriftRow,
    HeliostatRow,
    MeasurementRow,
    MountRow,
    SurfaceRow,
)
from service.twin import model_versions
from service.twin.caches import BackgroundCache
from service.twin.measurements import (
    AcceptedMeasurement,
    Array,
    HeliostatContext,
    accepted_measurement,
    heights_of,
    load_heliostat_context,
)
from service.twin.runtime import Runtime
from service.twin.surfaces.present_shape import AccuracyFall, epoch_of, find_accuracy_fall

logger = logging.getLogger("heliotwin.service")
RECENT = 8
"""Number of a heliostat's newest photographs that are compared with a forecast."""

# Heliostats with cached comparisons: half a megabyte each, three times that for a span.
_MAX_COMPARED = 64


@dataclass(frozen=True, eq=False)
class PhotographComparison:
    """A photograph and its forecast.

    Attributes
    ----------
    measurement : MeasurementRow
    measured, forecast : (64, 64)
        4 m x 4 m, each with sum 100.
    accuracy : float [1]
    was_used : bool
        Whether the surface was computed from this photograph. Then the accuracy proves less.
    """

    measurement: MeasurementRow
    measured: NDArray[Any]
    forecast: NDArray[Any]
    accuracy: float
    was_used: bool


# Newest photographs of a span that are compared with forecasts.
_MAX_OF_SPAN = 24

# Held-out photographs are searched among the newest `_LOOKED_THROUGH * RECENT` photographs.
_LOOKED_THROUGH = 4


def photograph_name(row: MeasurementRow) -> str:
    """Name of the photograph that an image shows.

    One photograph may be stored as several kinds of image.
    """
    return row.external_id or row.identifier


def photographs_of_surface(surface: SurfaceRow | store.NewSurface | None) -> set[str]:
    """Names of the photographs that a surface was computed from, deleted ones included."""
    if surface is None:
        return set()
    deleted = surface.deleted if isinstance(surface, SurfaceRow) else None
    return {*(photograph_name(row) for row in surface.measurements), *(deleted or ())}


# Photographs with these warnings do not show the mirror's shape.
_MISLEADING = (SUN_CONTRADICTS_TIME, UNLIKE_HELIOSTAT)


def photographs_of_epoch(
    session: Session, heliostat: HeliostatRow, epoch: Period
) -> list[MeasurementRow]:
    """The newest photographs that may judge a surface of an epoch, newest first.

    Misleading ones may only if there are no others.
    """
    most = _LOOKED_THROUGH * RECENT
    recent = store.recent_measurements(session, heliostat, most, epoch.since, epoch.until)
    return [row for row in recent if not is_misleading(row)] or recent


def is_misleading(row: MeasurementRow) -> bool:
    """Whether warnings say that a photograph does not show the mirror's shape."""
    return any(one["type"] in _MISLEADING for one in row.warnings or ())


class HeldOutFirst(NamedTuple):
    """Photographs with arrays, the held-out ones first, and the number of those."""

    rows: list[MeasurementRow]
    n_held_out: int


def held_out_first(
    session: Session, heliostat: HeliostatRow, seen: Collection[str], epoch: Period = EVER
) -> HeldOutFirst:
    """A heliostat's newest photographs of an epoch; those named in ``seen`` are not held out."""
    recent = photographs_of_epoch(session, heliostat, epoch)
    unseen = [row for row in recent if photograph_name(row) not in seen]
    chosen = (unseen + [row for row in recent if photograph_name(row) in seen])[:RECENT]
    rows = store.get_measurements(
        session, heliostat, [row.identifier for row in chosen], arrays=True
    )
    return HeldOutFirst(rows, min(len(unseen), RECENT))


def _in_span(session: Session, heliostat: HeliostatRow, span: Period) -> list[MeasurementRow]:
    """A heliostat's newest photographs of a span, with arrays, held out or not."""
    recent = store.recent_measurements(session, heliostat, _MAX_OF_SPAN, span.since, span.until)
    return store.get_measurements(
        session, heliostat, [row.identifier for row in recent], arrays=True
    )


def compare(
    runtime: Runtime, name: str, surface: SurfaceRow | None, span: Period | None = None
) -> list[PhotographComparison]:
    """Compare a heliostat's newest photographs with forecasts.

    The forecasts use a stored surface, or the ideal one if ``surface`` is None. Held-out
    photographs come first. In a ``span`` all photographs are treated alike.

    Raises
    ------
    NotFoundError
        If there is no such heliostat.
    ModelError
        If a photograph or the surface cannot be traced.
    """
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, name)
        rows = (
            held_out_first(
                session,
                twin.row,
                photographs_of_surface(surface),
                epoch_of(session, twin.row, surface),
            )[0]
            if span is None
            else _in_span(session, twin.row, span)
        )
    return compare_with(runtime, twin, surface, rows) if rows else []


def compare_with(
    runtime: Runtime,
    twin: HeliostatContext,
    surface: SurfaceRow | None,
    rows: Sequence[MeasurementRow],
) -> list[PhotographComparison]:
    """Compare photographs, loaded with their arrays, with forecasts.

    The forecasts use a stored surface, or the ideal one if ``surface`` is None.
    """
    shown = [accepted_measurement(row, twin.origin) for row in rows]
    used = photographs_of_surface(surface)
    forecasts = forecasts_of(runtime, twin, shown, heights_of(surface))
    return [
        PhotographComparison(
            row,
            evidence.centered,
            forecast,
            flux_accuracy(evidence.centered, forecast),
            photograph_name(row) in used,
        )
        for row, evidence, forecast in zip(rows, shown, forecasts, strict=True)
    ]


def forecasts_of(
    runtime: Runtime, twin: HeliostatContext, photos: Sequence[AcceptedMeasurement], z: Array | None
) -> NDArray[Any]:
    """Forecast the flux of photographs: (n, 64, 64), each with sum 100.

    ``z`` are heights (4, 8, 8) [m]; None is the ideal surface.
    """
    observations = [evidence.observation() for evidence in photos]
    with runtime.computing("compare") as operations:
        return operations.render(twin.heliostat, observations, z, twin.model)


@dataclass(frozen=True)
class Rank:
    """Mean accuracy [1] on held-out photographs, and their number.

    The accuracy is None if there are none.
    """

    accuracy: float | None
    photographs: int


def rank_of(comparisons: Sequence[PhotographComparison]) -> Rank:
    """Average the accuracies on held-out photographs; others prove nothing."""
    unseen = [comparison.accuracy for comparison in comparisons if not comparison.was_used]
    return Rank(fmean(unseen) if unseen else None, len(unseen))


class AccuracySeries(NamedTuple):
    """Accuracies [1] of the active surface by row id, what they rank, and their fall."""

    rank: Rank
    fall: AccuracyFall | None
    accuracies: dict[str, float]


def accuracy_series(
    runtime: Runtime, name: str, known: Mapping[str, float]
) -> AccuracySeries | None:
    """Accuracies of a heliostat's active surface, or of the ideal mirror if none is active.

    One surface and one model forecast all photographs, so a fall is no step of them. Photographs
    that the surface was computed from do not count. ``known`` are accuracies that were computed
    before; those on arrival are known as well, if nothing changed since. The result is None after a
    failure, which is logged.
    """
    try:
        with runtime.database.reading() as session:
            twin = load_heliostat_context(session, name)
            surface = store.find_surface_at(session, twin.row)
            rows = photographs_of_epoch(session, twin.row, epoch_of(session, twin.row, surface))
            key, found = forecast_key(twin, surface), dict(known)
            for row in rows:
                if row.forecast_key == key and row.forecast_accuracy is not None:
                    found[str(row.id)] = row.forecast_accuracy
            names = [row.identifier for row in rows if str(row.id) not in found]
            missing = store.get_measurements(session, twin.row, names, arrays=True)
        compared = compare_with(runtime, twin, surface, missing) if missing else []
    except (ModelError, ServiceError) as error:
        logger.warning("the accuracy of heliostat %s is not known: %s", name, error)
        return None
    found |= {str(one.measurement.id): one.accuracy for one in compared}
    accuracies = {str(row.id): found[str(row.id)] for row in rows}
    used = photographs_of_surface(surface)
    unseen = [row for row in rows if photograph_name(row) not in used]
    newest = [accuracies[str(row.id)] for row in unseen[:RECENT]]
    dated = sorted(
        (row.taken_at, accuracies[str(row.id)]) for row in unseen if row.taken_at is not None
    )
    fall = find_accuracy_fall([at for at, _ in dated], [value for _, value in dated])
    rank = Rank(fmean(newest) if newest else None, len(newest))
    return AccuracySeries(rank, None if surface is None else fall, accuracies)


def result_key(*parts: datetime | int | None) -> str:
    """Text of what a result is based on: row ids, and times of changes."""
    return " ".join(
        str(part.timestamp()) if isinstance(part, datetime) else str(part) for part in parts
    )


@dataclass(frozen=True)
class ComparisonKey:
    """What a heliostat's comparisons depend on.

    ``surface`` is a version, None for the ideal mirror. ``based_on`` changes with photographs,
    properties, mount and model. ``span`` is when the photographs were taken; None means the newest
    ones.
    """

    heliostat: str
    surface: int | None
    based_on: str
    span: Period | None


@dataclass(frozen=True)
class ComparisonResult:
    """Comparisons with photographs, or in ``trouble`` why there are none."""

    comparisons: tuple[PhotographComparison, ...] = ()
    trouble: str | None = None


class ComparisonCache:
    """Cache of comparisons: each is traced once, for all users."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        failed = ComparisonResult(trouble="the comparison failed; the log says why")
        self._cache: BackgroundCache[ComparisonKey, ComparisonResult] = BackgroundCache(
            self._compared, failed, "comparisons", _MAX_COMPARED
        )

    def read(
        self,
        session: Session,
        heliostat: HeliostatRow,
        surface: SurfaceRow | None,
        span: Period | None = None,
    ) -> ComparisonKey | None:
        """What the comparisons with a surface depend on now; None without a photograph."""
        row, is_own = MeasurementRow, MeasurementRow.heliostat_id == heliostat.id
        newest = session.scalar(select(func.max(row.id)).where(is_own, row.accepted))
        if newest is None:
            return None
        mounts = select(func.max(MountRow.id)).where(MountRow.heliostat_id == heliostat.id)
        based_on = result_key(
            newest,
            session.scalar(select(func.max(row.corrected_at)).where(is_own)),
            heliostat.photographs_changed_at,
            heliostat.updated_at,
            session.scalar(mounts),
            model_versions.current_number(session),
        )
        version = None if surface is None else surface.version
        return ComparisonKey(heliostat.name, version, based_on, span)

    def wait_for(self, key: ComparisonKey, seconds: float = 5.0) -> ComparisonResult | None:
        """The comparisons; None if they are not ready after ``seconds``."""
        return self._cache.wait_for(key, seconds)

    def close(self) -> None:
        """Stop the background work and wait for the current computation."""
        self._cache.close()

    def _compared(self, key: ComparisonKey) -> ComparisonResult:
        try:
            with self._runtime.database.reading() as session:
                heliostat = store.get_heliostat(session, key.heliostat)
                surface = (
                    None
                    if key.surface is None
                    else store.get_surface(session, heliostat, key.surface)
                )
            return ComparisonResult(tuple(compare(self._runtime, key.heliostat, surface, key.span)))
        except (ModelError, ServiceError) as error:
            logger.warning(
                "heliostat %s cannot be compared with its photographs: %s", key.heliostat, error
            )
            return ComparisonResult(trouble=str(error))


# --- drift
# --------------------------------------------------------------------------------------------------


def accuracy_on_arrival(
    runtime: Runtime, twin: HeliostatContext, surface: SurfaceRow | None, photo: AcceptedMeasurement
) -> float | None:
    """Accuracy [1] of the active surface's forecast for a photograph that just came.

    ``surface`` is loaded with its arrays. The result is None without a surface, or if the forecast
    fails. The failure is logged, because the photograph must be stored anyway.
    """
    if surface is None:
        return None
    try:
        (forecast,) = forecasts_of(runtime, twin, [photo], heights_of(surface))
        return float(flux_accuracy(photo.centered, forecast))
    except ModelError as error:
        logger.warning("the drift of heliostat %s is not known: %s", twin.row.name, error)
    except Exception:  # the photograph must be stored, whatever fails here
        logger.exception("the drift of heliostat %s is not known", twin.row.name)
    return None


def forecast_key(twin: HeliostatContext, surface: SurfaceRow | None) -> str:
    """What forecasts with a stored surface are based on, besides their photographs."""
    number = None if surface is None else surface.id
    return result_key(number, twin.model.number, twin.mount, twin.row.updated_at)


# Photographs on arrival whose median is the usual accuracy, and the least number of them.
_USUAL, _MIN_USUAL = 60, 5


def _accuracies_on_arrival(session: Session, heliostat: int) -> list[float]:
    """Accuracies on arrival of a heliostat's photographs, newest first.

    Photographs of unknown time are left out. Each photograph counts once, by its preferred kind of
    image.
    """
    row = MeasurementRow
    query = select(func.coalesce(row.external_id, row.identifier), row.kind, row.forecast_accuracy)
    query = query.where(
        row.heliostat_id == heliostat, row.accepted, row.forecast_accuracy.is_not(None)
    )
    query = query.where(row.taken_at.is_not(None)).order_by(row.taken_at.desc(), row.id.desc())
    query = query.limit(len(PREFERENCE) * _USUAL)
    shots: dict[str, tuple[int, float]] = {}
    for name, kind, accuracy in session.execute(query):
        shots[name] = min(
            shots.get(name, (len(PREFERENCE), 0.0)), (PREFERENCE.index(kind), accuracy or 0.0)
        )
    return [accuracy for _, accuracy in shots.values()]


def usual_accuracy(session: Session, heliostat: int) -> float | None:
    """Median accuracy [1] on arrival of a heliostat's photographs; None for fewer than five."""
    accuracies = _accuracies_on_arrival(session, heliostat)
    return float(np.median(accuracies)) if len(accuracies) >= _MIN_USUAL else None


def record_drift(
    session: Session,
    measurement: MeasurementRow,
    surface: SurfaceRow,
    accuracy: float,
    settings: Settings,
) -> None:
    """Store an accuracy as the heliostat's newest, unless a later photograph has one.

    A photograph of unknown time is ignored. An accuracy below ``alarm_accuracy`` is poor, and
    ``poor_since`` is when the current series of poor ones began.
    """
    if measurement.taken_at is None:
        return
    new = DriftRow(
        heliostat_id=measurement.heliostat_id,
        measurement_id=measurement.id,
        surface_id=surface.id,
        taken_at=measurement.taken_at,
        accuracy=accuracy,
    )
    new.poor_since = new.taken_at if accuracy < settings.alarm_accuracy else None
    held = session.get(DriftRow, measurement.heliostat_id, with_for_update=True)
    if held is None and store.insert(session, new):
        return
    held = held or session.get_one(DriftRow, measurement.heliostat_id, with_for_update=True)
    if held.taken_at <= new.taken_at:
        new.poor_since = new.poor_since and (held.poor_since or new.poor_since)
        session.merge(new)
