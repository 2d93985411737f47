"""Photographs: lists by pages, their corrections, and the results that depend on them.

Lists have the newest photograph first. Each photograph groups its kinds of images.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from pydantic import BaseModel, Field
from sqlalchemy import (
    ColumnElement,
    Select,
    and_,
    delete,
    exists,
    false,
    func,
    not_,
    select,
    tuple_,
    update,
)
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased

from service.base.errors import NotFoundError
from service.store.columns import now
from service.store.listing import EVER, Period
from service.store.measurements import EXCLUDED, PREFERENCE, images_of_photograph
from service.store.tables import (
    CorrectionRow,
    DriftRow,
    ForecastRow,
    HeliostatRow,
    MeasurementRow,
    SurfaceRow,
    TargetRow,
    surface_measurements,
)

PhotographVerdict = Literal["used", "refused", "excluded"]

_Row = MeasurementRow
_Other = aliased(MeasurementRow)


@dataclass(frozen=True)
class PhotographGroup:
    """A photograph and its images: accepted ones first, then in the order of `PREFERENCE`.

    ``mark`` is the position for the next page.
    """

    heliostat: str
    name: str
    images: tuple[MeasurementRow, ...]
    mark: int

    @property
    def best(self) -> MeasurementRow:
        """The image that decides the photograph's verdict."""
        return self.images[0]

    @property
    def verdict(self) -> PhotographVerdict:
        """Verdict: used if an image is accepted, else excluded if one was, else refused."""
        if self.best.accepted:
            return "used"
        return "excluded" if any(row.reason == EXCLUDED for row in self.images) else "refused"


@dataclass(frozen=True)
class PhotographFilter:
    """Filter of photographs: heliostat, target, verdict, and the period ``taken``.

    ``is_dated`` selects known or unknown times, ``warned`` photographs with or without warnings.
    """

    heliostat: HeliostatRow | None = None
    target: TargetRow | None = None
    verdict: PhotographVerdict | None = None
    taken: Period = EVER
    is_dated: bool | None = None
    warned: bool | None = None

    @property
    def dated(self) -> bool:
        """Whether the filter includes photographs with a known time."""
        return self.is_dated is not False

    @property
    def undated(self) -> bool:
        """Whether the filter includes photographs with an unknown time."""
        return self.is_dated is not True and self.taken == EVER


def _has_other(condition: ColumnElement[bool] | InstrumentedAttribute[bool]) -> ColumnElement[bool]:
    """Whether the same photograph has another image that fulfils ``condition``."""
    is_same = and_(_Other.heliostat_id == _Row.heliostat_id, _Other.external_id == _Row.external_id)
    return exists(select(_Other.id).where(is_same, _Other.id != _Row.id, condition))


def _represents(
    verdict: PhotographVerdict | None,
) -> list[ColumnElement[bool] | InstrumentedAttribute[bool]]:
    """Conditions that select one image per photograph, so that an index by time applies."""
    came_before, is_excluded = _Other.id < _Row.id, _Other.reason == EXCLUDED
    if verdict is None:
        return [not_(_has_other(came_before))]
    if verdict == "used":
        return [_Row.accepted, not_(_has_other(and_(came_before, _Other.accepted)))]
    refused = [not_(_Row.accepted), not_(_has_other(_Other.accepted))]
    if verdict == "excluded":
        return [*refused, _Row.reason == EXCLUDED, not_(_has_other(and_(came_before, is_excluded)))]
    return [
        *refused,
        func.coalesce(_Row.reason, "") != EXCLUDED,
        not_(_has_other(is_excluded | came_before)),
    ]


def dated_groups(
    filters: PhotographFilter, limit: int, before: tuple[datetime, int] | None = None
) -> Select[MeasurementRow]:
    """Select up to ``limit`` photographs with a known time, newest first, after the mark
    ``before``.
    """
    taken = filters.taken.conditions(_Row.taken_at)
    query = _groups(filters).where(_Row.taken_at.is_not(None), *taken)
    if before is not None:
        query = query.where(tuple_(_Row.taken_at, _Row.id) < before)
    return query.order_by(_Row.taken_at.desc(), _Row.id.desc()).limit(limit)


def undated_groups(
    filters: PhotographFilter, limit: int, before: int | None = None
) -> Select[MeasurementRow]:
    """Select up to ``limit`` photographs without a time, after ``before``, most recently received
    first.
    """
    query = _groups(filters).where(_Row.taken_at.is_(None))
    if before is not None:
        query = query.where(_Row.id < before)
    # ``taken_at`` is constant here, but an index has this order.
    return query.order_by(_Row.taken_at.desc(), _Row.id.desc()).limit(limit)


def _groups(filters: PhotographFilter) -> Select[MeasurementRow]:
    """Select photographs with any time, by one image each."""
    query = select(_Row).where(*_represents(filters.verdict))
    if filters.heliostat is not None:
        query = query.where(_Row.heliostat_id == filters.heliostat.id)
    if filters.target is not None:
        query = query.where(_Row.target_id == filters.target.id)
    if filters.warned is not None:
        query = query.where(
            _Row.warnings.is_not(None) if filters.warned else _Row.warnings.is_(None)
        )
    return query


