"""Positions of heliostats as CSV, as layouts are often published.

Columns in any order: east and north, optionally up, a name or number, and a type. Without column
names they are east and north, or east, north and up.
"""

import re
from pathlib import Path

from service.base.names import NAME, require_name
from service.sources.plant_formats.imported import ImportedPlant, placed, require_unique
from service.sources.plant_formats.solarpilot import REFLECTANCE, default_plant, require_no_count
from service.sources.plant_schema import MAX_HELIOSTATS, HeliostatEntry
from service.sources.text_lines import ForeignLine, read_csv

NAMES = {
    "east": ("east_m", "east", "x"),
    "north": ("north_m", "north", "y"),
    "up": ("up_m", "up", "z"),
    "name": ("name", "id"),
    "type": ("type", "template"),
}
"""What a column may be called, in small letters."""


_UNIT = re.compile(r"\s*[\[(]m[\])]$")


def has_positions(first: ForeignLine) -> bool:
    """Whether the first line of a file names columns of positions, or is a position."""
    is_position = len(first.cells) in (2, 3) and not first.is_words
    return is_position or {"east", "north"} <= _columns(first).keys()


def read_positions(path: Path) -> ImportedPlant:
    """Read positions; the rest is assumed.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    first, *lines = read_csv(path, MAX_HELIOSTATS)
    columns = _columns(first)
    if not first.is_words:
        columns = {key: index for index, key in enumerate(("east", "north", "up"))}
        lines = [first, *lines]
        require_no_count(lines, "id,x,y")
    for cell in first.cells:
        if first.is_words and first.cells.count(cell) > 1:
            raise first.refuse(f"column {cell[:60]!r} is there twice; keep one")
    unknown = [cell for index, cell in enumerate(first.cells) if index not in columns.values()]
    if unknown:
        raise first.refuse(
            f"column {unknown[0][:60]!r} is not understood; remove it, or name it one of"
            f" {', '.join(name for names in NAMES.values() for name in names)}"
        )
    if not lines:
        raise first.refuse("no heliostat follows")
    if "name" in columns:
        require_unique(lines, columns["name"])
    for line in lines:
        if len(line.cells) > len(first.cells):
            raise line.refuse(f"has {len(line.cells)} cells, {len(first.cells)} are the columns")
    if len(first.cells) == 2:
        columns.pop("up", None)
    heliostats = [_heliostat(number, line, columns) for number, line in enumerate(lines, start=1)]
    kinds = {entry.type: REFLECTANCE for entry in heliostats}
    return default_plant(path, heliostats, {}, kinds)


def _columns(first: ForeignLine) -> dict[str, int]:
    """Index of each known column; metres may be written after its name."""
    cells = [_UNIT.sub("", cell.lower()) for cell in first.cells]
    return {
        key: cells.index(name) for key, names in NAMES.items() for name in names if name in cells
    }


def _heliostat(number: int, line: ForeignLine, columns: dict[str, int]) -> HeliostatEntry:
    def text(key: str, prefix: str, default: str) -> str:
        index = columns.get(key)
        if index is None:
            return default
        if index >= len(line.cells):
            raise line.refuse(f"has no cell for {key}")
        cell = line.cells[index]
        named = f"{prefix}{cell}" if cell.isdigit() else cell
        require_name(NAME, named, f"{line.place}: {key}")
        return named

    east, north = line.number(columns["east"]), line.number(columns["north"])
    up = line.number(columns["up"]) if "up" in columns else 0.0
    return placed(text("name", "H", f"H{number}"), text("type", "T", "T0"), (east, north, up))
