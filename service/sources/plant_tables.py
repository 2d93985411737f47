"""CSV files of a plant: the layout of its heliostats, and the facets of a type."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.heliostat_type import FacetDesign, circle_outline
from model.plant import Outline, outline_share
from service.base.validation import NAME, require_name
from service.sources.files import file_name, read_text
from service.sources.plant_errors import Mistakes
from service.sources.plant_schema import MAX_FACETS, MAX_HELIOSTATS, HeliostatEntry, nearest
from service.sources.text_lines import ForeignLine, csv_lines, to_number

Array = NDArray[np.float64]

MAX_CSV_BYTES = 2**24
"""Largest CSV file of a plant [bytes]."""

MAX_CORNERS = 64
"""Most corners of a facet's polygon."""


@dataclass(frozen=True)
class CsvRow:
    """A line of a CSV file, for messages with its ``place``, by column."""

    place: str
    cells: Mapping[str, str]

    def wrong(self, column: str, problem: str) -> InvalidInputError:
        """The error of a cell."""
        return InvalidInputError(f"{self.place}: {column}: {problem}")

    def number(self, column: str, low: float = -1e6, high: float = 1e6) -> float:
        """The number of a cell, between ``low`` and ``high``."""
        text = self.cells[column]
        value = to_number(text)
        if not low <= value <= high:
            raise self.wrong(column, f"must be a number in [{low:g}, {high:g}], got {text[:60]!r}")
        return value

    def optional(self, column: str, low: float = -1e6, high: float = 1e6) -> float | None:
        """The number of a cell; None if it is empty, or there is no such column."""
        return self.number(column, low, high) if self.cells.get(column) else None


@dataclass(frozen=True)
class CsvColumns:
    """Columns of a kind of CSV file.

    Attributes
    ----------
    required, optional : sequence of str
    names : mapping
        Other names of columns, with the standard ones.
    together : sequence of sequences of str
        Optional columns that need each other.
    """

    required: Sequence[str]
    optional: Sequence[str] = ()
    names: Mapping[str, str] = field(default_factory=dict)
    together: Sequence[Sequence[str]] = ()

    @property
    def known(self) -> list[str]:
        """All names in order."""
        return [*self.required, *self.optional]


def read_rows(
    path: Path, columns: CsvColumns, most: int, mistakes: Mistakes | None = None
) -> list[CsvRow]:
    """Rows of a CSV file; raises what `parse_rows` raises."""
    return parse_rows(file_name(path), read_text(path, MAX_CSV_BYTES), columns, most, mistakes)


def parse_rows(
    name: str, text: str, columns: CsvColumns, most: int, mistakes: Mistakes | None = None
) -> list[CsvRow]:
    """Rows of the text of a CSV file with one line of column names; blank lines and those from
    ``#`` on are skipped.

    ``mistakes`` collects lines of other than one cell a column, if given.

    Raises
    ------
    InvalidInputError
        If it cannot be read, columns are missing, unknown or there twice, a line has other than one
        cell a column, or there are no rows or more than ``most``. It names file and line.
    """
    wrong = Mistakes() if mistakes is None else mistakes
    lines = csv_lines(name, text)
    head = next(lines, None)
    if head is None:
        raise InvalidInputError(f"{name}: is empty; its first line has the column names")
    standard = _standard_names(head, columns)
    rows: list[CsvRow] = []
    for line in lines:
        if len(line.cells) != len(standard):
            wrong.found.append(
                f"{line.place}: has {len(line.cells)} cells, {len(standard)} are the columns"
            )
            continue
        if len(rows) == most:
            raise line.refuse(f"at most {most} lines are read")
        rows.append(CsvRow(line.place, dict(zip(standard, line.cells, strict=True))))
    if mistakes is None:
        wrong.require_none()
    if not rows and not wrong.found:
        raise InvalidInputError(f"{name}: has no line below its column names")
    return rows


def _standard_names(head: ForeignLine, columns: CsvColumns) -> list[str]:
    given = head.cells
    standard = [columns.names.get(name, name) for name in given]
    for name, label in zip(standard, given, strict=True):
        if name not in columns.known:
            raise InvalidInputError(
                f"{head.place}: column {label[:60]!r} is not known; {nearest(label, columns.known)}"
            )
        if standard.count(name) > 1:
            raise InvalidInputError(f"{head.place}: column {name} is there twice; keep one")
    for name in columns.required:
        if name not in standard:
            raise InvalidInputError(f"{head.place}: column {name} is missing; add it")
    for group in columns.together:
        there = [name for name in group if name in standard]
        absent = [name for name in group if name not in standard]
        if there and absent:
            raise InvalidInputError(
                f"{head.place}: column {absent[0]} is missing beside {there[0]}; add it"
            )
    return standard