def list_groups(
    session: Session, filters: PhotographFilter, limit: int, before: int | None = None
) -> list[PhotographGroup]:
    """Up to ``limit`` photographs after the mark ``before``, newest first.

    Raises
    ------
    NotFoundError
        If there is no such mark.
    """
    last = None if before is None else session.get(_Row, before)
    if before is not None and last is None:
        raise NotFoundError(
            f"after: there is no photograph of the mark {before}; begin at the first page"
        )
    found = list[MeasurementRow]()
    if filters.dated and (last is None or last.taken_at is not None):
        mark = None if last is None or last.taken_at is None else (last.taken_at, last.id)
        found += session.scalars(dated_groups(filters, limit, mark))
    if filters.undated and len(found) < limit:
        mark_id = None if last is None or last.taken_at is not None else last.id
        found += session.scalars(undated_groups(filters, limit - len(found), mark_id))
    return _grouped(session, found)


def get_group(session: Session, mark: int) -> PhotographGroup:
    """The photograph of a mark; NotFoundError if there is none."""
    row = session.get(_Row, mark)
    if row is None:
        raise NotFoundError(f"at: there is no photograph of the mark {mark}; begin again")
    return _grouped(session, [row])[0]


def count_groups(
    session: Session, filters: PhotographFilter, before: MeasurementRow | None = None
) -> int:
    """The number of photographs, or of those that the list has before ``before``."""
    taken = filters.taken.conditions(_Row.taken_at)
    dated = _groups(filters).where(_Row.taken_at.is_not(None), *taken)
    undated = _groups(filters).where(_Row.taken_at.is_(None))
    if before is not None and before.taken_at is not None:
        dated = dated.where(tuple_(_Row.taken_at, _Row.id) > (before.taken_at, before.id))
        undated = undated.where(false())
    elif before is not None:
        undated = undated.where(_Row.id > before.id)
    parts = [*([dated] if filters.dated else []), *([undated] if filters.undated else [])]
    counts = (select(func.count()).select_from(part.subquery()) for part in parts)
    return sum(session.scalars(count).one() for count in counts)


def _grouped(session: Session, found: Sequence[MeasurementRow]) -> list[PhotographGroup]:
    """The photographs of rows, each with all its images."""
    known = select(HeliostatRow.id, HeliostatRow.name).where(
        HeliostatRow.id.in_({row.heliostat_id for row in found})
    )
    names = dict(session.execute(known).all())
    images = _images(session, found)
    return [
        PhotographGroup(
            names[row.heliostat_id],
            row.external_id or row.identifier,
            tuple(images[row.id]),
            row.id,
        )
        for row in found
    ]


def _images(session: Session, found: Sequence[MeasurementRow]) -> dict[int, list[MeasurementRow]]:
    """All images of the photographs, by the id of each photograph's row; preferred images first."""
    images = {row.id: [row] for row in found}
    marks = {
        (row.heliostat_id, row.external_id): row.id for row in found if row.external_id is not None
    }
    named = _Row.heliostat_id.in_({of for of, _ in marks}) & _Row.external_id.in_(
        {name for _, name in marks}
    )
    for row in session.scalars(select(_Row).where(named)):
        mark = marks.get((row.heliostat_id, row.external_id or ""))
        if mark is not None and row.id != mark:
            images[mark].append(row)
    for rows in images.values():
        rows.sort(key=lambda row: (not row.accepted, PREFERENCE.index(row.kind)))
    return images


class MadeFrom(BaseModel):
    """Surface versions from a photograph, and the number of forecasts with these surfaces."""

    surface_versions: list[int] = Field(
        description="Versions of the heliostat's surface that were made from it as it was."
    )
    forecasts: int = Field(description="How many forecasts were made with those.")


def made_from(session: Session, measurement: MeasurementRow) -> MadeFrom:
    """Find the results that depend on a photograph, from any of its images."""
    links, images = surface_measurements.c, images_of_photograph(session, measurement).values()
    of = select(links.surface_id).where(links.measurement_id.in_([image.id for image in images]))
    versions = session.scalars(
        select(SurfaceRow.version).where(SurfaceRow.id.in_(of)).order_by(SurfaceRow.version)
    )
    forecasts = select(func.count()).select_from(ForecastRow).where(ForecastRow.surface_id.in_(of))
    return MadeFrom(surface_versions=list(versions), forecasts=session.scalars(forecasts).one())


def list_corrections(
    session: Session, measurement: MeasurementRow, after: int = 0
) -> Sequence[CorrectionRow]:
    """The corrections of a photograph after number ``after``, oldest first."""
    query = select(CorrectionRow).where(
        CorrectionRow.measurement_id == measurement.id, CorrectionRow.id > after
    )
    return session.scalars(query.order_by(CorrectionRow.id)).all()


def newest_correction(session: Session, measurement: MeasurementRow | None = None) -> int:
    """Number of the newest correction of a photograph, or of all: the version of what is shown.

    Read it before what is shown.
    """
    query = select(func.max(CorrectionRow.id))
    if measurement is not None:
        images = images_of_photograph(session, measurement).values()
        query = query.where(CorrectionRow.measurement_id.in_([image.id for image in images]))
    return session.scalar(query) or 0


def delete_drift(session: Session, measurements: Sequence[MeasurementRow]) -> None:
    """Delete the accuracies on arrival of photographs, because their metadata were wrong."""
    for measurement in measurements:
        measurement.forecast_accuracy = None
    numbers = [measurement.id for measurement in measurements]
    session.execute(delete(DriftRow).where(DriftRow.measurement_id.in_(numbers)))


def note_change(session: Session, heliostat: int) -> None:
    """Record that photographs of a heliostat (a row id) changed, so that results are recomputed."""
    row = HeliostatRow
    # ``updated_at`` remains, because it decides whether the calibrated mount applies.
    values = {"photographs_changed_at": now(), "updated_at": row.updated_at}
    session.execute(update(row).where(row.id == heliostat).values(values))
