"""The flux that a receiver can take, as a number, a map or along its flow path."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from service.sources.text_lines import ForeignLine, read_csv, to_number

Array = NDArray[np.float64]

# Largest limit [kW/m2]; below the sun's own surface.
_MAX_KW_M2 = 6e4
_LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class Limit:
    """The flux that a receiver can take.

    Attributes
    ----------
    values : (r, c) [W/m2]
        Over the unrolled map, row 0 at the top; (1, 1) for one number.
    path : (n, 2) or None
        Positions along the flow path, 0 to 1, and shares of ``values`` there.
    """

    values: Array
    path: Array | None = None

    def on_map(self, rows: int, columns: int) -> Array:
        """The limit (rows, columns) [W/m2] on a map.

        A pixel has the limit of the cell that its middle is in. With a flow path the fluid enters
        in the middle column, and leaves at both edges.
        """
        down, right = (
            (np.arange(wanted) + 0.5) / wanted * had
            for wanted, had in zip((rows, columns), self.values.shape, strict=True)
        )
        limit = self.values[np.ix_(down.astype(int), right.astype(int))]
        if self.path is None:
            return limit
        along = np.abs((np.arange(columns) + 0.5) / columns * 2 - 1)
        return np.asarray(limit * np.interp(along, self.path[:, 0], self.path[:, 1]))


def read_limit(given: str, flow_path: Path | None = None) -> Limit:
    """Read ``--limit``: a number [kW/m2], or a CSV of numbers [kW/m2] over the unrolled map.

    ``flow_path`` is a CSV of positions along the flow path, 0 to 1, and shares of the limit.

    Raises
    ------
    InvalidInputError
        It names option, file and line of what is no limit.
    """
    path = None if flow_path is None else _flow_path(flow_path)
    value = to_number(given)
    if math.isnan(value):
        return Limit(1e3 * _limit_map(Path(given)), path)
    if not 0 < value <= _MAX_KW_M2:
        raise InvalidInputError(f"--limit: must lie in (0, {_MAX_KW_M2:g}] kW/m2, got {given}")
    return Limit(np.full((1, 1), 1e3 * value), path)


def _limit_map(file: Path) -> Array:
    """Limits (r, c) [kW/m2] of a file."""
    if not file.is_file():
        raise InvalidInputError(f"--limit: {str(file)[:60]!r} is neither a number nor a file")
    lines = read_csv(file)
    for line in lines:
        if len(line.cells) != len(lines[0].cells):
            raise line.refuse(f"has {len(line.cells)} limits, and the first {len(lines[0].cells)}")
    if not lines:
        raise InvalidInputError(f"--limit: {file} has no limits")
    return np.array(
        [
            [line.number(cell, _LEAST, _MAX_KW_M2) for cell in range(len(line.cells))]
            for line in lines
        ]
    )


def _flow_path(file: Path) -> Array:
    """Positions and shares (n, 2) of a file, whose first line may name them."""
    lines = read_csv(file)
    if lines and math.isnan(to_number(lines[0].cells[0].strip())):
        lines = lines[1:]
    path = np.array([[line.number(0, 0, 1), line.number(1, _LEAST, 1)] for line in lines])
    if len(path) < 2:
        raise InvalidInputError(f"--flow-path: {file} must have two lines, position and share")
    for line, before, after in zip(lines[1:], path[:-1, 0], path[1:, 0], strict=True):
        _require_after(line, before, after)
    return path


def _require_after(line: ForeignLine, before: float, after: float) -> None:
    if after <= before:
        raise line.refuse(f"position {after:g} must be above that of the line before, {before:g}")
