"""Positions of heliostats as CSV with column names, as layouts are often published.

Columns in any order: east and north, optionally up, a name or number, and a type.
"""

from pathlib import Path

from service.base.names import NAME, require_name
from service.sources.plant_formats.imported import ImportedPlant, placed
from service.sources.plant_formats.solarpilot import default_plant
from service.sources.plant_formats.text import ForeignLine, read_lines
from service.sources.plant_schema import MAX_HELIOSTATS, HeliostatEntry

NAMES = {
    "east": ("east_m", "east", "x"),
    "north": ("north_m", "north", "y"),
    "up": ("up_m", "up", "z"),
    "name": ("name", "id"),
    "type": ("type",),
}
"""What a column may be called, in small letters."""


def has_positions(first: ForeignLine) -> bool:
    """Whether the first line of a file names columns of positions."""
    return {"east", "north"} <= _columns(first).keys()


def read_positions(path: Path) -> ImportedPlant:
    """Read positions; the rest is assumed.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    first, *lines = read_lines(path, ",", MAX_HELIOSTATS)
    columns = _columns(first)
    unknown = [cell for index, cell in enumerate(first.cells) if index not in columns.values()]
    if unknown:
        raise first.refuse(
            f"column {unknown[0].strip()[:60]!r} is not understood; remove it, or name it one of"
            f" {', '.join(name for names in NAMES.values() for name in names)}"
        )
    heliostats = [_heliostat(number, line, columns) for number, line in enumerate(lines, start=1)]
    if not heliostats:
        raise first.refuse("no heliostat follows")
    return default_plant(heliostats, {}, {entry.type for entry in heliostats})


def _columns(first: ForeignLine) -> dict[str, int]:
    """Index of each known column."""
    cells = [cell.strip().lower() for cell in first.cells]
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
        cell = line.cells[index].strip()
        named = f"{prefix}{cell}" if cell.isdigit() else cell
        require_name(NAME, named, f"{line.place}: {key}")
        return named

    east, north = line.number(columns["east"]), line.number(columns["north"])
    up = line.number(columns["up"]) if "up" in columns else 0.0
    return placed(text("name", "H", f"H{number}"), text("type", "T", "T0"), (east, north, up))
