"""Photographs as people look through them: one each, whatever kinds of images came of it, newest first, by pages."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from sqlalchemy import ColumnElement, Select, and_, exists, func, not_, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased

from service.base.faults import NotFoundError
from service.store.measurements import EXCLUDED, PREFERENCE
from service.store.tables import HeliostatRow, MeasurementRow, TargetRow

PhotographVerdict = Literal["used", "refused", "excluded"]

_Row = MeasurementRow
_Other = aliased(MeasurementRow)


@dataclass(frozen=True)
class Shot:
    """One photograph: its images, in the order of `PREFERENCE`, accepted ones first; ``mark`` is where a page ends."""

    heliostat: str
    name: str
    images: tuple[MeasurementRow, ...]
    mark: int

    @property
    def best(self) -> MeasurementRow:
        """The image that the photograph is judged by."""
        return self.images[0]

    @property
    def verdict(self) -> PhotographVerdict:
        """Whether any of its images is used; else whether somebody excluded it."""
        if self.best.accepted:
            return "used"
        return "excluded" if any(row.reason == EXCLUDED for row in self.images) else "refused"


@dataclass(frozen=True)
class Wanted:
    """Which photographs: those of a heliostat, on a target, of a verdict, of a time from ``since`` to before ``until``.

    The time is when one was taken or, where that is not known, when it came.
    """

    heliostat: HeliostatRow | None = None
    target: TargetRow | None = None
    verdict: PhotographVerdict | None = None
    since: datetime | None = None
    until: datetime | None = None


def _has_other(condition: ColumnElement[bool] | InstrumentedAttribute[bool]) -> ColumnElement[bool]:
    """Whether the same photograph has another image for which ``condition`` holds."""
    is_same = and_(_Other.heliostat_id == _Row.heliostat_id, _Other.external_id == _Row.external_id)
    return exists(select(_Other.id).where(is_same, _Other.id != _Row.id, condition))


def _stands_for(verdict: PhotographVerdict | None) -> list[ColumnElement[bool] | InstrumentedAttribute[bool]]:
    """What the one image fulfils by which a photograph is listed, so that an index in time's order finds it."""
    came_before, is_excluded = _Other.id < _Row.id, _Other.reason == EXCLUDED
    if verdict is None:
        return [not_(_has_other(came_before))]
    if verdict == "used":
        return [_Row.accepted, not_(_has_other(and_(came_before, _Other.accepted)))]
    refused = [not_(_Row.accepted), not_(_has_other(_Other.accepted))]
    if verdict == "excluded":
        return [*refused, _Row.reason == EXCLUDED, not_(_has_other(and_(came_before, is_excluded)))]
    return [*refused, func.coalesce(_Row.reason, "") != EXCLUDED, not_(_has_other(is_excluded | came_before))]


def page_of_shots(wanted: Wanted, limit: int, before: tuple[datetime, int] | None = None) -> Select[MeasurementRow]:
    """The query of up to ``limit`` photographs, by one image of each: newest first, those after the mark ``before``."""
    query = select(_Row).where(*_stands_for(wanted.verdict))
    if wanted.heliostat is not None:
        query = query.where(_Row.heliostat_id == wanted.heliostat.id)
    if wanted.target is not None:
        query = query.where(_Row.target_id == wanted.target.id)
    if wanted.since is not None:
        query = query.where(_Row.moment >= wanted.since)
    if wanted.until is not None:
        query = query.where(_Row.moment < wanted.until)
    if before is not None:
        query = query.where(tuple_(_Row.moment, _Row.id) < before)
    return query.order_by(_Row.moment.desc(), _Row.id.desc()).limit(limit)


def list_shots(session: Session, wanted: Wanted, limit: int, before: int | None = None) -> list[Shot]:
    """Up to ``limit`` photographs, newest first, those that come after the one of the mark ``before``.

    Raises
    ------
    NotFoundError
        Where there is no such mark.
    """
    last = None if before is None else session.get(_Row, before)
    if before is not None and last is None:
        raise NotFoundError(f"before: there is no photograph of the mark {before}; begin at the first page")
    found = session.scalars(page_of_shots(wanted, limit, None if last is None else (last.moment, last.id))).all()
    known = select(HeliostatRow.id, HeliostatRow.name).where(HeliostatRow.id.in_({row.heliostat_id for row in found}))
    names = dict(session.execute(known).all())
    images = _images(session, found)
    return [
        Shot(names[row.heliostat_id], row.external_id or row.identifier, tuple(images[row.id]), row.id) for row in found
    ]


def _images(session: Session, found: Sequence[MeasurementRow]) -> dict[int, list[MeasurementRow]]:
    """All images of the photographs that these stand for, by the ids of those; accepted and preferred ones first."""
    images = {row.id: [row] for row in found}
    marks = {(row.heliostat_id, row.external_id): row.id for row in found if row.external_id is not None}
    named = _Row.heliostat_id.in_({of for of, _ in marks}) & _Row.external_id.in_({name for _, name in marks})
    for row in session.scalars(select(_Row).where(named)):
        mark = marks.get((row.heliostat_id, row.external_id or ""))
        if mark is not None and row.id != mark:
            images[mark].append(row)
    for rows in images.values():
        rows.sort(key=lambda row: (not row.accepted, PREFERENCE.index(row.kind)))
    return images
