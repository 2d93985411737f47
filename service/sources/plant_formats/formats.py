"""Formats of other programs: which one a file has, and how a plant is written in one."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.frames import sun_direction
from service.sources.files import file_name
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.artist import read_artist
from service.sources.plant_formats.artist_export import write_artist
from service.sources.plant_formats.heliostat_lists import (
    COLUMNS,
    has_positions,
    read_opencsp,
    read_positions,
)
from service.sources.plant_formats.imported import ImportedPlant
from service.sources.plant_formats.solarpilot import read_solarpilot, solarpilot_layout
from service.sources.plant_formats.soltrace import is_soltrace, read_soltrace
from service.sources.plant_formats.soltrace_export import soltrace_text
from service.sources.text_lines import read_csv

Array = NDArray[np.float64]


def read_foreign(path: Path, parameters_are_positions: bool = False) -> ImportedPlant:
    """Read a file of SolTrace (``.stinput``, or by its first line), ARTIST (``.h5``), or a CSV by
    its first line: OpenCSP, SolarPILOT, or positions.

    ``parameters_are_positions`` says how ARTIST's splines are read, as of `model.surface.heights`.

    Raises
    ------
    InvalidInputError
        It names file and line of what is not understood.
    """
    if path.suffix.lower() == ".stinput" or is_soltrace(path):
        return read_soltrace(path)
    if path.suffix.lower() in (".h5", ".hdf5"):
        return read_artist(path, parameters_are_positions)
    lines = read_csv(path)
    if not lines:
        raise InvalidInputError(f"{path}: is empty")
    if list(lines[0].cells[:5]) == list(COLUMNS[:5]):
        return read_opencsp(path)
    return read_positions(path) if has_positions(lines[0]) else read_solarpilot(path)


def import_plant(
    path: Path, out: Path, parameters_are_positions: bool = False
) -> tuple[ImportedPlant, list[Path]]:
    """Read a file of another program, write its plant into the folder ``out``, and return the
    paths.

    Raises
    ------
    InvalidInputError
        As of `read_foreign`; or if it makes no plant, or a file exists. Nothing is written then.
    """
    imported = read_foreign(path, parameters_are_positions)
    with TemporaryDirectory() as name:
        trial = Path(name)
        try:
            read_plant(imported.write(trial)[0])
        except InvalidInputError as error:
            problem = str(error).replace(f"{trial}/", "")
            raise InvalidInputError(f"{file_name(path)}: makes no plant: {problem}") from None
    return imported, imported.write(out)


@dataclass(frozen=True)
class ExportOptions:
    """What some formats need, and others do not have.

    Attributes
    ----------
    sun_deg : tuple or None
        Azimuth from north over east and elevation [deg], for SolTrace.
    aims : mapping or None
        Aim points (3,) [m] by heliostat, None for one that is not active; for SolTrace and
        SolarPILOT.
    surfaces : Path or None
        Folder of measured surfaces, for ARTIST.
    """

    sun_deg: tuple[float, float] | None = None
    aims: Mapping[str, Array | None] | None = None
    surfaces: Path | None = None


def write_foreign(
    described: PlantDescription, to: str, out: Path, options: ExportOptions
) -> list[str]:
    """Write a plant for ``artist``, ``solarpilot`` or ``soltrace``; return notes.

    Raises
    ------
    InvalidInputError
        As of `foreign_text`; or an option is given that the format does not have.
    """
    if to == "artist":
        for option, value in (("--sun", options.sun_deg), ("--aims", options.aims)):
            if value is not None:
                raise InvalidInputError(f"{option}: a scenario of ARTIST has none; leave it out")
        out.parent.mkdir(parents=True, exist_ok=True)
        return write_artist(described, out, options.surfaces)
    if options.surfaces is not None:
        raise InvalidInputError(f"--surfaces: {to} has no measured surfaces; leave it out")
    text = foreign_text(described, to, options.sun_deg, options.aims or {})
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    return []


def foreign_text(
    described: PlantDescription,
    to: str,
    sun_deg: tuple[float, float] | None,
    aims: Mapping[str, Array | None],
) -> str:
    """A plant as text for ``solarpilot`` or ``soltrace``.

    ``sun_deg`` is azimuth from north over east and elevation [deg]; SolTrace needs it. ``aims`` are
    points (3,) [m] by heliostat, None for one that is not active.

    Raises
    ------
    InvalidInputError
        If the format cannot say what the plant has, or the sun is missing or below the horizon.
    """
    points = {name: aim for name, aim in aims.items() if aim is not None}
    if len(points) < len(aims):
        raise InvalidInputError(
            f"{len(aims) - len(points)} heliostats are not active, which neither format can say;"
            " leave them out of the plant"
        )
    if to == "solarpilot":
        return solarpilot_layout(described, points)
    if sun_deg is None:
        raise InvalidInputError("SolTrace needs the sun; give --sun AZIMUTH ELEVATION")
    azimuth, elevation = sun_deg
    if not (-360 <= azimuth <= 360 and 0 < elevation <= 90):
        raise InvalidInputError(
            f"--sun {azimuth:g} {elevation:g}: elevation must lie in (0, 90], azimuth"
            " in [-360, 360]"
        )
    return soltrace_text(described, sun_direction(azimuth, elevation), points)