# --- layout
# --------------------------------------------------------------------------------------------------

_LAYOUT = CsvColumns(("name", "type", "east_m", "north_m", "up_m"), ("receiver", "focal_length_m"))


@dataclass(frozen=True)
class PlacedHeliostat:
    """A heliostat of the layout, and the ``place`` in the file that it comes from."""

    place: str
    entry: HeliostatEntry


def read_layout(path: Path, mistakes: Mistakes) -> list[PlacedHeliostat]:
    """Heliostats of a layout file, without those of wrong lines, which ``mistakes`` collects.

    Raises
    ------
    InvalidInputError
        As of `parse_rows`.
    """
    placed = []
    for row in read_rows(path, _LAYOUT, MAX_HELIOSTATS, mistakes):
        with mistakes.collected():
            placed.append(PlacedHeliostat(row.place, _heliostat(row)))
    return placed


def _heliostat(row: CsvRow) -> HeliostatEntry:
    require_name(NAME, row.cells["name"], f"{row.place}: name")
    return HeliostatEntry.model_construct(
        name=row.cells["name"],
        type=row.cells["type"],
        east_m=row.number("east_m"),
        north_m=row.number("north_m"),
        up_m=row.number("up_m"),
        receiver=row.cells.get("receiver") or None,
        focal_length_m=row.optional("focal_length_m", 0.01, 1e5),
    )


# --- facets
# --------------------------------------------------------------------------------------------------

_NORMAL = ("normal_x", "normal_y", "normal_z")
_CANTING = ("canting_x_mrad", "canting_y_mrad")
_FACETS = CsvColumns(
    ("x_m", "y_m", "z_m"),
    (*_NORMAL, *_CANTING, "width_m", "height_m", "polygon", "radius_m", "focal_length_m"),
    {name.removesuffix("_m"): name for name in ("x_m", "y_m", "z_m", "width_m", "height_m")}
    | {"radius": "radius_m", "focal_length": "focal_length_m"},
    (_NORMAL, _CANTING, ("width_m", "height_m")),
)


def read_facets(path: Path) -> Sequence[FacetDesign]:
    """Facets of a facets file; raises what `parse_facets` raises."""
    return parse_facets(file_name(path), read_text(path, MAX_CSV_BYTES))


def parse_facets(name: str, text: str) -> Sequence[FacetDesign]:
    """Facets of the text of a facets file.

    Each has a centre [m] in mirror coordinates (x to the right seen from the front, y up the
    mirror, z out of it), an optional normal or canting (slopes along x and y [mrad]), and width and
    height, a polygon about the centre, or a radius [m].

    Raises
    ------
    InvalidInputError
        It names file and line.
    """
    rows = parse_rows(name, text, _FACETS, MAX_FACETS)
    if _NORMAL[0] in rows[0].cells and _CANTING[0] in rows[0].cells:
        raise InvalidInputError(
            f"{name}, line 1: has normals and cantings; keep the columns of one"
        )
    facets, mistakes = [], Mistakes()
    for row in rows:
        with mistakes.collected():
            facets.append(_facet(row))
    mistakes.require_none()
    return tuple(facets)


def _facet(row: CsvRow) -> FacetDesign:
    center = np.array([row.number(name, -100, 100) for name in ("x_m", "y_m", "z_m")])
    shape = _shape(row)
    focal_length = row.optional("focal_length_m", 0.01, 1e5)
    return FacetDesign(center, shape.width, shape.height, shape.outline, _normal(row), focal_length)


def _normal(row: CsvRow) -> Array | None:
    """The unit normal (3,) of a facet; None if the file has none."""
    if _NORMAL[0] in row.cells:
        normal = np.array([row.number(name, -1e3, 1e3) for name in _NORMAL])
        if not normal[2] > 1e-3 * np.linalg.norm(normal):
            raise row.wrong("normal_z", "must be positive: z is out of the mirror")
    elif _CANTING[0] in row.cells:
        slopes = [1e-3 * row.number(name, -1000, 1000) for name in _CANTING]
        normal = np.array([-slopes[0], -slopes[1], 1.0])
    else:
        return None
    return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True)
class FacetShape:
    """Width and height [m] of a facet, and its outline as of `model.plant.Facet`."""

    width: float
    height: float
    outline: Outline | None = None


