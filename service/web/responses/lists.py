"""Lists: their pages with filter and sort parameters, and tables as CSV for spreadsheets."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Annotated, Any, Generic, Literal, TypeVar

from fastapi import Query, Response
from pydantic import BaseModel, Field

from model.times import format_time
from service.base.fields import Model, Moment, Version
from service.drawing.templates import Quantity
from service.store.listing import Order, Period, Portion
from service.web.auth.dependencies import Limit

Item = TypeVar("Item")

Since = Annotated[
    Moment | None, Query(description="Only those from this time on (time with zone).")
]
Until = Annotated[Moment | None, Query(description="Only those before this time (time with zone).")]
AfterId = Annotated[Version | None, Query(description="The last id of the page before.")]
Direction = Literal["up", "down"]
"""Sort direction: "up" begins with the smallest or oldest item, "down" with the largest."""
OrderQuery = Annotated[
    Direction, Query(description="up: the oldest, or smallest, first; down: the other way round.")
]


class ListQuery(Model, extra="ignore"):
    """Which items of a list are shown, by when they were created, and in which order.

    Unknown parameters are those of pages; `require_known_query` refuses them in REST.
    """

    limit: Limit = 100
    after: AfterId = None
    since: Since = None
    until: Until = None
    order: OrderQuery = "up"

    @property
    def portion(self) -> Portion:
        """The rows of a page, and one more if there is another page."""
        created, order = Period(self.since, self.until), Order(descending=self.order == "down")
        return Portion(self.limit + 1, self.after, created, order)


class Page(BaseModel, Generic[Item]):
    """A part of a list."""

    items: list[Item] = Field(description="The entries of this page, in the list's order.")
    next: str | None = Field(description="Pass as `after` for the next page; null on the last.")


def page(items: Sequence[Item], limit: int, mark: str = "id") -> Page[Item]:
    """Build a page of ``limit`` items from up to ``limit`` + 1.

    The next page begins after the ``mark`` of the last item.
    """
    shown = list(items[:limit])
    return Page(items=shown, next=str(getattr(shown[-1], mark)) if len(items) > limit else None)


CSV = "text/csv"

# Characters that begin a formula in spreadsheets. Senders choose names and reasons freely.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def cell(value: Any) -> Any:
    """Convert a value to a cell: numbers stay numbers, and text never becomes a formula.

    A list is of names, which are separated by spaces.
    """
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return value
    if isinstance(value, list):
        value = " ".join(value)
    text = format_time(value) if isinstance(value, datetime) else str(value)
    return f"'{text}" if text.startswith(_FORMULA) else text


def sheet(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV text with the line of ``columns`` first."""
    buffer = io.StringIO()
    writer = csv.writer(buffer)
    writer.writerow([cell(name) for name in columns])
    writer.writerows([cell(value) for value in row] for row in rows)
    return buffer.getvalue()


def sheet_answer(name: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Response:
    """Response with a CSV file; ``name`` is without the suffix."""
    headers = {
        "Content-Disposition": f'attachment; filename="{name}.csv"',
        "Cache-Control": "private, no-cache",
    }
    return Response(sheet(columns, rows), media_type=f"{CSV}; charset=utf-8", headers=headers)


@dataclass(frozen=True)
class Column:
    """A column of a `PageTable`. The page shows its ``label``, in cells of the class ``style``.

    A column of controls or pictures ``is_page_only``: it is not in the CSV.
    """

    label: str
    style: str
    is_page_only: bool
    is_first: bool
    is_hidden: bool = False


@dataclass
class PageTable:
    """Table of a page: its columns, and the value of each cell, by heading.

    A value is a text, a number, a time, or a list of them. The template adds the cells
    (``table.html``); page and CSV show the same values.
    """

    columns: dict[str, Column] = field(default_factory=dict)
    rows: list[dict[str, object]] = field(default_factory=list)
    shown: frozenset[str] = frozenset()
    """Headings of the columns that the page shows besides the first; all if there are none."""

    def add(
        self, heading: str, value: object, label: str, style: str | None, is_page_only: bool
    ) -> Column:
        """Add a cell to the last row, and return its column. Numbers have a style by default."""
        is_first = not self.rows[-1]
        if style is None:
            style = "number" if isinstance(value, Quantity | int) and not is_first else ""
        self.rows[-1][heading] = value
        is_hidden = bool(self.shown) and heading not in self.shown and not is_first
        column = Column(label or heading, style, is_page_only, is_first, is_hidden)
        self.columns.setdefault(heading, column)
        return column

    def csv(self) -> str:
        """CSV text.

        A unit that all numbers of a column share is in its heading. Otherwise, a unit that all
        numbers of a row share is in the first cell of the row.
        """
        headings = [name for name, column in self.columns.items() if not column.is_page_only]
        units = {name: _units([row[name] for row in self.rows]) for name in headings}
        mixed = [name for name in headings if len(units[name]) > 1]
        rows = []
        for row in self.rows:
            of_row = _units([row[name] for name in mixed])
            first, *others = (_plain(row[name]) for name in headings)
            rows.append([_with_unit(str(first), of_row) if of_row else first, *others])
        return sheet([_with_unit(name, units[name]) for name in headings], rows)


def _units(cells: Sequence[object]) -> set[str]:
    return {cell.unit for cell in cells if isinstance(cell, Quantity)}


def _with_unit(name: str, units: set[str]) -> str:
    """Append the unit if there is only one, and the name has none yet."""
    unit = next(iter(units)) if len(units) == 1 else ""
    return f"{name} [{unit}]" if unit and "[" not in name else name


def _plain(value: Any) -> Any:
    """Value of a cell for CSV: a number with all digits, or text."""
    match value:
        case list():
            return " ".join("".join(map(_text, value)).split())
        case Quantity():
            return value.value
        case datetime():
            return format_time(value) if value.year > 1970 else ""
        case str():
            return "" if value == "–" else " ".join(value.split())
    return value


def _text(value: Any) -> str:
    """Text of a part of a cell. A number has its unit."""
    match value:
        case Quantity() if value.value is not None:
            return f"{value.value:g} {value.unit}".rstrip()
        case str():
            return value
    return str(_plain(value))
