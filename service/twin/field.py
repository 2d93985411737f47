"""The field at a glance: every heliostat with what its twin is worth."""

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import case, func, select, union_all
from sqlalchemy.orm import Session

from model.surface import canting_rises, split_canting
from service import store
from service.base.arrays import unpack
from service.base.faults import BusyError
from service.store.columns import now
from service.store.job_tables import AuditRow
from service.store.tables import HeliostatRow, MeasurementRow, MountRow, SurfaceRow
from service.twin import versions
from service.twin.accuracy import AccuracyBook, Rank, State
from service.twin.book import Book
from service.twin.cameras import CameraWatch
from service.twin.pointing_errors import Mounted, Pointing, PointingBook
from service.twin.runtime import Runtime

# Tables that tell whether the field has changed, and how many of their newest rows are looked at.
_TABLES = (HeliostatRow, MeasurementRow, SurfaceRow, MountRow, AuditRow)
_NEWEST = 1000
# A field that is read so quickly [s] is waited for whenever it changed, and so are its figures.
_QUICK_S = 0.2
PATIENCE_S = 20.0
# Figures that are kept: the surfaces of the largest plant several times over.
_MOST = 200_000


@dataclass(frozen=True)
class Figures:
    """Of a surface [mm]: root mean square over the mirror of its deviation, and of its standard deviation if known."""

    deviation_mm: float
    uncertainty_mm: float | None


def figures_of(arrays: bytes) -> Figures:
    """The figures of a stored surface."""
    unpacked = unpack(arrays)
    z, z_std = unpacked["z"], unpacked["z_std"]
    uncertainty = float(np.sqrt(np.mean(z_std**2)) * 1e3)
    return Figures(float(np.sqrt(np.mean(z**2)) * 1e3), uncertainty or None)


@dataclass(frozen=True)
class Shape:
    """What kind of deviation from the ideal a surface has, as root mean squares over the mirror.

    ``deviation_mm`` is all of it; ``waviness_mm`` that within facets; ``canting_mrad`` how far facets are tilted.
    """

    deviation_mm: float
    waviness_mm: float
    canting_mrad: float


def shape_of(z: NDArray[np.floating], size: tuple[float, float]) -> Shape:
    """The shape of heights (4, 8, 8) [m] on a mirror of ``size``, width and height [m], two facets each way."""
    _, waviness = split_canting(z)
    tilts = (canting_rises(z) / (np.array(size) / 2)) ** 2
    deviation, wavy = (float(np.sqrt(np.mean(heights**2)) * 1e3) for heights in (z, waviness))
    return Shape(deviation, wavy, 1e3 * math.sqrt(tilts.mean(axis=0).sum()))


@dataclass(frozen=True)
class Current:
    """A heliostat's current surface, without its arrays."""

    id: int
    version: int
    source: str
    valid_from: datetime
    misfit: float | None
    trusted: bool | None = None
    doubts: Sequence[str] | None = None
    doubted_since: datetime | None = None
    seen_by: str | None = None
    seen_at: datetime | None = None
    suspicious: Sequence[str] | None = None
    sun_span_deg: float | None = None

    @property
    def age_days(self) -> float | None:
        """Since it describes the mirror; a measured one may be of unknown age, for which 1970 stands."""
        return None if self.valid_from.year <= 1970 else (now() - self.valid_from).total_seconds() / 86400


@dataclass(frozen=True)
class Line:
    """A heliostat in the field; what is None is not known (yet).

    Where it has a ``rank`` without an accuracy, no photograph can judge its surface: it was made from all of them.
    ``range_m`` [m] is how far the nearest receiver's centre lies from it.
    """

    name: str
    east_m: float
    north_m: float
    photographs: int = 0
    refused: int = 0
    newest: int | None = None
    corrected: datetime | None = None
    surface: Current | None = None
    figures: Figures | None = None
    rank: Rank | None = None
    range_m: float | None = None
    mounted: Mounted | None = None
    pointing: Pointing | None = None

    @property
    def pointing_m(self) -> float | None:
        """The pointing error on the receiver [m], across the light's way."""
        if self.pointing is None or self.pointing.error_mrad is None or self.range_m is None:
            return None
        return 1e-3 * self.pointing.error_mrad * self.range_m

    def state(self, model: int) -> State | None:
        """What its accuracy by this version of the model depends on; None where there is nothing to compare."""
        if self.surface is None or self.newest is None:
            return None
        calibrated_at = None if self.mounted is None else self.mounted.calibrated_at
        return State(self.name, self.surface.id, self.newest, self.corrected, model, calibrated_at)