def _shape(row: CsvRow) -> FacetShape:
    """The shape of a facet: the rectangle of its sides, a polygon within it, or a circle."""
    polygon, radius = row.cells.get("polygon"), row.optional("radius_m", 0.005, 50)
    sides = [row.optional(name, 0.01, 100) for name in ("width_m", "height_m")]
    width, height = sides
    if polygon and radius is not None:
        raise row.wrong("radius_m", "is given beside a polygon; give one of them")
    if polygon:
        return _polygon(row, polygon)
    if radius is not None:
        if any(side is not None and abs(side - 2 * radius) > 1e-6 for side in sides):
            raise row.wrong("radius_m", "differs from half of width_m or height_m; leave those out")
        return FacetShape(2 * radius, 2 * radius, circle_outline())
    if width is None or height is None:
        raise InvalidInputError(
            f"{row.place}: a facet needs width_m and height_m, or polygon, or radius_m; give one of"
            " the three"
        )
    return FacetShape(width, height)


def _polygon(row: CsvRow, text: str) -> FacetShape:
    """The shape of a polygon ``x y; x y; ..`` [m] about the facet's centre."""
    corners = [corner.split() for corner in text.strip("; ").split(";")]
    is_read = all(
        len(corner) == 2 and np.isfinite([*map(to_number, corner)]).all() for corner in corners
    )
    if not is_read or not 3 <= len(corners) <= MAX_CORNERS:
        raise row.wrong(
            "polygon",
            f"must be 3 to {MAX_CORNERS} corners x y; x y; .. [m] about the facet's centre, got"
            f" {text[:60]!r}",
        )
    points = np.array(corners, dtype=np.float64)
    half = np.abs(points).max(axis=0)
    if not ((half > 0.005) & (half < 50)).all():
        raise row.wrong("polygon", "must reach 0.005 to 50 m from the facet's centre in x and y")
    half = _given_half_sides(row, half)
    outline = tuple((float(x), float(y)) for x, y in points / half)
    if outline_share(outline) < 1e-3 or _crosses_itself(points):
        raise row.wrong("polygon", "must have an area and not cross itself")
    return FacetShape(2 * float(half[0]), 2 * float(half[1]), outline)


def _given_half_sides(row: CsvRow, half: Array) -> Array:
    """Half width and half height (2,) [m] of a facet with a polygon that reaches ``half`` (2,)."""
    sides = [row.optional(name, 0.01, 100) for name in ("width_m", "height_m")]
    given = np.array([h if side is None else side / 2 for side, h in zip(sides, half, strict=True)])
    if (half > given * (1 + 1e-6)).any():
        raise row.wrong("polygon", "reaches beyond width_m and height_m; leave those out")
    return given


def _crosses_itself(points: Array) -> bool:
    """Whether two sides of a polygon (V, 2) that are not neighbours meet."""

    def side(a: Array, b: Array, c: Array) -> Array:
        return np.asarray((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0])

    begin, end = points, np.roll(points, -1, axis=0)
    a, b, c, d = begin[:, None], end[:, None], begin[None], end[None]
    meets = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    return bool(meets.any())


# --- aims
# --------------------------------------------------------------------------------------------------

AIM_COLUMNS = ("name", "east_m", "north_m", "up_m", "active")
DRIVE_COLUMNS = ("motor_1_steps", "motor_2_steps", "axis_1_deg", "axis_2_deg", "drive_reason")
"""Columns of an aims file that the service adds; they are not read."""
_AIMS = CsvColumns(AIM_COLUMNS[:4], (AIM_COLUMNS[4], *DRIVE_COLUMNS))
_YES, _NO = {"", "1", "true", "yes"}, {"0", "false", "no"}


def read_aims(path: Path, heliostats: Container[str]) -> dict[str, Array | None]:
    """Aim points (3,) [m] by heliostat of an aims file; None for those that are not active.

    ``heliostats`` are the names of the plant's. Raises `InvalidInputError`, which names file and
    line.
    """
    aims: dict[str, Array | None] = {}
    for row in read_rows(path, _AIMS, MAX_HELIOSTATS):
        name, active = row.cells["name"], row.cells.get("active", "").lower()
        if name not in heliostats:
            raise row.wrong("name", f"{name[:60]!r} is no heliostat of the plant")
        if name in aims:
            raise row.wrong("name", f"{name} is listed twice; keep one line")
        if active not in _YES | _NO:
            raise row.wrong("active", f"must be 1 or 0, got {active[:60]!r}")
        if active in _NO:
            aims[name] = None
        else:
            aims[name] = np.array([row.number(column) for column in ("east_m", "north_m", "up_m")])
    return aims
