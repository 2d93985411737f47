"""Pages of lists: filters by time, sort orders, and continuation after a row."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, Select, and_, or_, select
from sqlalchemy.orm import Session

from service.base.errors import NotFoundError

Row = TypeVar("Row")


@dataclass(frozen=True)
class Order:
    """Sort order of rows: by a column, then by id. Rows without a value come last.

    Ids increase as rows are stored, so ``id`` is the order of arrival.
    """

    by: str = "id"
    descending: bool = False


NEWEST_FIRST = Order(descending=True)


@dataclass(frozen=True)
class Period:
    """A time interval from ``since`` to before ``until``; None means unbounded.

    Rows without a time match only the unbounded interval.
    """

    since: datetime | None = None
    until: datetime | None = None

    def contains(self, at: datetime | None) -> bool:
        """Whether a time, or an unknown one, is in the interval."""
        if at is None:
            return self == EVER
        return not (
            (self.since is not None and at < self.since)
            or (self.until is not None and at >= self.until)
        )

    def conditions(self, column: Any) -> list[ColumnElement[bool]]:
        """Conditions that a column of times lies in the interval."""
        after = [] if self.since is None else [column >= self.since]
        before = [] if self.until is None else [column < self.until]
        return after + before


EVER = Period()


@dataclass(frozen=True)
class Portion:
    """Up to ``limit`` rows of a list after the row with id ``after``, of those of a period."""

    limit: int
    after: int | None = None
    created: Period = EVER
    order: Order = NEWEST_FIRST

    def of(self, session: Session, query: Select[Row], table: Any) -> Select[Row]:
        """Restrict a query of ``table``; raises what `select_after` raises."""
        query = query.where(*self.created.conditions(table.created_at)).limit(self.limit)
        return select_after(session, query, table, self.order, self.after)


def select_after(
    session: Session, query: Select[Row], table: Any, order: Order, after: int | None
) -> Select[Row]:
    """Sort the found rows of ``table``, and start after the row with id ``after``.

    Raises
    ------
    NotFoundError
        If the value of that row is needed and the row no longer exists.
    """
    column = getattr(table, order.by)
    if order.by == "id":
        query = query.order_by(_directed(table.id, order))
        return query if after is None else query.where(_is_beyond(table.id, after, order))
    query = query.order_by(column.is_(None), _directed(column, order), _directed(table.id, order))
    if after is None:
        return query
    last = session.execute(select(column).where(table.id == after)).one_or_none()
    if last is None:
        raise NotFoundError(
            "after: the last item of the page before is gone; begin again without it"
        )
    (value,) = last
    behind = _is_beyond(table.id, after, order)
    if value is None:
        return query.where(column.is_(None), behind)
    later = or_(_is_beyond(column, value, order), and_(column == value, behind))
    return query.where(or_(column.is_(None), later))


def _directed(column: Any, order: Order) -> Any:
    return column.desc() if order.descending else column.asc()


def _is_beyond(column: Any, value: Any, order: Order) -> ColumnElement[bool]:
    condition: ColumnElement[bool] = column < value if order.descending else column > value
    return condition
