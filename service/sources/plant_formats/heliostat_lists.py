"""Lists of heliostats as CSV: those of OpenCSP, and positions, as layouts are often published.

OpenCSP lists heliostats such as those of Sandia's National Solar Thermal Test Facility. Columns:
Name, X, Y, Z of the torque tube's middle [m], numbers of facets, rows and columns, pivot height,
pivot offset, facet width and height [m].

Columns of positions are in any order: east and north, optionally up, a name or number, and a type.
Without column names they are east and north, or east, north and up.

Source: Sandia National Laboratories, OpenCSP, ``NSTTF_Heliostats_origin_at_torque_tube.csv``.
"""

import re
from pathlib import Path

from model.errors import InvalidInputError
from service.base.validation import NAME, require_name
from service.sources.plant_formats.imported import (
    ImportedPlant,
    facing,
    placed,
    require_unique,
    site,
)
from service.sources.plant_formats.solarpilot import REFLECTANCE, default_plant, require_no_count
from service.sources.plant_schema import MAX_HELIOSTATS, HeliostatEntry
from service.sources.text_lines import ForeignLine, read_csv

COLUMNS = (
    "Name",
    "X",
    "Y",
    "Z",
    "Num. Facets",
    "Num. Rows",
    "Num. Cols",
    "Pivot Height",
    "Pivot Offset",
    "Facet Width",
    "Facet Height",
)

# From the middles of facets in the same project's facet file: 1.27 m less 1.2192 m.
_GAP_M = 0.0508


def read_opencsp(path: Path) -> ImportedPlant:
    """Read a list of heliostats; those with equal mirrors and mounts are one type.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    lines = read_csv(path, MAX_HELIOSTATS)
    if not lines or list(lines[0].cells) != list(COLUMNS):
        raise InvalidInputError(f"{path}, line 1: must be {','.join(COLUMNS)}")
    kinds: dict[tuple[float, ...], str] = {}
    require_unique(lines[1:], 0)
    heliostats: list[HeliostatEntry] = []
    for line in lines[1:]:
        name = line.cells[0]
        require_name(NAME, name, f"{line.place}: Name")
        mirror = tuple(line.numbers(4, 7))
        _require_grid(line)
        kind = kinds.setdefault(mirror, f"type-{len(kinds) + 1}")
        east, north, up = line.numbers(1, 3)
        heliostats.append(placed(name, kind, (east, north, up - mirror[3])))
    return ImportedPlant(
        parts={
            "plant": site("nsttf", (34.962, -106.509, 1649.0), "America/Denver"),
            "heliostat_types": {name: _type(mirror) for mirror, name in kinds.items()},
            "receivers": {
                "main": {
                    "kind": "plane",
                    "center_m": [0, 0, 60],
                    "normal": facing([(h.east_m, h.north_m) for h in heliostats]),
                    "width_m": 6.0,
                    "height_m": 6.0,
                }
            },
        },
        heliostats=heliostats,
        notes=(
            "Assumed, for the file has positions, mounts and mirrors only; change it to yours:",
            "plant: the National Solar Thermal Test Facility; positions as in the file.",
            "heliostat_types: flat facets, canted to the slant range; reflectance 1, no errors.",
            f"facets: gaps of {_GAP_M:g} m, as between the inner columns of the NSTTF's mirrors.",
            "layout: feet are one pivot height below the torque tube.",
            "receivers: a plane 60 m up that faces the field.",
        ),
    )


def _require_grid(line: ForeignLine) -> None:
    count, rows, columns = (line.number(index, 1, 256) for index in (4, 5, 6))
    if count != rows * columns or rows != int(rows) or columns != int(columns):
        raise line.refuse(f"{count:g} facets are not {rows:g} rows of {columns:g}")


def _type(mirror: tuple[float, ...]) -> dict[str, object]:
    _, rows, columns, pivot, offset, width, height = mirror
    return {
        "mount": {"kind": "azimuth_elevation", "pivot_height_m": pivot, "mirror_offset_m": offset},
        "facets": {
            "rows": int(rows),
            "columns": int(columns),
            "width_m": width,
            "height_m": height,
            "gap_m": _GAP_M,
        },
        "canting": "on_axis",
    }


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
