"""Lines of foreign text files, with their places for messages."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from model.errors import InvalidInputError
from service.sources.files import file_name, read_text
from service.sources.plant_tables import to_number

MAX_BYTES = 2**26
"""Largest file of another program [bytes]."""


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

    def refuse(self, problem: str) -> InvalidInputError:
        """The error of something that is not understood."""
        return InvalidInputError(f"{self.place}: {problem}")


def read_lines(path: Path, separator: str, most: int | None = None) -> list[ForeignLine]:
    """Lines of a file that are not blank, split at ``separator``; ``most`` are read below the
    first.
    """
    name = file_name(path)
    lines = [
        ForeignLine(f"{name}, line {number}", line.rstrip("\r").split(separator))
        for number, line in enumerate(read_text(path, MAX_BYTES).split("\n"), start=1)
        if line.strip()
    ]
    if most is not None and len(lines) > most + 1:
        raise lines[-1].refuse(f"at most {most} heliostats are read")
    return lines
