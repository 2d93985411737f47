"""A plant that another program's file describes: its files, and its mirrors as designs.

Designs are those of plant.yaml: canted, focused, or each facet by itself.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.site import Origin, Site
from service.sources.folder import MeasuredSurface
from service.sources.plant_schema import HeliostatEntry
from service.sources.text_lines import ForeignLine

Array = NDArray[np.float64]

FACET_COLUMNS = ("x_m", "y_m", "z_m", "width_m", "height_m")
NORMAL_COLUMNS = ("normal_x", "normal_y", "normal_z")
FOCUS_COLUMN = "focal_length_m"
MAX_FOCUS = 1e5
"""Focal length [m] beyond which a facet is flat."""


class Tolerance(NamedTuple):
    """Differences of slopes, and relative ones of powers, within which facets are as designed."""

    slope: float = 2e-6
    power: float = 1e-3


@dataclass(frozen=True, eq=False)
class FacetedMirror:
    """A mirror in our mirror coordinates.

    Attributes
    ----------
    centers : (F, 3) [m]
    sides : (F, 2, 3) [m]
        Half width and half height as vectors.
    powers : (F,) [1/m]
        One over the focal lengths of the paraboloids that the facets are; 0 if they are flat.
    """

    centers: Array
    sides: Array
    powers: Array

    @property
    def normals(self) -> Array:
        """Unit normals (F, 3)."""
        return facet_axes(self.sides)[:, 2]

    @property
    def turned(self) -> float:
        """The largest angle [rad] of a facet's side x in the mirror's plane."""
        sides = self.sides[:, 0]
        return float(np.abs(np.arctan2(sides[:, 1], sides[:, 0])).max())


def facet_axes(sides: Array) -> Array:
    """Axes (F, 3 axes, 3) of facets with half sides (F, 2, 3)."""
    x = sides[:, 0] / np.linalg.norm(sides[:, 0], axis=-1, keepdims=True)
    z = np.cross(sides[:, 0], sides[:, 1])
    z = z / np.maximum(np.linalg.norm(z, axis=-1, keepdims=True), 1e-300)
    return np.stack([x, np.cross(z, x), z], axis=1)


class MirrorDesign(NamedTuple):
    """The mirror of a type: lines of its facets' file, and focus and canting as of plant.yaml.

    ``focus`` is a focal length [m], ``flat`` or ``slant_range``.
    """

    lines: tuple[tuple[str, ...], ...]
    focus: float | str
    canting: str

    @property
    def entries(self) -> dict[str, object]:
        """``facet_shape`` and ``canting`` of plant.yaml."""
        is_word = isinstance(self.focus, str)
        shape = self.focus if is_word else {"focal_length_m": self.focus}
        return {"facet_shape": shape, "canting": self.canting}


class PlacedDesign(NamedTuple):
    """A design, and the heliostat's focal length [m] if it needs one."""

    design: MirrorDesign
    focal_length: float | None


def design_of(mirror: FacetedMirror, same: Tolerance = Tolerance()) -> PlacedDesign:
    """The simplest design of a mirror; heliostats that differ in their focal length share one."""
    powers = mirror.powers
    focus, canted = float(powers.mean()), _canting_power(mirror, same)
    if canted is None or np.ptp(powers) > same.power * max(focus, 1e-3):
        return PlacedDesign(_individual(mirror), None)
    canting = "on_axis" if canted else "flat"
    if focus == 0:
        shape: float | str = "flat"
    elif canted == 0 or abs(canted / focus - 1) < same.power:
        shape = "slant_range"
    else:
        shape = _rounded(1 / focus)
    length = canted or focus
    design = MirrorDesign(_lines(mirror, FACET_COLUMNS), shape, canting)
    return PlacedDesign(design, _rounded(1 / length) if length else None)


def _canting_power(mirror: FacetedMirror, same: Tolerance) -> float | None:
    """One over the focal length [m] of on-axis canting; 0 for none, None for another canting."""
    normals, (x, y, z) = mirror.normals, mirror.centers.T
    slopes = np.hypot(normals[:, 0], normals[:, 1]) / normals[:, 2]
    if slopes.max() < same.slope:
        return 0.0
    outer = int(np.hypot(x, y).argmax())
    reach = float(np.hypot(x, y)[outer])
    focus = z[outer] + reach / np.tan(2 * np.arctan(slopes[outer])) if slopes[outer] else np.inf
    if not 0.01 < focus < MAX_FOCUS:
        return None
    ways = np.array([0.0, 0.0, focus]) - mirror.centers
    halves = ways / np.linalg.norm(ways, axis=1, keepdims=True) + [0.0, 0.0, 1.0]
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    return float(1 / focus) if np.abs(halves - normals).max() < same.slope else None


def _individual(mirror: FacetedMirror) -> MirrorDesign:
    focus = (FOCUS_COLUMN,) if mirror.powers.any() else ()
    columns = (*FACET_COLUMNS, *NORMAL_COLUMNS, *focus)
    return MirrorDesign(_lines(mirror, columns), "flat", "individual")


