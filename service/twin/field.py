"""The field at a glance: every heliostat with what its twin is worth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.surface import split_canting
from service.base.arrays import unpack
from service.store.columns import now
from service.store.tables import HeliostatRow, MeasurementRow, SurfaceRow
from service.twin import versions
from service.twin.accuracy import AccuracyBook, Rank, State
from service.twin.runtime import Runtime

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
class Shape:
    """What kind of deviation from the ideal a surface has, as root mean squares over the mirror.

    ``deviation_mm`` is all of it; ``waviness_mm`` that within facets; ``canting_mrad`` how far facets are tilted.
    """

    deviation_mm: float
    waviness_mm: float
    canting_mrad: float


def shape_of(z: NDArray[np.floating], size: tuple[float, float]) -> Shape:
    """The shape of heights (4, 8, 8) [m] on a mirror of ``size``, width and height [m], two facets each way."""
    canting, waviness = split_canting(z)
    rises = canting[:, -1, :] - canting[:, 0, :], canting[:, :, -1] - canting[:, :, 0]
    tilts = [float(np.mean((rise / (side / 2)) ** 2)) for rise, side in zip(rises, size, strict=True)]
    deviation, wavy = (float(np.sqrt(np.mean(heights**2)) * 1e3) for heights in (z, waviness))
    return Shape(deviation, wavy, 1e3 * math.sqrt(sum(tilts)))


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

    @property
    def age_days(self) -> float | None:
        """Since it describes the mirror; a measured one may be of unknown age, for which 1970 stands."""
        return None if self.valid_from.year <= 1970 else (now() - self.valid_from).total_seconds() / 86400


@dataclass(frozen=True)
class Line:
    """A heliostat in the field; what is None is not known (yet).

    Where it has a ``rank`` without an accuracy, no photograph can judge its surface: it was made from all of them.
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

    def state(self, model: int) -> State | None:
        """What its accuracy by this version of the model depends on; None where there is nothing to compare."""
        if self.surface is None or self.newest is None:
            return None
        return State(self.name, self.surface.id, self.newest, self.corrected, model)


def _current_surfaces(session: Session) -> dict[int, Current]:
    place = func.row_number().over(
        partition_by=SurfaceRow.heliostat_id, order_by=(SurfaceRow.valid_from.desc(), SurfaceRow.version.desc())
    )
    ranked = select(SurfaceRow.id, place.label("place")).where(~SurfaceRow.set_aside).subquery()
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
    )
    # The database picks them: a plant has many versions, and this is read at every refresh.
    query = query.join(ranked, ranked.c.id == SurfaceRow.id).where(ranked.c.place == 1)
    return {row.heliostat_id: Current(*tuple(row)[1:]) for row in session.execute(query)}


def _photographs(session: Session) -> dict[tuple[int, bool], tuple[int, int | None, datetime | None]]:
    """Of each heliostat's photographs, accepted or not: how many, the id of the newest, and the last correction."""
    row = MeasurementRow
    query = select(row.heliostat_id, row.accepted, func.count(), func.max(row.id), func.max(row.corrected_at))
    found = session.execute(query.group_by(row.heliostat_id, row.accepted))
    return {(heliostat, accepted): (count, newest, at) for heliostat, accepted, count, newest, at in found}


def read_lines(session: Session) -> list[Line]:
    """All heliostats in the order of their names, without what arrays would tell."""
    surfaces, photographs = _current_surfaces(session), _photographs(session)
    columns = select(HeliostatRow.id, HeliostatRow.name, HeliostatRow.east_m, HeliostatRow.north_m)
    lines = []
    for number, name, east, north in session.execute(columns.order_by(HeliostatRow.name)):
        accepted, newest, *kept = photographs.get((number, True), (0, None, None))
        refused, _, *others = photographs.get((number, False), (0, None, None))
        corrected = max((moment for moment in (*kept, *others) if moment is not None), default=None)
        lines.append(Line(name, east, north, accepted + refused, refused, newest, corrected, surfaces.get(number)))
    return lines


class FieldBook:
    """What takes arrays to tell of each heliostat: computed once, kept in memory."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._accuracies = AccuracyBook(runtime)
        self._figures: dict[int, Figures] = {}

    def close(self) -> None:
        """End what is under way."""
        self._accuracies.close()

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

    def read(self, session: Session) -> tuple[list[Line], int]:
        """All heliostats, and how many accuracies are still being worked out."""
        lines = read_lines(session)
        figures = self._figures_of(session, [line.surface.id for line in lines if line.surface is not None])
        model = versions.current_number(session)
        states = (line.state(model) for line in lines)
        ranks, pending = self._accuracies.look_up(state for state in states if state is not None)
        return [
            replace(
                line,
                figures=None if line.surface is None else figures.get(line.surface.id),
                rank=ranks.get(line.name),
            )
            for line in lines
        ], pending
