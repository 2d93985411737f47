"""Lines of foreign text files, with their places for messages."""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import InvalidInputError
from service.base.names import is_text
from service.sources.files import file_name, read_text

MAX_BYTES = 2**26
"""Largest file of another program [bytes]."""


_NUMBER = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars", " ": "blanks"}


def to_number(text: str) -> float:
    """The decimal number of a text; NaN if it is none."""
    return float(text) if _NUMBER.fullmatch(text) else math.nan


@dataclass(frozen=True)
class ForeignLine:
    """A line in cells, and its ``place``: file and line."""

    place: str
    cells: Sequence[str]

    def number(self, index: int, low: float = -1e7, high: float = 1e7) -> float:
        """The number of a cell.

        Raises
        ------
        InvalidInputError
            If it is absent, no number, or not between ``low`` and ``high``.
        """
        text = self.cells[index].strip() if index < len(self.cells) else ""
        value = to_number(text)
        if not low <= value <= high:
            raise InvalidInputError(
                f"{self.place}: cell {index + 1} must be a number in [{low:g}, {high:g}], got"
                f" {text[:60]!r}"
            )
        return value

    def numbers(self, first: int, count: int) -> list[float]:
        """Numbers of adjacent cells."""
        return [self.number(index) for index in range(first, first + count)]

    @property
    def is_words(self) -> bool:
        """Whether the first cell is no number, as in a line of column names."""
        return math.isnan(to_number(self.cells[0]))

    def refuse(self, problem: str) -> InvalidInputError:
        """The error of something that is not understood."""
        return InvalidInputError(f"{self.place}: {problem}")


def split_lines(name: str, text: str, separator: str) -> list[ForeignLine]:
    """All lines of a text, split at ``separator``; blank ones at its end are not there."""
    return [
        ForeignLine(f"{name}, line {number}", line.split(separator))
        for number, line in enumerate(re.split("\r\n|\r|\n", text.rstrip()), start=1)
    ]


def csv_lines(name: str, text: str) -> Iterator[ForeignLine]:
    """Lines of the text of a CSV file with their cells stripped; lines without a cell and those
    from ``#`` on are skipped.

    Raises
    ------
    InvalidInputError
        If it is no CSV, a cell has a control character, or the first line is not separated by
        commas. It names the line.
    """
    reader = csv.reader(io.StringIO(text, newline=""))
    is_first = True
    try:
        for cells in reader:
            line = ForeignLine(f"{name}, line {reader.line_num}", [cell.strip() for cell in cells])
            if not any(line.cells) or line.cells[0].startswith("#"):
                continue
            if is_first and line.cells == ["sep=", ""]:  # a hint for Excel
                continue
            if is_first:
                require_commas(line)
            if not all(map(is_text, line.cells)):
                raise line.refuse("has a control character; remove it")
            is_first = False
            yield line
    except csv.Error as error:
        raise InvalidInputError(f"{name}: is no CSV ({error})") from None


def require_commas(line: ForeignLine) -> None:
    """Refuse a first line whose cells hold another separator; names it."""
    for separator, word in _SEPARATORS.items():
        is_blank = separator == " " and len(line.cells) > 1  # it is also within names
        if not is_blank and any(separator in cell for cell in line.cells):
            raise line.refuse(
                f"cells are separated by {word}; save the file with commas between them and points"
                " in numbers"
            )


def read_csv(path: Path, most: int | None = None) -> list[ForeignLine]:
    """Lines of a CSV file, as of `csv_lines`; empty cells at their ends are left out.

    ``most`` are read below the first.
    """
    lines = [
        ForeignLine(line.place, _without_empty_end(line.cells))
        for line in csv_lines(file_name(path), read_text(path, MAX_BYTES))
    ]
    if most is not None and len(lines) > most + 1:
        raise lines[-1].refuse(f"at most {most} heliostats are read")
    return lines


def _without_empty_end(cells: Sequence[str]) -> Sequence[str]:
    count = max(index for index, cell in enumerate(cells, start=1) if cell)
    return cells[:count]
