"""SolarPILOT's layouts and results as CSV.

A layout has no column names: template, x, y, z, then optionally two focal lengths, a canting vector
and an aim point, ``NULL`` where SolarPILOT computes them. Results have column names.

Source: NREL, SolarPILOT, ``interop::UpdateMapLayoutData``; sample results of NREL/HALOS.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from service.sources.plant_file import PlantDescription
from service.sources.plant_formats.imported import ImportedPlant, placed, site
from service.sources.plant_formats.text import ForeignLine, read_lines
from service.sources.plant_schema import MAX_HELIOSTATS, HeliostatEntry

Array = NDArray[np.float64]

_POSITION = ("Pos-x", "Pos-y", "Pos-z")
_AIM = ("Aim-x", "Aim-y", "Aim-z")
_WIDTHS = (4, 6, 9, 12)
_NULL = "NULL"

# Of SolarPILOT's default case.
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
    lines = read_lines(path, ",", MAX_HELIOSTATS)
    if not lines:
        raise InvalidInputError(f"{path}: is empty")
    return _results(lines) if "Pos-x" in lines[0].cells else _layout(lines)


def _results(lines: Sequence[ForeignLine]) -> ImportedPlant:
    head = [cell.strip() for cell in lines[0].cells]
    for name in ("Heliostat ID", *_POSITION, *_AIM):
        if name not in head:
            raise lines[0].refuse(f"column {name} is missing")
    heliostats: list[HeliostatEntry] = []
    aims: dict[str, Array] = {}
    for line in lines[1:]:
        name = f"H{int(line.number(head.index('Heliostat ID'), 0, 1e9))}"
        heliostats.append(placed(name, "T0", line.numbers(head.index(_POSITION[0]), 3)))
        aims[name] = np.array(line.numbers(head.index(_AIM[0]), 3))
    return default_plant(heliostats, aims, {"T0"})


def _layout(lines: Sequence[ForeignLine]) -> ImportedPlant:
    heliostats: list[HeliostatEntry] = []
    aims: dict[str, Array] = {}
    for number, line in enumerate(lines, start=1):
        cells = [cell.strip() for cell in line.cells]
        if len(cells) not in _WIDTHS:
            raise line.refuse(
                f"has {len(cells)} cells; a layout has {', '.join(map(str, _WIDTHS))}: template,"
                " x, y, z, then focal lengths, canting vector and aim point"
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
    return default_plant(heliostats, aims, {entry.type for entry in heliostats})


def default_plant(
    heliostats: Sequence[HeliostatEntry], aims: Mapping[str, Array], kinds: set[str]
) -> ImportedPlant:
    """The plant of a layout, with SolarPILOT's default case for what it does not say.

    ``aims`` are points (3,) [m] by heliostat.
    """
    guess = _receiver(list(aims.values()))
    mirror = {
        "mount": {"kind": "azimuth_elevation"},
        "facets": {"rows": 1, "columns": 1, "width_m": _MIRROR_M, "height_m": _MIRROR_M},
        "facet_shape": "slant_range",
        "reflectance": 0.9,
        "slope_error_mrad": 1.53,
    }
    return ImportedPlant(
        parts={
            "plant": site("solarpilot", (34.867, -116.783, 586.0), "America/Los_Angeles"),
            "heliostat_types": {kind: dict(mirror) for kind in sorted(kinds)},
            "receivers": {"main": guess.entry},
        },
        heliostats=heliostats,
        aims=aims,
        notes=(
            "The layout has positions and aim points only. The rest is SolarPILOT's default case;"
            " change it to yours.",
            "plant: Daggett.",
            f"heliostat_types: one facet of {_MIRROR_M:g} x {_MIRROR_M:g} m, focused to its slant"
            " range.",
            f"receivers: {guess.source}",
        ),
    )


class _Guess(NamedTuple):
    """A receiver for plant.yaml, and where it comes from."""

    entry: dict[str, object]
    source: str


def _receiver(aims: Sequence[Array]) -> _Guess:
    """The receiver on which all aims are: a cylinder about the tower, or else a plane."""
    if not aims:
        return _Guess(_cylinder(_TOWER_M, _RECEIVER_RADIUS_M), "SolarPILOT's default cylinder.")
    points = np.array(aims)
    middle = points.mean(axis=0)
    radii = np.hypot(points[:, 0], points[:, 1])
    if np.ptp(radii) < 0.02 * radii.max() and radii.min() > _LEAST_RADIUS_M:
        height, radius = float(middle[2]), float(radii.mean())
        return _Guess(_cylinder(height, radius), "a cylinder through all aim points.")
    plane: dict[str, object] = {
        "kind": "plane",
        "center_m": [round(float(value), 3) for value in middle],
        "normal": [0, 1, 0],
        "width_m": _RECEIVER_HEIGHT_M,
        "height_m": _RECEIVER_HEIGHT_M,
    }
    return _Guess(plane, "a plane that faces north in the middle of all aim points.")


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