def _lines(mirror: FacetedMirror, columns: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Lines of a facets' file, its column names first; to a micrometre."""
    sizes = 2 * np.linalg.norm(mirror.sides, axis=-1)
    numbers = np.concatenate([mirror.centers, sizes], axis=1)
    lines = [[f"{round(value, 6) + 0.0:.9g}" for value in row] for row in numbers]
    for line, normal, power in zip(lines, mirror.normals, mirror.powers, strict=True):
        if NORMAL_COLUMNS[0] in columns:
            line += [f"{value:.9g}" for value in normal]
        if FOCUS_COLUMN in columns:
            line.append(f"{_rounded(1 / power)}" if power else "")
    return (columns, *map(tuple, lines))


def _rounded(length: float) -> float:
    return float(f"{length:.9g}")


PLANT, LAYOUT, AIMS = "plant.yaml", "layout.csv", "aims.csv"


@dataclass(frozen=True, eq=False)
class ImportedPlant:
    """What a file of another program describes.

    Attributes
    ----------
    parts : mapping
        Of plant.yaml, without its layout.
    heliostats : sequence of HeliostatEntry
    aims : dict
        Aim points (3,) [m] by heliostat; empty if the file has none.
    notes : sequence of str
        What the file does not say, and what is written in its place.
    facets : dict
        Lines of facets' files by their name, the column names first.
    surfaces : dict
        Measured surfaces by heliostat.
    """

    parts: Mapping[str, object]
    heliostats: Sequence[HeliostatEntry]
    aims: Mapping[str, Array] = field(default_factory=dict)
    notes: Sequence[str] = ()
    facets: Mapping[str, Sequence[Sequence[str]]] = field(default_factory=dict)
    surfaces: Mapping[str, MeasuredSurface] = field(default_factory=dict)

    def write(self, folder: Path) -> list[Path]:
        """Write plant.yaml, layout.csv and what else there is; return the paths.

        Raises
        ------
        InvalidInputError
            If one of them exists.
        """
        writers: dict[str, Callable[[Path], None]] = {
            PLANT: lambda path: _write_text(path, self._plant()),
            LAYOUT: lambda path: _write_csv(path, *self._layout()),
        }
        if self.aims:
            writers[AIMS] = lambda path: _write_csv(path, *self._aims())
        for name, (head, *rows) in self.facets.items():
            writers[name] = partial(_write_csv, columns=head, rows=rows)
        for name, surface in self.surfaces.items():
            writers[f"{name}/Deflectometry/{name}-nurbs-surface.npz"] = surface.write
        paths = [folder / name for name in writers]
        for path in paths:
            if path.exists() or path.is_symlink():
                raise InvalidInputError(f"{path} exists; name another folder, or move it")
        for path, write in zip(paths, writers.values(), strict=True):
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)
        return paths

    def _aims(self) -> "_Table":
        rows = [[name, *_millimetres(aim), "true"] for name, aim in self.aims.items()]
        return _Table(["name", "east_m", "north_m", "up_m", "active"], rows)

    def _plant(self) -> str:
        notes = "".join(f"# {note}\n" for note in self.notes)
        parts = {**self.parts, "layout": {"file": LAYOUT}}
        return notes + plant_text(parts)

    def _layout(self) -> "_Table":
        optional = [
            name
            for name in ("receiver", "focal_length_m")
            if any(getattr(entry, name) is not None for entry in self.heliostats)
        ]
        columns = ["name", "type", "east_m", "north_m", "up_m", *optional]
        rows = [[_cell(getattr(entry, name)) for name in columns] for entry in self.heliostats]
        return _Table(columns, rows)


class _PlainDumper(yaml.SafeDumper):
    """Repeats what occurs twice: plant.yaml has no anchors."""

    def ignore_aliases(self, data: object) -> bool:
        return True


class _Table(NamedTuple):
    columns: list[str]
    rows: list[list[str]]


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _millimetres(point: Array) -> list[str]:
    return [f"{value:.6f}" for value in point]


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])


def plant_text(parts: Mapping[str, object]) -> str:
    """plant.yaml of its parts."""
    return yaml.dump(
        parts,
        Dumper=_PlainDumper,
        sort_keys=False,
        width=100,
        default_flow_style=None,
        allow_unicode=True,
    )


def placed(
    name: str, kind: str, foot: Sequence[float], focal_length: float | None = None
) -> HeliostatEntry:
    """A heliostat of the layout with its pylon's ``foot`` (3,) [m]."""
    return HeliostatEntry.model_construct(
        name=name,
        type=kind,
        east_m=float(foot[0]),
        north_m=float(foot[1]),
        up_m=float(foot[2]),
        receiver=None,
        focal_length_m=focal_length,
    )


def site(name: str, origin: Origin, time_zone: str) -> dict[str, object]:
    """The part ``plant`` of plant.yaml."""
    keys = [entry.name for entry in fields(Site)]
    return {"name": name, **dict(zip(keys, origin, strict=True)), "time_zone": time_zone}


def plant_name(stem: str, otherwise: str) -> str:
    """A plant's name of a file's."""
    text = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in stem)[:32]
    return text.lstrip("-_") or otherwise


def facing(
    places: Sequence[tuple[float, float]], center: Sequence[float] = (0.0, 0.0)
) -> list[int]:
    """The normal (3,) of an upright plane at ``center`` [m] that faces a field, north or south if
    the field does not say it: along or between east and north.
    """
    east, north = np.mean(np.array(places) - np.array(center[:2]), axis=0)
    if np.hypot(east, north) < 1.0:
        return [0, 1, 0]
    step = np.round(np.arctan2(east, north) / (np.pi / 4)) * (np.pi / 4)
    return [int(np.round(np.sin(step))), int(np.round(np.cos(step))), 0]


def require_unique(lines: Sequence[ForeignLine], column: int) -> None:
    """Refuse a name that occurs twice in a column; names the second line."""
    seen: dict[str, str] = {}
    for line in lines:
        name = line.cells[column] if column < len(line.cells) else ""
        if name in seen:
            raise line.refuse(f"name {name[:60]!r} is that of {seen[name]}; rename one of them")
        seen[name] = line.place.rpartition(", ")[2]