def _current_surfaces(session: Session, heliostat: int | None) -> dict[int, Current]:
    place = func.row_number().over(
        partition_by=SurfaceRow.heliostat_id, order_by=(SurfaceRow.valid_from.desc(), SurfaceRow.version.desc())
    )
    standing = select(SurfaceRow.id, place.label("place")).where(~SurfaceRow.set_aside)
    if heliostat is not None:
        standing = standing.where(SurfaceRow.heliostat_id == heliostat)
    ranked = standing.subquery()
    query = select(
        SurfaceRow.heliostat_id,
        SurfaceRow.id,
        SurfaceRow.version,
        SurfaceRow.source,
        SurfaceRow.valid_from,
        SurfaceRow.misfit,
        SurfaceRow.trusted,
        SurfaceRow.doubts,
        SurfaceRow.doubted_since,
        SurfaceRow.seen_by,
        SurfaceRow.seen_at,
        SurfaceRow.suspicious,
        SurfaceRow.sun_span_deg,
    )
    # The database picks them: a plant has many versions, and this is read at every refresh.
    query = query.join(ranked, ranked.c.id == SurfaceRow.id).where(ranked.c.place == 1)
    return {row.heliostat_id: Current(*tuple(row)[1:]) for row in session.execute(query)}


class _Taken(NamedTuple):
    """Of a heliostat's photographs: how many, of how many no image is used, the newest used image, the newest of all.

    And when one was last corrected.
    """

    photographs: int = 0
    refused: int = 0
    used: int | None = None
    newest: int | None = None
    corrected: datetime | None = None


def _photographs(session: Session, heliostat: int | None) -> dict[int, _Taken]:
    """By heliostat."""
    row, is_used = MeasurementRow, case((MeasurementRow.accepted, 1), else_=0)
    each = select(
        row.heliostat_id,
        func.max(is_used).label("used"),
        func.max(case((row.accepted, row.id))).label("newest_used"),
        func.max(row.id).label("newest"),
        func.max(row.corrected_at).label("corrected"),
    )
    if heliostat is not None:
        each = each.where(row.heliostat_id == heliostat)
    # A photograph may have come as several images.
    images = each.group_by(row.heliostat_id, func.coalesce(row.external_id, row.identifier)).subquery()
    found = select(
        images.c.heliostat_id,
        func.count(),
        func.count() - func.sum(images.c.used),
        *(func.max(column) for column in (images.c.newest_used, images.c.newest, images.c.corrected)),
    )
    return {number: _Taken(*told) for number, *told in session.execute(found.group_by(images.c.heliostat_id))}


def _mounts(session: Session, heliostat: int | None) -> dict[int, tuple[int, datetime]]:
    """Of heliostats that have not changed since they were calibrated the newest mount, and when that was."""
    newest = select(func.max(MountRow.id)).group_by(MountRow.heliostat_id)
    if heliostat is not None:
        newest = newest.where(MountRow.heliostat_id == heliostat)
    query = select(MountRow.heliostat_id, MountRow.id, MountRow.created_at).where(MountRow.id.in_(newest))
    query = query.join(HeliostatRow, HeliostatRow.id == MountRow.heliostat_id)
    found = session.execute(query.where(HeliostatRow.updated_at <= MountRow.created_at))
    return {number: (mount, at) for number, mount, at in found}


def read_lines(session: Session, heliostat: int | None = None) -> list[Line]:
    """All heliostats in the order of their names, or one, without what arrays and photographs' spots would tell."""
    surfaces = _current_surfaces(session, heliostat)
    photographs, mounted = _photographs(session, heliostat), _mounts(session, heliostat)
    model, receivers = versions.current_number(session), [row.center_m for row in store.list_receivers(session)]
    row, none = HeliostatRow, _Taken()
    query = select(row.id, row.name, row.east_m, row.north_m, row.up_m)
    if heliostat is not None:
        query = query.where(row.id == heliostat)
    lines = []
    for number, name, *place in session.execute(query.order_by(row.name)):
        taken, mount = photographs.get(number, none), mounted.get(number)
        line = Line(
            name,
            place[0],
            place[1],
            taken.photographs,
            taken.refused,
            taken.used,
            taken.corrected,
            surfaces.get(number),
            range_m=min((math.dist(place, center) for center in receivers), default=None),
            mounted=None if mount is None else Mounted(name, *mount, taken.newest, taken.corrected, model),
        )
        lines.append(line)
    return lines


Marks = tuple[tuple[int, int], ...]
"""What changes with the store; see `_marks`."""


