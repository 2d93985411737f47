"""Tables as CSV, for spreadsheets: of rows, or of a page that shows them.

A page's table is read from the page itself, rendered with `FILTERS`: those leave numbers whole, and mark their units.
"""

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from html.parser import HTMLParser
from typing import Any

from fastapi import Response

from service.base.faults import NotFoundError

CSV = "text/csv"

# What a spreadsheet takes for the beginning of a formula; senders choose names and reasons.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def cell(value: Any) -> Any:
    """A value as a cell: numbers stay numbers, and text is never a formula."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return value
    text = value.isoformat() if isinstance(value, datetime) else str(value)
    return f"'{text}" if text.startswith(_FORMULA) else text


def sheet(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV with a line of ``columns`` first."""
    buffer = io.StringIO()
    writer = csv.writer(buffer)
    writer.writerow([cell(name) for name in columns])
    writer.writerows([cell(value) for value in row] for row in rows)
    return buffer.getvalue()


def sheet_answer(name: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Response:
    """A CSV file of this name, without its suffix."""
    headers = {"Content-Disposition": f'attachment; filename="{name}.csv"', "Cache-Control": "private, no-cache"}
    return Response(sheet(columns, rows), media_type=f"{CSV}; charset=utf-8", headers=headers)


# --- of a page --------------------------------------------------------------------------------------------------------

# A number that a filter wrote stands between the first and the last of these, its unit behind the second.
_BEGIN, _UNIT, _END = "\x01", "\x02", "\x03"
_WRITTEN = re.compile(rf"{_BEGIN}(-?(?:\d+(?:\.\d+)?(?:e[-+]?\d+)?|nan|inf)){_UNIT}([^{_END}]*){_END}")
_DEGREES = "°"
_NONE = "–"


def _number(value: float | None, unit: str) -> str:
    return _NONE if value is None else f"{_BEGIN}{float(value)!r}{_UNIT}{unit}{_END}"


FILTERS: dict[str, Callable[..., str]] = {
    "figure": lambda value, digits=2, unit="": _number(value, unit),
    "percent": lambda value, digits=1: _number(None if value is None else 100 * value, "%"),
    "power": lambda watts: _number(watts, "W"),
    "irradiance": lambda watts_m2: _number(watts_m2, "W/m²"),
    "storage": lambda size_bytes: _number(size_bytes, "B"),
}
"""Templates' filters of numbers (`service.drawing.templates`), as a table is rendered that shall be read."""


@dataclass(frozen=True)
class _Cell:
    """What stands in a cell, and the columns that it takes."""

    value: float | str
    unit: str = ""
    span: int = 1
    is_hidden: bool = False


def _read(text: str) -> tuple[float | str, str]:
    """What a cell says: a number with its unit where it is nothing else, or text."""
    text = " ".join(text.split())
    bare = text.removesuffix(_DEGREES)
    whole = _WRITTEN.fullmatch(bare)
    if whole is not None:
        return float(whole[1]), whole[2] or text[len(bare) :]
    if bare == _NONE:
        return "", ""
    return _WRITTEN.sub(lambda found: f"{float(found[1]):g}{' ' * bool(found[2])}{found[2]}", text), ""


@dataclass
class _Open:
    """A cell that is being read."""

    attributes: dict[str, str | None]
    texts: list[str] = field(default_factory=list)
    is_hidden: bool = False


class _Reader(HTMLParser):
    """The rows of the table of one id: what they say, without what they can be told to do."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name, self.found = name, False
        self.rows: list[list[_Cell]] = []
        self._inside, self._quiet = False, 0
        self._cell: _Open | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "table" and given.get("id") == self.name:
            self.found = self._inside = True
        elif not self._inside:
            return
        elif tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self._cell = _Open(given)
        elif tag in ("form", "button"):
            self._quiet += 1
        elif self._cell is not None:
            if tag == "time" and given.get("datetime"):
                self._cell.texts.append(str(given["datetime"]))
                self._quiet += 1
            elif tag in ("br", "small"):
                self._cell.texts.append(" ")
            elif given.get("class") == "hidden":
                self._cell.is_hidden = True

    def handle_endtag(self, tag: str) -> None:
        if not self._inside:
            return
        if tag == "table":
            self._inside = False
        elif tag in ("td", "th") and self._cell is not None:
            given, (value, unit) = self._cell.attributes, _read("".join(self._cell.texts))
            shown = given.get("abbr") or value
            self.rows[-1].append(_Cell(shown, unit, int(given.get("colspan") or 1), self._cell.is_hidden))
            self._cell = None
        elif tag in ("form", "button", "time") and self._quiet:
            self._quiet -= 1

    def handle_data(self, data: str) -> None:
        if self._cell is not None and not self._quiet:
            self._cell.texts.append(data)


def table_of(page: str, name: str) -> tuple[list[str], list[list[float | str]]]:
    """Columns and rows of the table of this id in a page that was rendered with `FILTERS`.

    A unit that all numbers of a column have stands in its name, one that is a row's in the row's.

    Raises
    ------
    NotFoundError
        Where the page has none of this id.
    """
    reader = _Reader(name)
    reader.feed(page)
    if not reader.found:
        raise NotFoundError(f"table: this page has no table {name!r} now")
    head, *lines = [[cell for one in row for cell in (one, *[_Cell("")] * (one.span - 1))] for row in reader.rows]
    # A column of buttons or pictures says nothing.
    told = [at for at, top in enumerate(head) if not top.is_hidden or any(line[at].value != "" for line in lines)]
    head, lines = [head[at] for at in told], [[line[at] for at in told] for line in lines]
    of_columns = [{line[at].unit for line in lines if isinstance(line[at].value, float)} for at in range(len(head))]
    columns = [
        f"{top.value} [{unit}]" if unit and "[" not in str(top.value) else str(top.value)
        for top, units in zip(head, of_columns, strict=True)
        for unit in [next(iter(units)) if len(units) == 1 else ""]
    ]
    mixed = {at for at, units in enumerate(of_columns) if len(units) > 1}
    return columns, [_values(line, mixed) for line in lines]


def _values(line: list[_Cell], mixed: set[int]) -> list[float | str]:
    """What a row says, its unit behind its name where its columns have several."""
    units = {line[at].unit for at in mixed if isinstance(line[at].value, float)}
    first = f"{line[0].value} [{units.pop()}]" if len(units) == 1 and units != {""} else line[0].value
    return [first, *(cell.value for cell in line[1:])]
