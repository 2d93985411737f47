"""Overview of the field: every heliostat with the state of its twin."""

import logging
import math
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from sqlalchemy import case, func, select, union_all
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from model.surface import canting_rises, split_canting
from service import store
from service.base.arrays import unpack
from service.base.errors import BusyError
from service.store import field_state
from service.store.columns import now
from service.store.job_tables import AuditRow, JobRow
from service.store.surface_versions import newest_first
from service.store.tables import (
    HeliostatRow,
    HeliostatStateRow,
    MeasurementRow,
    MountRow,
    SurfaceRow,
)
from service.twin import model_versions
from service.twin.caches import BackgroundCache, RecentResults
from service.twin.pointing_errors import MountKey, PointingState, find_pointing
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import Rank, accuracy_series, result_key
from service.twin.surfaces.present_shape import FALL, AccuracyFall

Result = TypeVar("Result")
logger = logging.getLogger("heliotwin.service")

# Tables whose newest rows show whether the field has changed, and the number of rows to read.
_TABLES = (HeliostatRow, MeasurementRow, SurfaceRow, MountRow, AuditRow, JobRow)
_NEWEST = 1000
# If reading the field takes less than `_QUICK_S` [s], each request waits for the current state, at
# most `PATIENCE_S` [s].
_QUICK_S = 0.2
PATIENCE_S = 20.0
# Results for a field of more than `LARGE` heliostats are reused for this time [s], if the store is
# unchanged. For smaller fields they take milliseconds.
_RECENT_S = 2.0
LARGE = 1000
_POINTING = TypeAdapter(PointingState)


@dataclass(frozen=True)
class FieldTotals:
    """Root mean squares over the mirror: deviation, and standard deviation if known [mm]."""

    deviation_mm: float
    uncertainty_mm: float | None


def field_totals(arrays: bytes) -> FieldTotals:
    """Compute the totals of a stored surface from its packed arrays."""
    unpacked = unpack(arrays)
    z, z_std = unpacked["z"], unpacked["z_std"]
    uncertainty = float(np.sqrt(np.mean(z_std**2)) * 1e3)
    return FieldTotals(float(np.sqrt(np.mean(z**2)) * 1e3), uncertainty or None)


@dataclass(frozen=True)
class SurfaceErrors:
    """Kinds of surface deviation, as root mean squares over the mirror.

    ``deviation_mm`` is the total deviation from the ideal surface. ``waviness_mm`` is the deviation
    within facets. ``canting_mrad`` is the tilt of the facets.
    """

    deviation_mm: float
    waviness_mm: float
    canting_mrad: float


def surface_errors(z: NDArray[np.floating], sizes: NDArray[np.floating]) -> SurfaceErrors:
    """Split surface deviation into canting and waviness.

    ``z`` are heights (F, 8, 8) [m]. ``sizes`` (F, 2) [m] are width and height of each facet.
    """
    _, waviness = split_canting(z)
    tilts = (canting_rises(z) / sizes) ** 2
    deviation, wavy = (float(np.sqrt(np.mean(heights**2)) * 1e3) for heights in (z, waviness))
    return SurfaceErrors(deviation, wavy, 1e3 * math.sqrt(tilts.mean(axis=0).sum()))


@dataclass(frozen=True)
class ActiveSurface:
    """A heliostat's active surface or candidate, without its arrays."""

    id: int
    version: int
    source: str
    valid_from: datetime | None
    misfit: float | None
    trusted: bool | None = None
    warnings: Sequence[str] | None = None
    warned_since: datetime | None = None
    acknowledged_by: str | None = None
    acknowledged_at: datetime | None = None
    suspicious: Sequence[str] | None = None
    sun_span_deg: float | None = None
    created_at: datetime | None = None

    @property
    def age_days(self) -> float | None:
        """Time since the surface describes the mirror [days]; None if unknown."""
        return (
            None if self.valid_from is None else (now() - self.valid_from).total_seconds() / 86400
        )


