"""Measurement folders: the plant, its heliostats, measurements, measured surfaces, declared model.

`service.sources.importers` reads the folders of each source.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from model.errors import InvalidInputError
from model.plant import Heliostat, Plant
from model.plant_model import PlantModel
from model.surface import DEGREE, control_points, greville, heights
from service.base.arrays import unpack_untrusted
from service.base.discovery import modules_of
from service.base.plant import NO_FACTS, PlantFacts
from service.sources.documents import Array, Declared, Measurement, get, parse_declared, read_json
from service.sources.files import read_file
from service.sources.hdf5 import read_deflectometry

# PAINT's splines have 240 kB.
_MAX_SPLINE_BYTES = 2**22
_MAX_DEGREE = 7
# Largest deviation of x(u) and y(v) from linear ones, of a facet's sides.
_LINEAR = 1e-3


class MeasuredSurface(NamedTuple):
    """Control points (F, I, J, 3) [m] of a mirror in its coordinates, and the splines' degree.

    ``parameters_are_positions`` is that of `model.surface.heights`.
    """

    points: Array
    degree: int
    parameters_are_positions: bool = False

    @property
    def is_linear(self) -> bool:
        """Whether x and y are linear in the parameters, so that these are positions anyway."""
        _, rows, columns, _ = self.points.shape
        x, y = self.points[:, :, 0, 0], self.points[:, 0, :, 1]
        shares = ((a - a[:, :1]) / np.ptp(a, axis=1, keepdims=True) for a in (x, y))
        return all(
            np.abs(share - greville(count, self.degree)).max() < _LINEAR
            for share, count in zip(shares, (rows, columns), strict=True)
        )

    def write(self, path: Path) -> None:
        """Write it as ``H-nurbs-surface.npz``."""
        np.savez_compressed(
            path,
            control_points=self.points,
            degrees=np.full(2, self.degree),
            parameters_are_positions=np.array(int(self.parameters_are_positions)),
        )


@dataclass(frozen=True, eq=False)
class MeasurementFolder(ABC):
    """A folder of measurements in any layout; each importer derives a class.

    Attributes
    ----------
    root : Path
    plant : Plant
        With its targets, and every heliostat that could be read.
    model : PlantModel
        The declared model (``twin.json``); a Buie sun with 0.02 if there is none.
    skipped : dict
        Heliostats and measurements that could not be read, with the reason.
    broken : dict
        Skipped heliostats whose properties file exists but is wrong: the path and the reason, by
        heliostat.
    properties : dict
        The heliostats' property documents in PAINT's form, by name; the store keeps them.
    facts : PlantFacts
    """

    root: Path
    plant: Plant
    model: PlantModel
    skipped: dict[str, str]
    properties: dict[str, dict[str, object]] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)
    facts: PlantFacts = NO_FACTS

    def measurements(self, heliostat: str, with_images: bool = True) -> list[Measurement]:
        """All measurements of a heliostat by identifier, or only those with an image.

        A file that cannot be read is added to ``skipped``; the others are still read.
        """
        return [m for m in self.read_measurements(heliostat) if m.images or not with_images]

    def whole_field(self) -> "MeasurementFolder":
        """The folder with every heliostat that its files describe, measured or not.

        Stores take it: forecasts of a field need all its heliostats.
        """
        return self

    def declared(self) -> dict[str, object]:
        """The declared model in the form of ``twin.json``."""
        return dict(declared_json(self.root / "twin.json"))

    @abstractmethod
    def read_measurements(self, heliostat: str) -> Iterator[Measurement]:
        """Iterate over all measurements of a heliostat by identifier, with their image files."""

    def measured_surface(self, heliostat: str) -> MeasuredSurface | None:
        """The measured surface of a heliostat, or None; by default from the paths of PAINT's
        layout.
        """
        return read_surface(self.root, self.plant.heliostats[heliostat])


def read_height_std(root: Path, heliostat: Heliostat) -> Array | None:
    """Standard deviations (F, I, J) [m] of a predicted surface's heights, or None.

    They are ``z_std`` of the file that `read_surface` prefers.
    """
    spline = root / heliostat.name / "Deflectometry" / f"{heliostat.name}-nurbs-surface.npz"
    if not spline.exists():
        return None
    data = unpack_untrusted(read_file(spline, _MAX_SPLINE_BYTES), _MAX_SPLINE_BYTES, str(spline))
    if "z_std" not in data:
        return None
    std, shape = np.asarray(data["z_std"], dtype=np.float64), data["control_points"].shape[:3]
    if std.shape != shape or not np.isfinite(std).all() or (std < 0).any():
        raise InvalidInputError(
            f"{spline}: 'z_std' must be finite, not negative and {shape}, got {std.shape}"
        )
    return std


def read_surface(root: Path, heliostat: Heliostat) -> MeasuredSurface | None:
    """The measured surface from ``root/H/Deflectometry``, or None.

    ``H-nurbs-surface.npz`` comes first, then PAINT's ``*deflectometry.h5``, then any ``*.h5`` of
    PAINT or SOFAST; of several files the first by name.

    A spline is its geometry. If the file has the measured ``normals`` too, it is ARTIST's fit of
    deflectometry, whose parameters are positions. A number ``parameters_are_positions``, 0 or 1,
    in the file says it otherwise.
    """
    folder = root / heliostat.name / "Deflectometry"
    spline = folder / f"{heliostat.name}-nurbs-surface.npz"
    if spline.exists():
        data = unpack_untrusted(
            read_file(spline, _MAX_SPLINE_BYTES), _MAX_SPLINE_BYTES, str(spline)
        )
        if "control_points" not in data:
            raise InvalidInputError(f"{spline}: 'control_points' is missing")
        points, degree = (
            np.asarray(data["control_points"], dtype=np.float64),
            _degree(data.get("degrees")),
        )
        if points.ndim != 4 or points.shape[-1] != 3 or not np.isfinite(points).all():
            raise InvalidInputError(
                f"{spline}: 'control_points' must be finite and (facets, i, j, 3), got"
                f" {points.shape}"
            )
        if not 1 <= degree < min(_MAX_DEGREE + 1, *points.shape[1:3]):
            raise InvalidInputError(
                f"{spline}: 'degrees' must be 1 to {_MAX_DEGREE}, and less than there are points"
            )
        declared = data.get("parameters_are_positions", np.array(int("normals" in data)))
        if declared.size != 1 or declared.item() not in (0, 1):
            raise InvalidInputError(f"{spline}: 'parameters_are_positions' must be 0 or 1")
        found = MeasuredSurface(points, degree, bool(declared.item()))
        if found.parameters_are_positions and not found.is_linear:
            shape = tuple(max(n, DEGREE + 1) for n in points.shape[1:3])
            z = heights(heliostat, *found, shape=shape)
            return MeasuredSurface(control_points(heliostat, z), DEGREE)
        return found
    files = sorted(folder.glob("*deflectometry.h5")) or sorted(folder.glob("*.h5"))
    if not files:
        return None
    z = read_deflectometry(files[0], heliostat)
    return MeasuredSurface(control_points(heliostat, z), DEGREE)


def _degree(given: Array | None) -> int:
    """Degree of the splines; 3 if it is not given, 0 if it is invalid."""
    if given is None:
        return 3
    first = given.ravel()[:1]
    return int(first[0]) if first.size and np.isfinite(first[0]) else 0


def points_of(heliostat: Heliostat, surface: MeasuredSurface | None) -> tuple[Array, int]:
    """Control points (F, I, J, 3) [m] and spline degree; those of the ideal surface for None."""
    return (control_points(heliostat), DEGREE) if surface is None else surface[:2]


def measured_heights(heliostat: Heliostat, surface: MeasuredSurface) -> Array:
    """Heights z (F, 8, 8) [m] of a surface from `MeasurementFolder.measured_surface`."""
    return heights(heliostat, *surface)


@dataclass(frozen=True)
class Importer:
    """Reader of one source's folders.

    Attributes
    ----------
    recognises : callable
        True if a folder is from this source.
    read : callable
        Reads a folder with these heliostats, or with all for None; raises `InvalidInputError` if
        nothing can be read.
    otherwise : str
        Message for a folder that it does not recognise.
    """

    recognises: Callable[[Path], bool]
    read: Callable[[Path, list[str] | None], MeasurementFolder]
    otherwise: str


def read_folder(
    root: Path, heliostats: list[str] | None = None, *, whole_field: bool = False
) -> MeasurementFolder:
    """Read a measurement folder with the first importer that recognises it.

    It has the heliostats with measurements, or those of `MeasurementFolder.whole_field`.

    Raises
    ------
    InvalidInputError
        If no importer does, or no heliostat can be read.
    """
    if not root.is_dir():
        raise InvalidInputError(f"{root}: no such folder")
    # Importers depend on this module, so they are imported here.
    importers: list[Importer] = [
        module.IMPORTER for module in modules_of("service.sources.importers")
    ]
    for importer in importers:
        if importer.recognises(root):
            folder = importer.read(root, heliostats)
            folder = folder.whole_field() if whole_field else folder
            if not folder.plant.heliostats:
                raise InvalidInputError(
                    f"{root}: no heliostat of the plant has a folder of its name with Calibration"
                    " or Deflectometry; add one"
                )
            return folder
    raise InvalidInputError(f"{root}: {'; '.join(importer.otherwise for importer in importers)}")


def read_declared(path: Path) -> Declared:
    """The declared model of ``twin.json``; the defaults if there is no such file."""
    return parse_declared(declared_json(path), str(path))


def declared_json(path: Path) -> Any:
    """The JSON content of ``twin.json``; an empty object if there is no such file."""
    return get(read_json(path), str(path), "declared") if path.exists() else {}
