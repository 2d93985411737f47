"""A plant to begin with: a commented ``plant.yaml`` and its layout."""

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np

from model.errors import InvalidInputError

LAYOUT = "layout.csv"

_ROWS = 10
_FIRST_ROW = 60.0
_ROW_SPACING = 14.0
_SPACING = 15.0
_HALF_FIELD_DEG = 60.0


def template_text() -> str:
    """The template of ``plant.yaml``."""
    return files("service.sources").joinpath("templates/plant.yaml").read_text(encoding="utf-8")


def template_layout() -> str:
    """Heliostats north of the tower in staggered rows, as CSV."""
    radii = [_FIRST_ROW + row * _ROW_SPACING for row in range(_ROWS)]
    return staggered_layout("standard", radii, _SPACING, 0.0, _HALF_FIELD_DEG)


def staggered_layout(
    of_type: str, radii: Sequence[float], spacing: float, middle_deg: float, half_width_deg: float
) -> str:
    """Heliostats of one type in staggered rows about the tower, as CSV.

    Parameters
    ----------
    of_type : str
    radii : sequence of float [m]
        Of the rows.
    spacing : float [m]
        Between the heliostats of a row.
    middle_deg, half_width_deg : float [deg]
        The field's middle as an azimuth from north over east, and how far it reaches to each side.
    """
    lines = ["name,type,east_m,north_m,up_m"]
    for row, radius in enumerate(radii):
        step = np.degrees(spacing / radius)
        count = int(2 * half_width_deg / step) // 2 * 2 + row % 2  # odd and even rows in turn
        azimuths = middle_deg + (np.arange(count) - (count - 1) / 2) * step
        for number, azimuth in enumerate(np.radians(azimuths), start=1):
            east, north = radius * np.sin(azimuth), radius * np.cos(azimuth)
            lines.append(f"R{row + 1:02}-{number:02},{of_type},{east:.2f},{north:.2f},0")
    return "\n".join(lines) + "\n"


def write_template(path: Path) -> None:
    """Write the template to ``path``, its layout beside it.

    Raises
    ------
    InvalidInputError
        If one of the files exists.
    """
    layout = path.with_name(LAYOUT)
    for file in (path, layout):
        if file.exists() or file.is_symlink():
            raise InvalidInputError(f"{file} exists; name another file, or move it")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(template_text(), encoding="utf-8")
    layout.write_text(template_layout(), encoding="utf-8")