@dataclass(frozen=True)
class HeliostatOverview:
    """Summary of a heliostat; None means unknown or not computed yet.

    A ``rank`` without an accuracy means that no photograph can evaluate the surface, because it was
    computed from all of them. ``candidate`` is the newest version of a heliostat without an active
    surface. ``range_m`` is the distance to the nearest receiver's centre [m]. ``id`` is the row id,
    ``updated_at`` when its properties changed. ``pending`` are the results that no worker has
    computed yet, with what they will be based on.
    """

    name: str
    east_m: float
    north_m: float
    photographs: int = 0
    refused: int = 0
    newest: int | None = None
    corrected: datetime | None = None
    surface: ActiveSurface | None = None
    figures: FieldTotals | None = None
    rank: Rank | None = None
    range_m: float | None = None
    mounted: MountKey | None = None
    pointing: PointingState | None = None
    fall: AccuracyFall | None = None
    candidate: ActiveSurface | None = None
    id: int = 0
    updated_at: datetime | None = None
    pending: Mapping[str, int | str] = field(default_factory=dict)

    @property
    def pointing_m(self) -> float | None:
        """The pointing error on the receiver, perpendicular to the beam [m]."""
        if self.pointing is None or self.pointing.error_mrad is None or self.range_m is None:
            return None
        return 1e-3 * self.pointing.error_mrad * self.range_m

    def accuracy_key(self, model: int) -> str | None:
        """What the accuracy is based on, under a version of the model; None without a photograph.

        Without an active surface it is that of the ideal mirror.
        """
        if self.newest is None:
            return None
        calibrated_at = None if self.mounted is None else self.mounted.calibrated_at
        surface = 0 if self.surface is None else self.surface.id
        parts = (surface, self.corrected, model, calibrated_at, self.updated_at)
        return result_key(*parts, self.newest)


def _current_surfaces(
    session: Session, heliostat: int | None
) -> tuple[dict[int, ActiveSurface], dict[int, ActiveSurface]]:
    """Active surfaces, and candidates of heliostats without an active one, by heliostat id."""
    order = (SurfaceRow.is_candidate, *newest_first())
    place = func.row_number().over(partition_by=SurfaceRow.heliostat_id, order_by=order)
    standing = select(SurfaceRow.id, place.label("place"))
    if heliostat is not None:
        standing = standing.where(SurfaceRow.heliostat_id == heliostat)
    ranked = standing.subquery()
    columns = (getattr(SurfaceRow, one.name) for one in fields(ActiveSurface))
    query = select(SurfaceRow.heliostat_id, SurfaceRow.is_candidate, *columns)
    # The database selects them, because a plant has many versions and each refresh reads them.
    query = query.join(ranked, ranked.c.id == SurfaceRow.id).where(ranked.c.place == 1)
    active: dict[int, ActiveSurface] = {}
    candidates: dict[int, ActiveSurface] = {}
    for number, is_candidate, *values in session.execute(query):
        (candidates if is_candidate else active)[number] = ActiveSurface(*values)
    return active, candidates


class _PhotographCounts(NamedTuple):
    """Counts of a heliostat's photographs, and its newest rows.

    ``refused`` counts photographs without a used image. ``used`` is the row id of the newest used
    image, ``newest`` that of the newest image. ``corrected`` is when a photograph was last
    corrected.
    """

    photographs: int = 0
    refused: int = 0
    used: int | None = None
    newest: int | None = None
    corrected: datetime | None = None


def _photographs(session: Session, heliostat: int | None) -> dict[int, _PhotographCounts]:
    """Count photographs by heliostat id."""
    row, has_image = MeasurementRow, MeasurementRow.image_sha256.is_not(None)
    is_used = case((row.accepted & has_image, 1), else_=0)
    each = select(
        row.heliostat_id,
        func.max(case((has_image, 1), else_=0)).label("shown"),
        func.max(is_used).label("used"),
        func.max(case((row.accepted & has_image, row.id))).label("newest_used"),
        func.max(row.id).label("newest"),
        func.max(row.corrected_at).label("corrected"),
    )
    if heliostat is not None:
        each = each.where(row.heliostat_id == heliostat)
    # One photograph may have several images.
    images = each.group_by(
        row.heliostat_id, func.coalesce(row.external_id, row.identifier)
    ).subquery()
    query = select(
        images.c.heliostat_id,
        func.sum(images.c.shown),
        func.sum(images.c.shown) - func.sum(images.c.used),
        *(
            func.max(column)
            for column in (images.c.newest_used, images.c.newest, images.c.corrected)
        ),
    )
    return {
        number: _PhotographCounts(*counts)
        for number, *counts in session.execute(query.group_by(images.c.heliostat_id))
    }


def _mounts(session: Session, heliostat: int | None) -> dict[int, tuple[int, datetime]]:
    """Ids and times of the newest mounts, by heliostat id.

    Heliostats that changed since their calibration are left out.
    """
    newest = select(func.max(MountRow.id)).group_by(MountRow.heliostat_id)
    if heliostat is not None:
        newest = newest.where(MountRow.heliostat_id == heliostat)
    query = select(MountRow.heliostat_id, MountRow.id, MountRow.created_at).where(
        MountRow.id.in_(newest)
    )
    query = query.join(HeliostatRow, HeliostatRow.id == MountRow.heliostat_id)
    found = session.execute(query.where(HeliostatRow.updated_at <= MountRow.created_at))
    return {number: (mount, at) for number, mount, at in found}


