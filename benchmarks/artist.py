"""Scenarios of ARTIST both ways: ``python -m benchmarks.artist PYTHON SCENARIOS``.

``PYTHON`` is that of an environment with ``artist-csp``, which needs other packages than ours. Each
heliostat is traced by both programs, alone and aimed at one target:

- our plant, exported, with mounts of three kinds and flat, focused and canted mirrors;
- ARTIST's example scenarios in the folder ``SCENARIOS``, imported.

ARTIST gives each ray the same light and weighs it by the cosine on the target. Ours is divided by
the light on the mirror and multiplied by that cosine.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.record import Estimate, log_row, recording
from model.forecast import View, align
from model.frames import sun_direction
from model.plant import Heliostat, TargetPlane
from model.plant_model import PlantModel
from model.setup import Setup
from model.surface import DEGREE, control_points
from service.sources.folder import read_surface
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.artist import read_artist
from service.sources.plant_formats.artist_export import write_artist
from tests.service.sources.plant_files import write_three_mounts

Array = np.ndarray

SUNS = ((150.0, 50.0), (235.0, 30.0))
SIZE, BLOCKS = 256, 32
NARROW_MRAD, WIDE_MRAD = 0.2, 2.35


class Spot(NamedTuple):
    """Total, centre (2,) [m] right and up of the target's, and rms radius [m] of a flux image; the
    share of its light by ``blocks`` (32, 32).
    """

    total: float
    center: Array
    radius: float
    blocks: Array


def spot_of(image: Array, target: TargetPlane) -> Spot:
    """The spot of an image (rows, columns) that covers the target."""
    places = target.to_plane(target.grid(*image.shape).points)
    total = float(image.sum())
    center = (image[..., None] * places).sum(axis=(0, 1)) / total
    spread = (image[..., None] * (places - center) ** 2).sum() / total
    blocks = image.reshape(BLOCKS, SIZE // BLOCKS, BLOCKS, SIZE // BLOCKS).sum(axis=(1, 3))
    return Spot(total, center, float(np.sqrt(spread)), blocks / total)


def by_artist(scenario: Path, target: str, sun: Array) -> dict[str, Array]:
    """ARTIST's images by heliostat."""
    out = scenario.with_suffix(".npz")
    script = Path(__file__).with_name("artist_tracer.py")
    python = sys.argv[1]
    subprocess.run([python, "-P", script, scenario, target, *map(str, sun), out], check=True)
    with np.load(out) as images:
        return dict(images)


def by_us(
    plant: PlantDescription, heliostat: Heliostat, target: TargetPlane, sun: Array, folder: Path
) -> Array:
    """Our image in ARTIST's units."""
    surface = read_surface(folder, heliostat) or (control_points(heliostat), DEGREE)
    setup = Setup(heliostat, surface[0], sun, target, degree=surface[1])
    aligned = align([setup], PlantModel(plant.plant.site, plant.optics).with_dni(1.0))
    image = aligned.flux(View(SIZE, SIZE, samples=50))[0].numpy()
    pivot = heliostat.position + heliostat.mount.joint
    out = target.center - pivot
    out = out / np.linalg.norm(out)
    incidence = np.sqrt((1 + out @ sun) / 2)
    cell = target.width * target.height / image.size
    return image * cell / (heliostat.area * incidence) * -(out @ target.normal)


def compared(
    plant: PlantDescription, scenario: Path, target: TargetPlane, folder: Path
) -> Iterator[tuple[str, Spot, Spot]]:
    """Heliostat, our spot and ARTIST's under each sun."""
    for angles in SUNS:
        sun = sun_direction(*angles)
        theirs = by_artist(scenario, target.name, sun)
        for name, heliostat in plant.plant.heliostats.items():
            if name not in theirs:
                print(f"{scenario.stem}: {name} is left out, whose motors do not reach the aim")
                continue
            ours = by_us(plant, heliostat, target, sun, folder)
            yield name, spot_of(ours, target), spot_of(theirs[name], target)


def report(row: str, pairs: list[tuple[str, Spot, Spot]]) -> None:
    """Print each pair, and record the largest differences."""
    totals, apart, radii, shared = [], [], [], []
    for name, ours, theirs in pairs:
        totals.append(abs(ours.total / theirs.total - 1))
        apart.append(float(np.linalg.norm(ours.center - theirs.center)))
        radii.append(abs(ours.radius / theirs.radius - 1))
        shared.append(np.minimum(ours.blocks, theirs.blocks).sum())
        print(
            f"{row}: {name:12} total {ours.total:.4f} {theirs.total:.4f}, centre"
            f" {1e3 * apart[-1]:.1f} mm apart, radius {ours.radius:.4f} {theirs.radius:.4f} m,"
            f" {100 * shared[-1]:.1f} % shared"
        )
    log_row(
        "Scenarios of ARTIST",
        row,
        {
            "total, largest difference [%]": Estimate(100 * max(totals), goal="<= 1"),
            "centre, largest distance [mm]": Estimate(1e3 * max(apart), goal="<= 20"),
            "radius, largest difference [%]": 100 * max(radii),
            "light at the same places, least [%]": 100 * min(shared),
        },
        n=len(pairs),
        of="heliostats and suns",
        compared_with="ARTIST 2.0",
    )


def exported() -> None:
    """Our plant, written for ARTIST; a narrow sun shows the mirrors' own light."""
    for sigma in (NARROW_MRAD, WIDE_MRAD):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            path = write_three_mounts(folder)
            text = path.read_text(encoding="utf-8")
            path.write_text(text.replace(f"sigma_mrad: {WIDE_MRAD}", f"sigma_mrad: {sigma}"))
            plant = read_plant(path)
            scenario = folder / "scenario.h5"
            write_artist(plant, scenario, None)
            target = plant.plant.targets["cal"]
            pairs = list(compared(plant, scenario, target, folder))
            report(f"exported, sun of {sigma} mrad", pairs)


def imported() -> None:
    """ARTIST's examples, read."""
    for scenario in sorted(Path(sys.argv[2]).glob("*.h5")):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            plant = read_plant(read_artist(scenario).write(folder)[0])
            copy = folder / scenario.name
            copy.write_bytes(scenario.read_bytes())
            target = max(plant.plant.targets.values(), key=lambda one: one.center[2])
            report(f"imported: {scenario.stem}", list(compared(plant, copy, target, folder)))


def main() -> None:
    """Print and record both ways."""
    exported()
    imported()


if __name__ == "__main__":
    with recording("artist"):
        main()
