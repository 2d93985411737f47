"""Surfaces from real photographs, against deflectometry: ``python -m tests.benchmarks.surfaces``.

AA39 and AC43, by the network and refined: errors of the control heights, canting apart from waviness; and the flux
accuracy on each photograph of surfaces that were predicted from the others. Surfaces from rendered images are the
business of ``python -m training.evaluate``.
"""

import numpy as np

from model.network.predictor import default_predictor
from model.observation import Observation, misfits
from model.plant import JUELICH_LATITUDE, Heliostat
from model.refinement import refine
from service.cli import folder as verbs
from service.cli.folder import surface_errors
from service.sources.folder import MeasurementFolder, measured_heights, read_folder
from service.twin.evidence import choose
from tests.benchmarks import data_folder

IMAGES = 8


def predicted(heliostat: Heliostat, observations: list[Observation]) -> dict[str, np.ndarray]:
    """Heights (4, 8, 8) [m] by the network and refined, from up to `IMAGES` observations."""
    used = choose(observations, IMAGES)
    network = default_predictor().predict(heliostat, used, latitude_deg=JUELICH_LATITUDE).z
    return {"network": network, "refined": refine(heliostat, used, network, latitude_deg=JUELICH_LATITUDE).z}


def errors(heliostat: Heliostat, observations: list[Observation], truth: np.ndarray) -> None:
    """Print how far the surfaces from all images lie off the measured one."""
    for label, z in {"ideal": np.zeros_like(truth), **predicted(heliostat, observations)}.items():
        found = surface_errors(z, truth)
        misfit = misfits(heliostat, observations, z, latitude_deg=JUELICH_LATITUDE)
        print(
            f"  {heliostat.name} {label:<8} from {min(IMAGES, len(observations))} images: all {found['mae_mm']:.3f}  "
            f"canting {found['mae_canting_mm']:.3f}  waviness {found['mae_waviness_mm']:.3f}  "
            f"flux accuracy on all images {1 - np.mean(misfit):.3f}"
        )


def left_out(heliostat: Heliostat, observations: list[Observation], truth: np.ndarray) -> None:
    """Print the flux accuracy on each image in turn, with surfaces predicted from the others."""
    rows = []
    for index, image in enumerate(observations):
        others = observations[:index] + observations[index + 1 :]
        surfaces = {"ideal": np.zeros_like(truth), **predicted(heliostat, others), "measured": truth}
        rows.append(
            {name: 1 - misfits(heliostat, [image], z, latitude_deg=JUELICH_LATITUDE)[0] for name, z in surfaces.items()}
        )
    for name in rows[0]:
        values = np.array([row[name] for row in rows])
        figures = f"mean {values.mean():.3f}  median {np.median(values):.3f}  min {values.min():.3f}"
        print(f"  {heliostat.name} {name:<8} {figures} of {len(values)} images, each left out in turn")


def mirrors(folder: MeasurementFolder) -> list[tuple[Heliostat, list[Observation], np.ndarray]]:
    """Heliostats with their usable photographs and measured heights (4, 8, 8) [m]."""
    found = []
    for name, heliostat in folder.plant.heliostats.items():
        observed = [verbs.observe(folder, measurement) for measurement in folder.measurements(name)]
        measured = folder.measured_surface(name)
        assert measured is not None
        images = [o for o in observed if isinstance(o, Observation)]
        found.append((heliostat, images, measured_heights(heliostat, measured)))
    return found


def main() -> None:
    """Print both tables."""
    if not data_folder().is_dir():
        print(f"surfaces: no real measurements at {data_folder()}; set HELIOTWIN_STJ")
        return
    found = mirrors(read_folder(data_folder(), ["AA39", "AC43"]))
    print("Real photographs to surfaces, mean absolute error of control heights [mm], facet means removed")
    for mirror in found:
        errors(*mirror)
    print("Flux accuracy on photographs that the surface was not predicted from, 4 m window")
    for mirror in found:
        left_out(*mirror)


if __name__ == "__main__":
    main()
