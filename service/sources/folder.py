"""Measurement folders in PAINT's layout: the plant, its heliostats, measurements, measured surfaces, declared model.

Source: the PAINT database of the Solar Tower Juelich, https://paint-database.org; DESIGN.md, section 6.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from model.effects import Effect
from model.errors import InvalidInputError
from model.plant import Heliostat, Plant
from model.surface import control_points, fit_heights, heights
from model.tracing import Optics
from service.sources.documents import (
    IMAGE_KINDS,
    Array,
    Measurement,
    get,
    parse_declared,
    read_heliostat,
    read_json,
    read_measurement,
    read_moment,
    read_receivers,
    read_targets,
)


@dataclass(frozen=True, eq=False)
class MeasurementFolder:
    """A folder in PAINT's layout.

    Attributes
    ----------
    root : Path
    plant : Plant
        Its targets, and every heliostat that has a properties file.
    optics : Optics
        The declared model (``twin.json``), Buie's sun with 0.02 without one.
    effects : tuple of Effect
        Those of the declared model.
    skipped : dict
        Heliostats and measurements that are there but could not be read, with the reason.
    properties : dict
        The heliostats' property documents, by name, as their files have them.
    """

    root: Path
    plant: Plant
    optics: Optics
    effects: tuple[Effect, ...]
    skipped: dict[str, str]
    properties: dict[str, Any] = field(default_factory=dict)

    def measurements(self, heliostat: str, with_images: bool = True) -> list[Measurement]:
        """All measurements of a heliostat by identifier, or only those that have an image.

        A file that cannot be read is noted in ``skipped`` with its reason and costs none of the others.
        """
        return [m for m in self._measurements(heliostat) if m.images or not with_images]

    def _measurements(self, heliostat: str) -> Iterator[Measurement]:
        folder = self.root / heliostat / "Calibration"
        for path in sorted(folder.glob("*calibration-properties.json")):
            identifier = path.name.removesuffix("calibration-properties.json").removesuffix("-")
            if not identifier:
                continue  # a sample that PAINT ships without a number; nothing could refer to it
            try:
                measurement = read_measurement(identifier, heliostat, read_json(path), self.plant)
                item = folder / f"{identifier}-calibration-item-stac.json"
                if item.is_file():
                    measurement = replace(measurement, taken_at=read_moment(read_json(item), str(item)))
            except InvalidInputError as error:
                self.skipped[f"{heliostat}/{identifier}"] = str(error)
                continue
            images = {kind: folder / f"{identifier}-{kind}.png" for kind in IMAGE_KINDS}
            measurement.images.update({kind: file for kind, file in images.items() if file.is_file()})
            yield measurement

    def measured_surface(self, heliostat: str) -> tuple[Array, int] | None:
        """Control points (F, I, J, 3) [m] in mirror coordinates and degree of a measured surface, None without one."""
        return read_surface(self.root, self.plant.heliostats[heliostat])


def read_surface(root: Path, heliostat: Heliostat) -> tuple[Array, int] | None:
    """Control points (F, I, J, 3) [m] and spline degree from ``root/H/Deflectometry``, None where there are none."""
    folder = root / heliostat.name / "Deflectometry"
    spline = folder / f"{heliostat.name}-nurbs-surface.npz"
    if spline.is_file():
        with np.load(spline) as data:
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
    with h5py.File(file, "r") as data:
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


def read_folder(root: Path, heliostats: list[str] | None = None) -> MeasurementFolder:
    """Read the plant of a measurement folder.

    Raises
    ------
    InvalidInputError
        Where the folder has no tower file, or no heliostat that can be read.
    """
    if not root.is_dir():
        raise InvalidInputError(f"{root}: no such folder")
    towers = sorted(root.glob("*tower-measurements.json"))
    if not towers:
        raise InvalidInputError(f"{root}: no '*tower-measurements.json' at the root; is it a PAINT folder?")
    tower = read_json(towers[0])
    origin, targets = read_targets(tower)
    found: dict[str, Heliostat] = {}
    skipped: dict[str, str] = {}
    properties: dict[str, Any] = {}
    for folder in sorted(root.glob("*/Properties")):
        name, files = folder.parent.name, sorted(folder.glob("*heliostat-properties.json"))
        if not files or (heliostats is not None and name not in heliostats):
            continue
        try:
            if len(files) > 1:
                names = ", ".join(file.name for file in files)
                raise InvalidInputError(f"{folder}: more than one file of properties ({names}); leave the right one")
            document = read_json(files[0])
            found[name], properties[name] = read_heliostat(name, document, origin), document
        except InvalidInputError as error:
            skipped[name] = str(error)
    if not found:
        raise InvalidInputError(f"{root}: no heliostat with a readable 'Properties/*heliostat-properties.json'")
    plant = Plant(_plant_name(tower, towers[0]), origin, targets, found, read_receivers(tower))
    return MeasurementFolder(root, plant, *read_declared(root / "twin.json"), skipped, properties)


def _plant_name(tower: Any, file: Path) -> str:
    """PAINT's ID of the plant; older files have none, and bear the name themselves."""
    name = tower["power_plant_properties"].get("ID")
    return name if isinstance(name, str) and name else file.name.removesuffix("-tower-measurements.json")


def read_declared(path: Path) -> tuple[Optics, tuple[Effect, ...]]:
    """The optics and the effects that ``twin.json`` declares; the defaults where there is no such file."""
    return parse_declared(declared_json(path), str(path))


def declared_json(path: Path) -> Any:
    """What ``twin.json`` declares; an empty object where there is no such file."""
    return get(read_json(path), str(path), "declared") if path.is_file() else {}
