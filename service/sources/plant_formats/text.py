"""Lines of foreign text files, with their places for messages."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import InvalidInputError
from service.sources.files import read_file
from service.sources.yaml_text import file_name

MAX_BYTES = 2**26
"""Largest file of another program [bytes]."""

_NUMBER = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")


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
        value = float(text) if _NUMBER.fullmatch(text) else float("nan")
        if not low <= value <= high:
            raise InvalidInputError(
                f"{self.place}: cell {index + 1} must be a number in [{low:g}, {high:g}], got"
                f" {text[:60]!r}"
            )
        return value

    def numbers(self, first: int, count: int) -> list[float]:
        """Numbers of adjacent cells."""
        return [self.number(index) for index in range(first, first + count)]

    def refuse(self, problem: str) -> InvalidInputError:
        """The error of something that is not understood."""
        return InvalidInputError(f"{self.place}: {problem}")


def read_lines(path: Path, separator: str) -> list[ForeignLine]:
    """Lines of a file that are not blank, split at ``separator``."""
    data = read_file(path, MAX_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InvalidInputError(f"{file_name(path)}: is no text of UTF-8") from None
    return [
        ForeignLine(f"{file_name(path)}, line {number}", line.rstrip("\r").split(separator))
        for number, line in enumerate(text.split("\n"), start=1)
        if line.strip()
    ]
