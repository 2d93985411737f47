"""The field at a glance: every heliostat with what its twin is worth."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TypeVar

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service import store
from service.base.arrays import unpack
from service.store.columns import now
from service.store.tables import HeliostatRow, MeasurementRow, MountRow, SurfaceRow
from service.twin import versions
from service.twin.accuracy import AccuracyBook, Rank, State
from service.twin.pointing_errors import Mounted, Pointing, PointingBook
from service.twin.runtime import Runtime

Value = TypeVar("Value", int, datetime)

# Surfaces that are read at a time, to bound memory.
_CHUNK = 200


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
        return State(self.name, self.surface.id, self.newest, self.corrected, model)


def _current_surfaces(session: Session, heliostat: int | None = None) -> dict[int, Current]:
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
    )
    # The database picks them: a plant has many versions, and this is read at every refresh.
    query = query.join(ranked, ranked.c.id == SurfaceRow.id).where(ranked.c.place == 1)
    return {row.heliostat_id: Current(*tuple(row)[1:]) for row in session.execute(query)}


@dataclass(frozen=True)
class _Taken:
    """Of a heliostat's photographs: how many, the newest row, and the last correction."""

    count: int = 0
    newest: int | None = None
    corrected: datetime | None = None


def _photographs(session: Session, heliostat: int | None = None) -> dict[tuple[int, bool], _Taken]:
    """By heliostat, of one or of all, and whether they were accepted."""
    row = MeasurementRow
    query = select(row.heliostat_id, row.accepted, func.count(), func.max(row.id), func.max(row.corrected_at))
    if heliostat is not None:
        query = query.where(row.heliostat_id == heliostat)
    found = session.execute(query.group_by(row.heliostat_id, row.accepted))
    return {(told[0], told[1]): _Taken(*told[2:]) for told in found}


def _mounts(session: Session, heliostat: int | None = None) -> dict[int, tuple[int, datetime]]:
    """Of heliostats that have not changed since they were calibrated the newest mount, and when that was."""
    newest = select(func.max(MountRow.id)).group_by(MountRow.heliostat_id)
    if heliostat is not None:
        newest = newest.where(MountRow.heliostat_id == heliostat)
    query = select(MountRow.heliostat_id, MountRow.id, MountRow.created_at).where(MountRow.id.in_(newest))
    query = query.join(HeliostatRow, HeliostatRow.id == MountRow.heliostat_id)
    found = session.execute(query.where(HeliostatRow.updated_at <= MountRow.created_at))
    return {number: (mount, at) for number, mount, at in found}


def _latest(values: Iterable[Value | None]) -> Value | None:
    return max((value for value in values if value is not None), default=None)


def read_lines(session: Session, heliostat: int | None = None) -> list[Line]:
    """All heliostats in the order of their names, or one, without what arrays and photographs' spots would tell."""
    surfaces = _current_surfaces(session, heliostat)
    photographs, mounted = _photographs(session, heliostat), _mounts(session, heliostat)
    receivers = [row.center_m for row in store.list_receivers(session)]
    row, none = HeliostatRow, _Taken()
    query = select(row.id, row.name, row.east_m, row.north_m, row.up_m)
    if heliostat is not None:
        query = query.where(row.id == heliostat)
    lines = []
    for number, name, *place in session.execute(query.order_by(row.name)):
        kept, refused = photographs.get((number, True), none), photographs.get((number, False), none)
        newest, corrected = _latest((kept.newest, refused.newest)), _latest((kept.corrected, refused.corrected))
        line = Line(
            name,
            place[0],
            place[1],
            kept.count + refused.count,
            refused.count,
            kept.newest,
            corrected,
            surfaces.get(number),
            range_m=min((math.dist(place, center) for center in receivers), default=None),
            mounted=Mounted(name, *mounted[number], newest, corrected) if number in mounted else None,
        )
        lines.append(line)
    return lines


class FieldBook:
    """What takes arrays to tell of each heliostat: computed once, kept in memory."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._accuracies = AccuracyBook(runtime)
        self._pointing = PointingBook(runtime)
        self._figures: dict[int, Figures] = {}

    def close(self) -> None:
        """End what is under way."""
        self._accuracies.close()
        self._pointing.close()

    def _figures_of(self, session: Session, surfaces: Sequence[int]) -> dict[int, Figures]:
        known = self._figures  # another request may put its own in their place meanwhile
        missing = [number for number in surfaces if number not in known]
        fresh: dict[int, Figures] = {}
        for start in range(0, len(missing), _CHUNK):
            chunk = select(SurfaceRow.id, SurfaceRow.arrays).where(SurfaceRow.id.in_(missing[start : start + _CHUNK]))
            fresh.update((number, figures_of(arrays)) for number, arrays in session.execute(chunk))
        # Surfaces that are no longer current are let go.
        figures = {**{number: known[number] for number in surfaces if number in known}, **fresh}
        self._figures = figures
        return figures

    def pointed(self, session: Session) -> tuple[list[Line], int]:
        """All heliostats with their pointing errors but no arrays' figures, and how many are being worked out."""
        lines, known, pending = self._lines(session)
        return [replace(line, pointing=known[line.name]) if line.name in known else line for line in lines], pending

    def _lines(self, session: Session) -> tuple[list[Line], dict[str, Pointing | None], int]:
        lines = read_lines(session)
        return lines, *self._pointing.look_up(line.mounted for line in lines if line.mounted is not None)

    def with_pointing(self, line: Line) -> Line:
        """One heliostat with its pointing error, which it waits for, without a session open."""
        return line if line.mounted is None else replace(line, pointing=self._pointing.wait_for(line.mounted))

    def read(self, session: Session) -> tuple[list[Line], int]:
        """All heliostats, and of how many figures are still being worked out."""
        lines, pointing, pointless = self._lines(session)
        figures = self._figures_of(session, [line.surface.id for line in lines if line.surface is not None])
        model = versions.current_number(session)
        states = (line.state(model) for line in lines)
        ranks, pending = self._accuracies.look_up(state for state in states if state is not None)
        return [
            replace(
                line,
                figures=None if line.surface is None else figures.get(line.surface.id),
                rank=ranks.get(line.name),
                pointing=pointing.get(line.name),
            )
            for line in lines
        ], max(pending, pointless)
