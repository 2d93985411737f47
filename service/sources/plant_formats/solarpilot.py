"""SolarPILOT's layouts and results as CSV.

A layout has no column names: template, since 2018 whether it is enabled and in the layout, x, y, z,
then optionally two focal lengths, a canting vector and an aim point, ``NULL`` where SolarPILOT
computes them. The layout that its program exports has column names, a line of units below, and a
comma at the end of each line. Results have column names, below the sun if the program wrote them.

Source: NREL, SolarPILOT, ``interop::UpdateMapLayoutData`` and its help on field layouts; sample
results of NREL/HALOS.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from service.base.validation import counted
from service.sources.plant_file import PlantDescription
from service.sources.plant_formats.imported import (
    ImportedPlant,
    facing,
    placed,
    plant_name,
    require_unique,
    site,
)
from service.sources.plant_schema import MAX_HELIOSTATS, HeliostatEntry
from service.sources.text_lines import ForeignLine, read_csv, require_commas, to_number

Array = NDArray[np.float64]

_POSITION = ("Pos-x", "Pos-y", "Pos-z")
_AIM = ("Aim-x", "Aim-y", "Aim-z")
_OPTICS = ("Reflectivity", "Soiling")
_EXPORT, _FLAG = ("Loc. X", "Loc. Y", "Loc. Z"), "In layout"
_WIDTHS = (4, 6, 9, 12)
# Most lines above the columns of results: the program writes sun and DNI there.
_MOST_TITLES = 12
_NULL = "NULL"
_MAX_TYPES = 64
REFLECTANCE = 0.9
"""Of SolarPILOT's default case."""

# Of SolarPILOT's default case.
_DAGGETT = (34.867, -116.783, 586.0)
_MIRROR_M = 12.2
_TOWER_M = 195.0
_RECEIVER_RADIUS_M = 8.825
_RECEIVER_HEIGHT_M = 21.6

# Smallest radius [m] of a cylinder on which aim points are.
_LEAST_RADIUS_M = 0.5


