"""Photographs of any plant that ``plant.yaml`` describes, and a second plant for the demonstration.

The second plant is what Juelich is not: 600 heliostats of 28 facets on azimuth-elevation mounts,
around a cylinder, in the southern hemisphere.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from heliotwin.demo.photographs import (
    DEVIATION,
    IMAGES,
    RAYS,
    TargetCamera,
    write_photograph,
    write_plant_file,
)
from heliotwin.folder import write_surface
from model.errors import InvalidInputError
from model.frames import sun_angles
from model.plant import Heliostat, TargetPlane
from model.prior import prior_of
from model.surface import control_points
from service.base.progress import Progress, no_progress
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.imported import PLANT
from service.sources.plant_template import staggered_layout

Array = NDArray[np.float64]

MIRRORS = 2
"""Photographed heliostats of a plant."""

_MAX_INCIDENCE_DEG = 55.0
"""On the target; light that grazes it makes a long spot."""


def write_southern_plant(folder: Path) -> Path:
    """Write the second plant's file and layout; return the file's path."""
    radii = [80.0 + 14 * row for row in range(12)]
    layout = staggered_layout("large", radii, 18.4, 180.0, 170.0)  # 600 heliostats
    return write_plant_file(folder, "southern", layout)


@dataclass(frozen=True, eq=False)
class Demonstrated:
    """A plant of a file, and what of it is photographed.

    Attributes
    ----------
    file : Path
        The plant's file.
    description : PlantDescription
    target : TargetPlane
    mirrors : list of Heliostat
        The photographed ones, from near to far.
    """

    file: Path
    description: PlantDescription
    target: TargetPlane
    mirrors: list[Heliostat]

    @classmethod
    def read(cls, file: Path, count: int = MIRRORS) -> "Demonstrated":
        """Read a plant, and choose its first target and so many heliostats.

        Raises
        ------
        InvalidInputError
            If the plant has no target, or no heliostat looks at it.
        """
        described = read_plant(file)
        target = _target(described, file)
        return cls(file, described, target, _photographed(described, target, count))

    def write(
        self,
        root: Path,
        progress: Progress = no_progress,
        *,
        images: int = IMAGES,
        rays: int = RAYS,
        seed: int = 2024,
    ) -> None:
        """Write a measurement folder with photographs.

        True surfaces are drawn from the prior of their kind, and stored in ``H/Deflectometry``. The
        plant's file and those that it names are copied.
        """
        rng = np.random.default_rng(seed)
        latitude = float(self.description.plant.origin[0])
        marks = self.description.marks_of[self.target.name] == "l_brackets"
        camera = TargetCamera(self.target, latitude, self.description.optics, rays, marks)
        _copy_plant(self.file, self.description, root)
        for mirror in self.mirrors:
            progress(mirror.name)
            prior = prior_of(mirror)
            z = prior.surface(rng.normal(0, DEVIATION, len(prior.basis)))
            write_surface(root, mirror.name, control_points=control_points(mirror, z))
            _write_photographs(root, mirror, camera, z, images, rng)


def _target(described: PlantDescription, file: Path) -> TargetPlane:
    """The first target that photographs are taken of."""
    if not described.plant.targets:
        raise InvalidInputError(f"{file}: targets: there is none to photograph spots on; add one")
    return next(iter(described.plant.targets.values()))


def _photographed(described: PlantDescription, target: TargetPlane, count: int) -> list[Heliostat]:
    """Heliostats from near to far, whose light meets the target steeply enough."""
    distances: list[tuple[float, Heliostat]] = []
    for heliostat in described.plant.heliostats.values():
        way = heliostat.position - target.center
        distance = float(np.linalg.norm(way))
        if way @ target.normal > distance * np.cos(np.radians(_MAX_INCIDENCE_DEG)):
            distances.append((distance, heliostat))
    if not distances:
        raise InvalidInputError(
            f"targets.{target.name}: no heliostat's light meets it within {_MAX_INCIDENCE_DEG:g}"
            " degrees of its normal; turn it toward the field"
        )
    distances.sort(key=lambda one: one[0])
    places = (np.arange(count) + 0.5) / count * len(distances)
    return [distances[place][1] for place in sorted(set(places.astype(int)))]


def _copy_plant(file: Path, described: PlantDescription, root: Path) -> None:
    """Copy the plant's file, and those that it names, to the same places below ``root``."""
    root.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, root / PLANT)
    for name in described.files:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file.parent / name, root / name)


def _write_photographs(
    root: Path,
    mirror: Heliostat,
    camera: TargetCamera,
    z: Array,
    images: int,
    rng: np.random.Generator,
) -> None:
    taken = camera.photograph(mirror, z, images, rng)
    for index, (sun, frame) in enumerate(zip(taken.suns, taken.frames, strict=True)):
        azimuth, elevation = sun_angles(sun)
        about: dict[str, object] = {
            "target_name": camera.target.name,
            "sun_azimuth_deg": float(azimuth) % 360,
            "sun_elevation_deg": float(elevation),
        }
        if taken.motors is not None:
            about["motor_position"] = np.round(taken.motors[index]).tolist()
        write_photograph(root / mirror.name, str(index + 1), about, raw=frame)
