"""Foreign text files with places for messages: lines, CSV, and YAML with line numbers.

Of YAML only plain data are read, and only what has one meaning. Scalars are those of YAML 1.2:
``no`` is text, ``1e3`` a number, ``12:30`` text. Anchors, aliases, tags, merge keys and duplicate
keys are refused, so a document is never larger than its text.

Source: YAML 1.2.2, section 10.3, *Core Schema*, https://yaml.org/spec/1.2.2.
"""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from model.errors import InvalidInputError
from service.base.validation import is_text
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


MAX_YAML_BYTES = 2**22
"""Largest YAML document [bytes]: some ten thousand heliostats in line."""

MAX_DEPTH = 16
"""Deepest nesting; a plant has eight levels."""

KeyPath = tuple[str | int, ...]
"""Keys and indices from the document's root to a value."""

# libyaml is ten times faster than the same parser in Python, which is there without it.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)")
_WORDS = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
# Longer numbers are text; Python refuses to convert integers of thousands of digits.
_LONGEST_NUMBER = 40


@dataclass(frozen=True)
class YamlDocument:
    """A parsed document.

    Attributes
    ----------
    name : str
        Of its file, for messages.
    value : object
        Dictionaries, lists, text, numbers, truth values and None.
    lines : dict
        Line numbers by path, from 1; those of keys for the values of dictionaries.
    """

    name: str
    value: Any
    lines: dict[KeyPath, int]

    def place(self, path: KeyPath = ()) -> str:
        """File, line and key path of a value, as messages begin.

        For a value that is missing it is the line of what it is missing from.
        """
        known = path
        while known and known not in self.lines:
            known = known[:-1]
        keys = "".join(
            f"[{part}]" if isinstance(part, int) else f".{_shown(part)}" for part in path
        )
        where = f"{self.name}, line {self.lines.get(known, 1)}"
        return f"{where}: {keys.removeprefix('.')}" if path else where


def read_yaml(path: Path) -> YamlDocument:
    """Parse a YAML file.

    Raises
    ------
    InvalidInputError
        If it is missing, no regular file, too large, no UTF-8, no YAML, or has what is refused. It
        names file and line.
    """
    return parse_yaml(read_text(path, MAX_YAML_BYTES), file_name(path))


def parse_yaml(text: str, name: str) -> YamlDocument:
    """Parse the text of a YAML file of this ``name``; errors as of `read_yaml`."""
    for number, line in enumerate(text.split("\n"), start=1):
        if not is_text(line.rstrip("\r")):
            raise InvalidInputError(f"{name}, line {number}: has a control character; remove it")
    try:
        return _Composer(name, yaml.parse(text, Loader=_Loader)).document()
    except yaml.YAMLError as error:
        raise InvalidInputError(f"{name}, {_problem(error)}") from None


def _problem(error: yaml.YAMLError) -> str:
    """Line and problem of an error of the parser."""
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    problem = " ".join(str(getattr(error, "problem", None) or error).split())
    line = 1 if mark is None else mark.line + 1
    return f"line {line}: is no YAML: {problem[:200]}; check indentation, colons and brackets"


def _shown(key: str) -> str:
    """A key in one line of a message."""
    line = " ".join(key.split())
    return line if len(line) <= 60 else f"{line[:60]}.."


class _Composer:
    """Builds a document from the parser's events, with its depth bounded."""

    def __init__(self, name: str, events: Iterator[Any]) -> None:
        self.name = name
        self.events = events
        self.lines: dict[KeyPath, int] = {}

    def document(self) -> YamlDocument:
        """The one document of a stream."""
        next(self.events)  # the start of the stream
        if not isinstance(next(self.events), yaml.DocumentStartEvent):
            raise InvalidInputError(
                f"{self.name}: is empty; `heliotwin plant new` makes a template"
            )
        value = self._value(next(self.events), ())
        next(self.events)  # the end of the document
        after = next(self.events)
        if isinstance(after, yaml.DocumentStartEvent):
            raise self._refused(after, "begins a second document; keep one")
        return YamlDocument(self.name, value, self.lines)

    def _refused(self, event: Any, problem: str) -> InvalidInputError:
        return InvalidInputError(f"{self.name}, line {event.start_mark.line + 1}: {problem}")

    def _value(self, event: Any, path: KeyPath) -> Any:
        self.lines.setdefault(path, event.start_mark.line + 1)
        self._require_plain(event, path)
        if isinstance(event, yaml.ScalarEvent):
            return _scalar(event)
        if len(path) >= MAX_DEPTH:
            raise self._refused(event, f"is nested more than {MAX_DEPTH} levels deep")
        is_list = isinstance(event, yaml.SequenceStartEvent)
        return self._list(path) if is_list else self._dict(path)

    def _require_plain(self, event: Any, path: KeyPath) -> None:
        if isinstance(event, yaml.AliasEvent):
            raise self._refused(event, f"alias *{event.anchor} is not read; write the values again")
        if event.anchor is not None:
            raise self._refused(event, f"anchor &{event.anchor} is not read; leave it out")
        if event.tag is not None:
            raise self._refused(event, f"tag {event.tag[:60]} is not read; leave it out")

    def _list(self, path: KeyPath) -> list[Any]:
        values: list[Any] = []
        while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
            values.append(self._value(event, (*path, len(values))))
        return values

    def _dict(self, path: KeyPath) -> dict[str, object]:
        values: dict[str, object] = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            key = self._key(event, path)
            where = (*path, key)
            if key in values:
                raise self._refused(
                    event,
                    f"{_shown(key)} is there twice, first in line {self.lines[where]}; keep one",
                )
            self.lines[where] = event.start_mark.line + 1
            values[key] = self._value(next(self.events), where)
        return values

    def _key(self, event: Any, path: KeyPath) -> str:
        self._require_plain(event, path)
        if not isinstance(event, yaml.ScalarEvent):
            raise self._refused(event, "has a list or an object as a key; write a name")
        if event.value == "<<" and event.implicit[0]:
            raise self._refused(event, "merge key << is not read; write the values again")
        return str(event.value)


def _scalar(event: Any) -> Any:
    """The value of a scalar; quoted and long ones are text."""
    text: str = event.value
    if not event.implicit[0] or len(text) > _LONGEST_NUMBER:
        return text
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    return float(text) if _NUMBER.fullmatch(text) else text
