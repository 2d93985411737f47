"""Surfaces against deflectometry: ``python -m tests.benchmarks.surfaces``.

Real photographs of AA39 and AC43 to surfaces, by the network and refined; then measured surfaces that neither the
network nor the prior has seen, rendered with noise at random places of the field.
"""

import time

import numpy as np

from model.metrics import surface_error
from model.network.predictor import default_predictor, model_card
from model.observation import Observation
from model.plant import Heliostat, TargetPlane
from model.refinement import default_prior, refine
from service import folder as verbs
from service.folder import choose, surface_errors
from service.paint import measured_heights, read_folder
from tests.benchmarks import data_folder
from tests.rendered import observe
from training.render import Situations, load_field
from training.surfaces import load_surfaces

NOISE = 0.01  # of the peak
IMAGES = 8


def real() -> None:
    """AA39 and AC43 from their photographs."""
    folder = read_folder(data_folder(), ["AA39", "AC43"])
    print("Real photographs to surfaces, mean absolute error of control heights [mm], facet means removed")
    for name, heliostat in folder.plant.heliostats.items():
        observed = [verbs.observe(folder, measurement) for measurement in folder.measurements(name)]
        images = choose([o for o in observed if isinstance(o, Observation)], IMAGES)
        measured = folder.measured_surface(name)
        assert measured is not None
        truth = measured_heights(heliostat, measured)
        network = default_predictor().predict(heliostat, images)
        for label, predicted in (("network", network), ("refined", refine(heliostat, images, network.z))):
            errors = surface_errors(predicted.z, truth)
            print(
                f"  {name} {label:<8} {len(images)} images: all {errors['mae_mm']:.3f}  "
                f"canting {errors['mae_canting_mm']:.3f}  waviness {errors['mae_waviness_mm']:.3f}  "
                f"ideal surface {errors['mae_ideal_mm']:.3f}  misfit {predicted.misfit:.3f}"
            )


def photographs(heliostat: Heliostat, z: np.ndarray, rng: np.random.Generator) -> list[Observation]:
    """Noisy 8-bit images (IMAGES of them) of a mirror under random suns."""
    suns = Situations().suns(IMAGES, rng)
    centers = np.stack([rng.uniform(-10, 10, IMAGES), np.zeros(IMAGES), rng.uniform(30, 55, IMAGES)], axis=-1)
    planes = [TargetPlane("t", c, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), 8, 8) for c in centers]
    return observe(heliostat, z, suns, planes, rng, NOISE)


def simulated() -> None:
    """The held-out measured surfaces of the model card, rendered."""
    surfaces, names = load_surfaces(data_folder())
    field, rng, rows = load_field(data_folder()), np.random.default_rng(3), []
    for name in model_card()["trained_on"]["held_out"]:
        truth = surfaces[names.index(name)]
        position = field[rng.integers(len(field))]
        heliostat = Heliostat.juelich(
            "synthetic", position, float(np.linalg.norm(position - [0, 0, 55]) * rng.uniform(0.9, 1.05))
        )
        images = photographs(heliostat, truth, rng)
        start = time.perf_counter()
        network = default_predictor().predict(heliostat, images)
        refined = refine(heliostat, images, network.z)
        seconds = time.perf_counter() - start
        inside = np.abs(refined.z - truth) < 1.645 * refined.z_std
        errors = [surface_error(z, truth) * 1e3 for z in (default_prior().mean, network.z, refined.z)]
        rows.append([*errors, inside.mean(), seconds])
        print(f"  {name}: mean surface {errors[0]:.3f}  network {errors[1]:.3f}  refined {errors[2]:.3f}")
    mean, median = np.mean(rows, axis=0), np.median(rows, axis=0)
    print(f"  mean:   mean surface {mean[0]:.3f}  network {mean[1]:.3f}  refined {mean[2]:.3f}")
    print(f"  median: mean surface {median[0]:.3f}  network {median[1]:.3f}  refined {median[2]:.3f}")
    print(f"  share inside 90 % intervals of the refinement {mean[3]:.2f}; {mean[4]:.1f} s a heliostat")


def main() -> None:
    """Print both tables."""
    if not data_folder().is_dir():
        print(f"surfaces: no real measurements at {data_folder()}; set HELIOTWIN_STJ")
        return
    real()
    print(f"Held-out measured surfaces, {IMAGES} rendered images each, 1 % noise: mean absolute error [mm]")
    simulated()


if __name__ == "__main__":
    main()