def _marks(session: Session) -> Marks:
    """The last row of each table that a field is read from, and which ones are the newest before it.

    Whatever else changes a line leaves an entry in the audit trail. Transactions that began earlier may end later, so
    the last number alone would miss them.
    """
    ends = [select(table.id).order_by(table.id.desc()).limit(_NEWEST).subquery() for table in _TABLES]
    each = [select(func.coalesce(func.max(end.c.id), 0), func.coalesce(func.sum(end.c.id), 0)) for end in ends]
    return tuple((int(last), int(total)) for last, total in session.execute(union_all(*each)))


class _Reading:
    """The lines as they were read at one time, completed as figures and ranks become known."""

    def __init__(self, lines: list[Line], model: int, took_s: float) -> None:
        self.took_s = took_s
        self._lines, self._lock = lines, threading.Lock()
        self._figures = {i: line.surface.id for i, line in enumerate(lines) if line.surface is not None}
        self._ranks = {i: state for i, line in enumerate(lines) if (state := line.state(model)) is not None}
        self._mounts = {i: line.mounted for i, line in enumerate(lines) if line.mounted is not None}

    def complete(
        self,
        figures: Book[int, Figures | None],
        ranks: AccuracyBook,
        pointing: PointingBook,
        wait_s: float = 0.0,
    ) -> tuple[list[Line], int]:
        """The lines, and of how many of them something is still being worked out."""
        with self._lock:
            shapes, _ = figures.look_up(self._figures.values(), wait_s)
            worth, _ = ranks.look_up(self._ranks.values())
            pointed, _ = pointing.look_up(self._mounts.values())
            lines = self._lines.copy()  # others read in the former ones
            for i in [i for i, number in self._figures.items() if number in shapes]:
                lines[i] = replace(lines[i], figures=shapes[self._figures.pop(i)])
            for i in [i for i, state in self._ranks.items() if state.heliostat in worth]:
                lines[i] = replace(lines[i], rank=worth[self._ranks.pop(i).heliostat])
            for i in [i for i, state in self._mounts.items() if state.heliostat in pointed]:
                lines[i] = replace(lines[i], pointing=pointed[self._mounts.pop(i).heliostat])
            self._lines = lines
            return lines, len(self._figures.keys() | self._ranks.keys() | self._mounts.keys())


@dataclass(frozen=True)
class FieldNow:
    """All heliostats by name, how many of them something is still worked out of, and whether newer ones are read."""

    lines: list[Line]
    pending: int
    is_behind: bool


class FieldBook:
    """The field, read once for what it depends on, with what takes arrays to tell of each heliostat.

    To read a large one takes longer than a page may: until then pages show it as it was.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._accuracies, self._pointing = AccuracyBook(runtime), PointingBook(runtime)
        self._figures: Book[int, Figures | None] = Book(self._figures_of, None, "figures", _MOST)
        self._readings: Book[tuple[Marks, int], _Reading | None] = Book(self._read, None, "field", 1)
        self._last: _Reading | None = None
        self.cameras = CameraWatch()

    def close(self) -> None:
        """End what is under way."""
        for book in (self._readings, self._figures, self._accuracies, self._pointing):
            book.close()

    def read(self, session: Session, patience_s: float = 0.0) -> FieldNow:
        """The field; the former one where it is large, changed, and not read again within ``patience_s``.

        Raises
        ------
        BusyError
            Where it was never read yet, and that takes too long.
        """
        last = self._last
        if last is None or last.took_s < _QUICK_S:
            patience_s = PATIENCE_S
        found = self._readings.wait_for((_marks(session), versions.current_number(session)), patience_s)
        reading = self._last = found or last
        if reading is None:
            raise BusyError("the field is being read; ask again as Retry-After says")
        return FieldNow(*reading.complete(self._figures, self._accuracies, self._pointing), found is None)

    def with_pointing(self, line: Line) -> Line:
        """One heliostat with its pointing error, which it waits for, without a session open."""
        return line if line.mounted is None else replace(line, pointing=self._pointing.wait_for(line.mounted))

    def _read(self, depends: tuple[Marks, int]) -> _Reading:
        _, model = depends
        began = time.perf_counter()
        with self._runtime.database.reading() as session:
            reading = _Reading(read_lines(session), model, time.perf_counter() - began)
        reading.complete(self._figures, self._accuracies, self._pointing, _QUICK_S)
        return reading

    def _figures_of(self, surface: int) -> Figures:
        with self._runtime.database.reading() as session:
            return figures_of(session.scalars(select(SurfaceRow.arrays).where(SurfaceRow.id == surface)).one())
