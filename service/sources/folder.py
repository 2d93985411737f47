"""Measurement folders: the plant, its heliostats, measurements, measured surfaces, declared model.

Whose folder it is and what its files look like `service.sources.importers` know. See DESIGN.md, section 6.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from model.effects import Effect
from model.errors import InvalidInputError
from model.imaging import Camera
from model.plant import Heliostat, Plant
from model.surface import control_points, fit_heights, heights
from model.tracing import Optics
from service.base.discovery import modules_of
from service.sources.documents import Array, Declared, Measurement, get, parse_declared, read_json
from service.sources.files import require_regular


@dataclass(frozen=True, eq=False)
class MeasurementFolder(ABC):
    """A folder of measurements, whatever its layout: each importer derives its own.

    Attributes
    ----------
    root : Path
    plant : Plant
        Its targets, and every heliostat that could be read.
    optics : Optics
        The declared model (``twin.json``), Buie's sun with 0.02 without one.
    effects : tuple of Effect
    cameras : tuple of Camera
        Those of the declared model.
    skipped : dict
        Heliostats and measurements that are there but could not be read, with the reason.
    properties : dict
        The heliostats' property documents, by name, in PAINT's form: the store keeps them.
    """

    root: Path
    plant: Plant
    optics: Optics
    effects: tuple[Effect, ...]
    cameras: tuple[Camera, ...]
    skipped: dict[str, str]
    properties: dict[str, Any] = field(default_factory=dict)

    def measurements(self, heliostat: str, with_images: bool = True) -> list[Measurement]:
        """All measurements of a heliostat by identifier, or only those that have an image.

        A file that cannot be read is noted in ``skipped`` with its reason and costs none of the others.
        """
        return [m for m in self.read_measurements(heliostat) if m.images or not with_images]

    @abstractmethod
    def read_measurements(self, heliostat: str) -> Iterator[Measurement]:
        """All measurements of a heliostat by identifier, with the files of their images."""

    def measured_surface(self, heliostat: str) -> tuple[Array, int] | None:
        """Control points (F, I, J, 3) [m] in mirror coordinates and degree of a measured surface, None without one.

        By default they lie where PAINT has them.
        """
        return read_surface(self.root, self.plant.heliostats[heliostat])


def read_surface(root: Path, heliostat: Heliostat) -> tuple[Array, int] | None:
    """Control points (F, I, J, 3) [m] and spline degree from ``root/H/Deflectometry``, None where there are none."""
    folder = root / heliostat.name / "Deflectometry"
    spline = folder / f"{heliostat.name}-nurbs-surface.npz"
    if spline.exists():
        with np.load(require_regular(spline)) as data:
            if "control_points" not in data:
                raise InvalidInputError(f"{spline}: 'control_points' is missing")
            points = np.asarray(data["control_points"], dtype=np.float64)
            degree = int(data["degrees"][0]) if "degrees" in data else 3
        if points.ndim != 4 or points.shape[-1] != 3 or not np.isfinite(points).all():
            raise InvalidInputError(
                f"{spline}: 'control_points' must be finite and (facets, i, j, 3), got {points.shape}"
            )
        return points, degree
    for file in sorted(folder.glob("*deflectometry.h5")):
        return control_points(heliostat, read_deflectometry(file, heliostat)), 3
    return None


def read_deflectometry(file: Path, heliostat: Heliostat) -> Array:
    """Heights z (F, 8, 8) [m] fitted to the (n, 3) points and normals of each facet, in mirror coordinates."""
    centers, axes, half_sizes = heliostat.facet_frames
    facets = []
    with h5py.File(require_regular(file), "r") as data:
        for index, (center, frame, half_size) in enumerate(zip(centers, axes, half_sizes, strict=True), start=1):
            where = f"{file}, facet{index}"
            points, normals = (
                np.asarray(get(data, where, f"facet{index}", name), dtype=np.float64).reshape(-1, 3) @ frame.T
                for name in ("surface_points", "surface_normals")
            )
            u, v = ((points - frame @ center)[:, :2] / (2 * half_size) + 0.5).T
            inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & np.isfinite(normals).all(axis=-1)
            if inside.sum() < 256:
                raise InvalidInputError(f"{where}: only {inside.sum()} usable points on the facet, 256 are needed")
            facets.append(fit_heights(u[inside], v[inside], normals[inside], half_size))
    return np.array(facets)


def measured_heights(heliostat: Heliostat, surface: tuple[Array, int]) -> Array:
    """Heights z (F, 8, 8) [m] of a measured surface as `MeasurementFolder.measured_surface` gives it."""
    return heights(heliostat, surface[0], surface[1])


@dataclass(frozen=True)
class Importer:
    """Reads the folders of one source.

    Attributes
    ----------
    recognises : callable
        Whether a folder is one of them.
    read : callable
        The folder, with these heliostats or, for None, all; raises `InvalidInputError` where nothing can be read.
    otherwise : str
        What to say of a folder that it does not recognise.
    """

    recognises: Callable[[Path], bool]
    read: Callable[[Path, list[str] | None], MeasurementFolder]
    otherwise: str


def read_folder(root: Path, heliostats: list[str] | None = None) -> MeasurementFolder:
    """Read the plant of a measurement folder by the first importer that recognises it.

    Raises
    ------
    InvalidInputError
        Where none does, or no heliostat can be read.
    """
    if not root.is_dir():
        raise InvalidInputError(f"{root}: no such folder")
    # Importers build on this module, so they are looked for only now.
    importers: list[Importer] = [module.IMPORTER for module in modules_of("service.sources.importers")]
    for importer in importers:
        if importer.recognises(root):
            return importer.read(root, heliostats)
    raise InvalidInputError(f"{root}: {'; '.join(importer.otherwise for importer in importers)}")


def read_declared(path: Path) -> Declared:
    """What ``twin.json`` declares; the defaults where there is no such file."""
    return parse_declared(declared_json(path), str(path))


def declared_json(path: Path) -> Any:
    """What ``twin.json`` declares; an empty object where there is no such file."""
    return get(read_json(path), str(path), "declared") if path.exists() else {}