def read_summaries(session: Session, heliostat: int | None = None) -> list[HeliostatOverview]:
    """Summarize all heliostats in the order of their names, or only one.

    Results that take long to compute are those that a worker wrote, if they are valid.
    """
    surfaces, candidates = _current_surfaces(session, heliostat)
    photographs, mounted = _photographs(session, heliostat), _mounts(session, heliostat)
    model = model_versions.current_number(session)
    receivers = [store.stored_receiver(row).center for row in store.list_receivers(session)]
    states = _states(session, heliostat)
    row, none = HeliostatRow, _PhotographCounts()
    dates, enu = (row.photographs_changed_at, row.updated_at), (row.east_m, row.north_m, row.up_m)
    query = select(row.id, row.name, *dates, *enu)
    if heliostat is not None:
        query = query.where(row.id == heliostat)
    lines = []
    for number, name, changed, updated_at, *place in session.execute(query.order_by(row.name)):
        taken, mount = photographs.get(number, none), mounted.get(number)
        corrected = max((at for at in (taken.corrected, changed) if at is not None), default=None)
        line = HeliostatOverview(
            name,
            place[0],
            place[1],
            taken.photographs,
            taken.refused,
            taken.used,
            corrected,
            surfaces.get(number),
            range_m=min((math.dist(place, center) for center in receivers), default=None),
            mounted=None
            if mount is None
            else MountKey(name, *mount, taken.newest, corrected, model),
            candidate=candidates.get(number),
            id=number,
            updated_at=updated_at,
        )
        lines.append(_with_results(line, states.get(number), model))
    return lines


def _states(session: Session, heliostat: int | None) -> dict[int, HeliostatStateRow]:
    """What workers computed, by heliostat id."""
    query = select(HeliostatStateRow)
    if heliostat is not None:
        query = query.where(HeliostatStateRow.heliostat_id == heliostat)
    return {row.heliostat_id: row for row in session.scalars(query)}


def _with_results(
    line: HeliostatOverview, state: HeliostatStateRow | None, model: int
) -> HeliostatOverview:
    """Add the results of a state that are valid, and name those that are pending."""
    keys = {
        "surface": None if line.surface is None else line.surface.id,
        "accuracy": line.accuracy_key(model),
        "pointing": None if line.mounted is None else line.mounted.key,
    }
    wanted = {name: key for name, key in keys.items() if key is not None}
    state = state or HeliostatStateRow()
    valid = [name for name, key in wanted.items() if getattr(state, _RESULTS[name].key) == key]
    totals, pointing = None, None
    if "surface" in valid and state.deviation_mm is not None:
        totals = FieldTotals(state.deviation_mm, state.uncertainty_mm)
    fall = None
    if "accuracy" in valid and state.fall is not None:
        fall = FALL.validate_python(state.fall)
    if "pointing" in valid and state.pointing is not None:
        pointing = _POINTING.validate_python(state.pointing)
    rank = Rank(state.accuracy, state.held_out or 0) if "accuracy" in valid else None
    pending = {name: key for name, key in wanted.items() if name not in valid}
    return replace(line, figures=totals, rank=rank, pointing=pointing, fall=fall, pending=pending)


# --- results that take long to compute
# --------------------------------------------------------------------------------------------------


def compute_results(runtime: Runtime, line: HeliostatOverview) -> dict[str, object]:
    """Compute the pending results of a heliostat, as columns of `HeliostatStateRow`."""
    columns: dict[str, object] = {"computed_at": now()}
    for name, key in line.pending.items():
        result = _RESULTS[name]
        columns |= dict.fromkeys(result.columns) | {result.key: key}
        try:
            columns |= zip(result.columns, result.compute(runtime, line), strict=True)
        except SQLAlchemyError:
            raise
        except Exception:  # those of other heliostats must be computed
            logger.exception("heliostat %s: its %s cannot be computed", line.name, name)
    return columns


def _compute_totals(runtime: Runtime, line: HeliostatOverview) -> Sequence[Any]:
    assert line.surface is not None
    with runtime.database.reading() as session:
        query = select(SurfaceRow.arrays).where(SurfaceRow.id == line.surface.id)
        totals = field_totals(session.scalars(query).one())
    return totals.deviation_mm, totals.uncertainty_mm


def _compute_accuracy(runtime: Runtime, line: HeliostatOverview) -> Sequence[Any]:
    key = str(line.pending["accuracy"]).rpartition(" ")[0]  # without the newest photograph
    with runtime.database.reading() as session:
        state = session.get(HeliostatStateRow, line.id)
    known = state.accuracies if state is not None and state.series_key == key else None
    found = accuracy_series(runtime, line.name, known or {})
    if found is None:
        return None, 0, None, None, None
    fall = None if found.fall is None else FALL.dump_python(found.fall, mode="json")
    return found.rank.accuracy, found.rank.photographs, key, found.accuracies, fall


