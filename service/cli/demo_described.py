"""Photographs of any plant that ``plant.yaml`` describes, and a second plant for the demonstration.

The second plant is what Juelich is not: 600 heliostats of 28 facets on azimuth-elevation mounts,
around a cylinder, in the southern hemisphere.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.frames import sun_angles
from model.plant import Heliostat, TargetPlane
from model.prior import prior_of
from service.base.progress import Progress, no_progress
from service.cli.demo_photographs import DEVIATION, IMAGES, RAYS, Camera, write_frame, write_surface
from service.cli.folder import write_json
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.imported import LAYOUT, PLANT
from service.sources.plant_template import staggered_layout

Array = NDArray[np.float64]

MIRRORS = 2
"""Photographed heliostats of a plant."""

_MAX_INCIDENCE_DEG = 55.0
"""On the target; light that grazes it makes a long spot."""

SOUTHERN = """\
# The second plant of `heliotwin demo`.
plant:
  name: southern
  latitude_deg: -23.4
  longitude_deg: -69.2
  altitude_m: 1100
  time_zone: America/Santiago
heliostat_types:
  large:
    mount:
      kind: azimuth_elevation
      pivot_height_m: 4.2
      mirror_offset_m: 0.2
      drives: [{kind: rotary, steps_per_rad: 40000}, {kind: rotary, steps_per_rad: 40000}]
    facets: {rows: 4, columns: 7, width_m: 1.8, height_m: 1.35, gap_m: 0.02}
    facet_shape: slant_range
    canting: on_axis
    reflectance: 0.93
    slope_error_mrad: 1.0
    pointing_error_mrad: 0.5
layout: {file: layout.csv}
receivers:
  main: {kind: cylinder, center_m: [0, 0, 100], radius_m: 3.5, height_m: 9, absorptance: 0.94}
targets:
  calibration:
    kind: plane
    center_m: [0, -3.8, 82]
    normal: [0, -1, 0]
    up: [0, 0, 1]
    width_m: 12
    height_m: 12
    marks: l_brackets
tower: {radius_m: 3.5, height_m: 94}
sun: {shape: buie, csr: 0.02}
atmosphere: {visibility_km: 40}
"""


def write_southern_plant(folder: Path) -> Path:
    """Write the second plant's file and layout; return the file's path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / PLANT
    path.write_text(SOUTHERN, encoding="utf-8")
    radii = [80.0 + 14 * row for row in range(12)]
    layout = staggered_layout("large", radii, 18.4, 180.0, 170.0)  # 600 heliostats
    path.with_name(LAYOUT).write_text(layout, encoding="utf-8")
    return path


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
        camera = Camera(self.target, latitude, self.description.optics, rays, marks)
        _copy_plant(self.file, self.description, root)
        for mirror in self.mirrors:
            progress(mirror.name)
            prior = prior_of(mirror)
            z = prior.surface(rng.normal(0, DEVIATION, len(prior.basis)))
            write_surface(root, mirror, z)
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
    root: Path, mirror: Heliostat, camera: Camera, z: Array, images: int, rng: np.random.Generator
) -> None:
    taken = camera.photograph(mirror, z, images, rng)
    folder = root / mirror.name / "Calibration"
    folder.mkdir(parents=True, exist_ok=True)
    for index, (sun, frame) in enumerate(zip(taken.suns, taken.frames, strict=True)):
        azimuth, elevation = sun_angles(sun)
        about: dict[str, object] = {
            "target_name": camera.target.name,
            "sun_azimuth_deg": float(azimuth) % 360,
            "sun_elevation_deg": float(elevation),
        }
        if taken.motors is not None:
            about["motor_position"] = np.round(taken.motors[index]).tolist()
        write_json(folder / f"{index + 1}-calibration-properties.json", about)
        write_frame(folder / f"{index + 1}-raw.png", frame)