def read_solarpilot(path: Path) -> ImportedPlant:
    """Read a layout, or results by heliostat.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    lines = read_csv(path, MAX_HELIOSTATS)
    if not lines:
        raise InvalidInputError(f"{path}: is empty")
    results = [n for n, line in enumerate(lines[:_MOST_TITLES]) if "Pos-x" in ",".join(line.cells)]
    if results:
        require_commas(lines[results[0]])
        return _results(path, lines[: results[0]], lines[results[0] :])
    if lines[0].cells[0] == "Template" and {*_EXPORT} <= {*lines[0].cells}:
        units = [line for line in lines[1:2] if "[m]" in line.cells]
        return _layout(path, lines[1 + len(units) :], _FLAG in lines[0].cells)
    if lines[0].is_words:
        raise lines[0].refuse(
            "columns are not understood; name them x,y or x,y,z for positions, with id and type"
            " if you like"
        )
    flags = {to_number(cell) for line in lines for cell in line.cells[1:3]}
    has_flags = len(lines[0].cells) in [width + 2 for width in _WIDTHS] and flags <= {0, 1}
    if not has_flags:
        require_no_count(lines, "id,x,y,z")
    return _layout(path, lines, has_flags)


def require_no_count(lines: Sequence[ForeignLine], names: str) -> None:
    """Refuse lines without column names whose first cell counts them, as an identifier does.

    Two lines of a layout may be of two templates.
    """
    start = int(lines[0].cells[0]) if lines[0].cells[0].isdecimal() else -1
    counted = [str(start + number) for number in range(len(lines))]
    if len(lines) > 1 + (len(lines[0].cells) > 3) and [line.cells[0] for line in lines] == counted:
        raise lines[0].refuse(
            f"the first cells count the lines; put the names of columns above, such as {names}"
        )


def _results(
    path: Path, titles: Sequence[ForeignLine], lines: Sequence[ForeignLine]
) -> ImportedPlant:
    head = list(lines[0].cells)
    for name in ("Heliostat ID", *_POSITION, *_AIM):
        if name not in head:
            raise lines[0].refuse(f"column {name} is missing")
    if len(lines) == 1:
        raise lines[0].refuse("no heliostat follows")
    require_unique(lines[1:], head.index("Heliostat ID"))
    heliostats: list[HeliostatEntry] = []
    aims: dict[str, Array] = {}
    types: dict[float, str] = {}
    assumed = 1.0 if _OPTICS[0] in head else REFLECTANCE
    for line in lines[1:]:
        name = f"H{int(line.number(head.index('Heliostat ID'), 0, 1e9))}"
        shares = [line.number(head.index(key), 0, 1) for key in _OPTICS if key in head]
        reflectance = round(math.prod(shares) * assumed, 6)
        kind = types.setdefault(reflectance, f"T{len(types)}")
        if len(types) > _MAX_TYPES:
            raise line.refuse(
                f"has the {_MAX_TYPES + 1}th reflectance; a plant has at most {_MAX_TYPES} types."
                " Round Reflectivity and Soiling"
            )
        heliostats.append(placed(name, kind, [line.number(head.index(key)) for key in _POSITION]))
        aims[name] = np.array([line.number(head.index(key)) for key in _AIM])
    known = [key for key in _OPTICS if key in head]
    left_out = [key for key in head if key not in ("Heliostat ID", *_POSITION, *_AIM, *known)]
    notes = []
    if known:
        factors = [*([f"{assumed:g}"] if assumed != 1 else []), *known]
        notes.append(f"reflectance: {' times '.join(factors)}, of the file.")
    if titles:
        above = "; ".join(" ".join(line.cells)[:60] for line in titles)
        notes.append(f"lines above the columns that are left out: {above}.")
    if left_out:
        notes.append(f"columns that are left out: {', '.join(key[:40] for key in left_out)}.")
    kinds = {kind: reflectance for reflectance, kind in types.items()}
    return default_plant(path, heliostats, aims, kinds, notes)


def _layout(path: Path, lines: Sequence[ForeignLine], has_flags: bool) -> ImportedPlant:
    heliostats: list[HeliostatEntry] = []
    aims: dict[str, Array] = {}
    n_off = 0
    for number, line in enumerate(lines, start=1):
        if has_flags:
            n_on = line.number(1, 0, 1) * line.number(2, 0, 1)
            line = ForeignLine(line.place, [line.cells[0], *line.cells[3:]])
            if n_on != 1:
                n_off += 1
                continue
        cells = [cell.upper() for cell in line.cells]
        if len(cells) not in _WIDTHS:
            raise line.refuse(
                f"has {len(cells) + 2 * has_flags} cells; a layout has"
                f" {', '.join(map(str, _WIDTHS))}: template, x, y, z, then focal lengths, canting"
                " vector and aim point; or two more, enabled and in layout, after the template"
            )
        if any(cell != _NULL for cell in cells[6:9]):
            raise line.refuse("has a canting vector, which is not read; write NULL,NULL,NULL")
        focal_length = None if cells[4:5] in ([], [_NULL]) else line.number(4, 0.01, 1e5)
        if focal_length is not None and abs(line.number(5) - focal_length) > 1e-6 * focal_length:
            raise line.refuse("has two focal lengths that differ, which is not read")
        kind = f"T{int(line.number(0, 0, 1e6))}"
        heliostats.append(placed(f"H{number}", kind, line.numbers(1, 3), focal_length))
        if len(cells) == 12 and cells[9] != _NULL:
            aims[f"H{number}"] = np.array(line.numbers(9, 3))
    if not heliostats:
        raise InvalidInputError(f"{path}: has no heliostat that is enabled and in the layout")
    off = f"left out, as not enabled or not in the layout: {counted(n_off, 'heliostat')}."
    kinds = {entry.type: REFLECTANCE for entry in heliostats}
    return default_plant(path, heliostats, aims, kinds, [off] if n_off else [])


def default_plant(
    path: Path,
    heliostats: Sequence[HeliostatEntry],
    aims: Mapping[str, Array],
    kinds: Mapping[str, float],
    notes: Sequence[str] = (),
) -> ImportedPlant:
    """The plant of a layout, with SolarPILOT's default case for what it does not say.

    ``aims`` are points (3,) [m] by heliostat, and ``kinds`` the reflectances of types by name.
    """
    guess = _receiver(heliostats, list(aims.values()))
    mirror = {
        "mount": {"kind": "azimuth_elevation"},
        "facets": {"rows": 1, "columns": 1, "width_m": _MIRROR_M, "height_m": _MIRROR_M},
        "facet_shape": "slant_range",
    }
    assumed = ", ".join(f"{value:g}" for value in sorted(set(kinds.values())))
    return ImportedPlant(
        parts={
            "plant": site(plant_name(path.stem, "plant"), _DAGGETT, "America/Los_Angeles"),
            "heliostat_types": {
                kind: {**mirror, "reflectance": kinds[kind], "slope_error_mrad": 1.53}
                for kind in sorted(kinds)
            },
            "receivers": {"main": guess.entry},
        },
        heliostats=heliostats,
        aims=aims,
        notes=(
            "Assumed, for the file does not say it (SolarPILOT's default case); change it to"
            " yours:",
            f"plant: the site is Daggett, {_DAGGETT[0]:g} N {-_DAGGETT[1]:g} W, {_DAGGETT[2]:g} m.",
            f"heliostat_types: one facet of {_MIRROR_M:g} x {_MIRROR_M:g} m, focused to its slant"
            f" range; reflectance {assumed}; slope error 1.53 mrad; pivot height 0 m, so a"
            " position's height is that of the mirror's middle.",
            f"receivers: {guess.source}",
            *notes,
        ),
    )


class _Guess(NamedTuple):
    """A receiver for plant.yaml, and where it comes from."""

    entry: dict[str, object]
    source: str


def _receiver(heliostats: Sequence[HeliostatEntry], aims: Sequence[Array]) -> _Guess:
    """The receiver on which all aims are: a cylinder about the tower, or else a plane that faces
    the field, if all heliostats are in front of it.
    """
    if not aims:
        return _Guess(
            _cylinder(_TOWER_M, _RECEIVER_RADIUS_M),
            f"a cylinder of {_RECEIVER_RADIUS_M:g} m radius, {_TOWER_M:g} m up.",
        )
    points = np.array(aims)
    middle = points.mean(axis=0)
    radii = np.hypot(points[:, 0], points[:, 1])
    if np.ptp(radii) < 0.02 * radii.max() and radii.min() > _LEAST_RADIUS_M:
        height, radius = float(middle[2]), float(radii.mean())
        return _Guess(_cylinder(height, radius), "a cylinder through all aim points.")
    places = [(entry.east_m, entry.north_m) for entry in heliostats]
    normal = facing(places, middle.tolist())
    behind = (np.array(places) - middle[:2]) @ normal[:2] <= 0
    if behind.any() and radii.max() < _RECEIVER_RADIUS_M:
        return _Guess(
            _cylinder(float(middle[2]), _RECEIVER_RADIUS_M),
            f"a cylinder of {_RECEIVER_RADIUS_M:g} m radius at the aim points' height, for"
            " heliostats are all around.",
        )
    plane: dict[str, object] = {
        "kind": "plane",
        "center_m": [round(float(value), 3) for value in middle],
        "normal": normal,
        "width_m": _RECEIVER_HEIGHT_M,
        "height_m": _RECEIVER_HEIGHT_M,
    }
    return _Guess(plane, "a plane that faces the field in the middle of all aim points.")


def _cylinder(height: float, radius: float) -> dict[str, object]:
    return {
        "kind": "cylinder",
        "center_m": [0, 0, round(height, 3)],
        "radius_m": round(radius, 3),
        "height_m": _RECEIVER_HEIGHT_M,
        "absorptance": 0.94,
    }


def solarpilot_layout(described: PlantDescription, aims: Mapping[str, Array]) -> str:
    """The layout of a plant for SolarPILOT's import, with aim points.

    Templates are the types in their order, from 0. Heliostats without one of ``aims`` aim at their
    receiver's middle.
    """
    template = {name: number for number, name in enumerate(described.types)}
    goals = {**described.receivers, **described.plant.targets}
    lines = []
    for name, heliostat in described.plant.heliostats.items():
        receiver = goals[described.receiver_of[name]]
        aim = aims.get(name, receiver.aim_of(heliostat.position))
        numbers = [template[described.type_of[name]], *(f"{x:.6f}" for x in heliostat.position)]
        cells = [*numbers, *[_NULL] * 5, *(f"{x:.6f}" for x in aim)]
        lines.append(",".join(map(str, cells)))
    return "\n".join(lines) + "\n"