def _compute_pointing(runtime: Runtime, line: HeliostatOverview) -> Sequence[Any]:
    assert line.mounted is not None
    pointing = find_pointing(runtime, line.mounted)
    return (pointing and _POINTING.dump_python(pointing, mode="json"),)


class _StoredResult(NamedTuple):
    """Columns of a result in `HeliostatStateRow`, that of its key, and the function for it."""

    key: str
    columns: tuple[str, ...]
    compute: Callable[[Runtime, HeliostatOverview], Sequence[Any]]


_RESULTS = {
    "surface": _StoredResult("surface_id", ("deviation_mm", "uncertainty_mm"), _compute_totals),
    "accuracy": _StoredResult(
        "accuracy_key",
        ("accuracy", "held_out", "series_key", "accuracies", "fall"),
        _compute_accuracy,
    ),
    "pointing": _StoredResult("pointing_key", ("pointing",), _compute_pointing),
}
"""Results of a heliostat that take long to compute."""


# --- changes of the field
# --------------------------------------------------------------------------------------------------


def read_marks(session: Session) -> str:
    """Last id, and sum of the newest ids, of each table behind the overview and the alarms.

    Other changes of a summary leave an entry in the audit trail. A transaction that began earlier
    may end later. The last id alone would miss its rows.
    """
    ends = [
        select(table.id).order_by(table.id.desc()).limit(_NEWEST).subquery() for table in _TABLES
    ]
    each = [
        select(func.coalesce(func.max(end.c.id), 0), func.coalesce(func.sum(end.c.id), 0))
        for end in ends
    ]
    waiting = select(func.count(), func.coalesce(func.sum(JobRow.id), 0)).where(
        JobRow.state.in_(("queued", "running"))
    )
    found = session.execute(union_all(*each, waiting))
    model = model_versions.current_number(session)
    return " ".join(f"{int(last)}:{int(total)}" for last, total in found) + f" {model}"


class _Snapshot(NamedTuple):
    """Summaries as read at one time, and how long that took [s]."""

    lines: list[HeliostatOverview]
    took_s: float


def with_pointing(runtime: Runtime, line: HeliostatOverview) -> HeliostatOverview:
    """Add a heliostat's pointing error, computed now if pending; no session should be open."""
    if line.mounted is None or "pointing" not in line.pending:
        return line
    return replace(line, pointing=find_pointing(runtime, line.mounted))


@dataclass(frozen=True)
class FieldOverview:
    """All heliostats by name.

    ``pending`` counts heliostats with pending results. ``is_behind`` is True while a newer state is
    being read.
    """

    lines: list[HeliostatOverview]
    pending: int
    is_behind: bool


class FieldOverviewCache:
    """Cache of the field overview.

    Reading a large field takes longer than a page may wait. Until it is read, pages show the
    previous state.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._readings: BackgroundCache[str, _Snapshot | None] = BackgroundCache(
            self._read, None, "field", 1
        )
        self._last: _Snapshot | None = None
        self._recent = RecentResults(_RECENT_S)

    def close(self) -> None:
        """Stop the background work."""
        self._readings.close()

    @property
    def is_large(self) -> bool:
        """Whether a page does not wait for results of all heliostats."""
        return self._last is not None and len(self._last.lines) > LARGE

    def recent(self, session: Session, key: Hashable, compute: Callable[[], Result]) -> Result:
        """The result of ``compute``, or for a large field a recent one.

        A recent result is used only if nothing was stored since.
        """
        if not self.is_large:
            return compute()
        return self._recent.get((read_marks(session), key), compute)

    def read(self, session: Session, timeout_s: float = 0.0) -> FieldOverview:
        """Read the field overview.

        If a large field has changed and reading takes longer than ``timeout_s``, the previous state
        is returned.

        Raises
        ------
        BusyError
            If the field was never read yet and reading takes too long.
        """
        last = self._last
        if last is None or last.took_s < _QUICK_S:
            timeout_s = PATIENCE_S
        states = field_state.read_field_state(session).states
        found = self._readings.wait_for(f"{read_marks(session)} {states}", timeout_s)
        reading = self._last = found or last
        if reading is None:
            raise BusyError("the field is being read; ask again as Retry-After says")
        pending = sum(bool(line.pending) for line in reading.lines)
        return FieldOverview(reading.lines, pending, found is None)

    def _read(self, _key: str) -> _Snapshot:
        start = time.perf_counter()
        with self._runtime.database.reading() as session:
            lines = read_summaries(session)
        return _Snapshot(lines, time.perf_counter() - start)
