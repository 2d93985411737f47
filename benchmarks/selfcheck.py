"""Whether predictions that should not be trusted are flagged: ``python -m
benchmarks.selfcheck``.

Mirrors held out of training are photographed at places of the field, as they should be and with
something wrong, and refined as the product does it. A prediction is trusted where it explains all
its images by a mirror like those known, and it has no other warning
(`model.prediction_warnings`): how often each warning occurs is printed below. Real photographs
follow: AA39's and AC43's as their own and as each other's.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks import data_folder
from benchmarks.folders import read_observations
from benchmarks.record import log_row, recording
from benchmarks.surfaces import IMAGES
from model.effects.soiling import Soiling
from model.images import normalized
from model.metrics import surface_error
from model.observation import SurfacePrediction, render_observations
from model.plant_model import JUELICH_MODEL
from model.prior import tilt_modes
from service.sources.folder import read_folder
from service.twin.measurements import choose_diverse
from service.twin.operations import predict
from training.cases import Case, make_cases
from training.render import CleanCamera, load_field
from training.surfaces import load_part

NOISE = 0.01
"""Standard deviation of a pixel, of the peak."""

CANTING_ERROR_MRAD = 3.0
"""Slope by which one facet is turned: five times the prior's."""

Array = np.ndarray
Fault = Callable[[Case, Case, np.random.Generator], Case]
"""What becomes of a case where something is wrong, which may come from another case."""


def seen(case: Case, images: Array, rng: np.random.Generator) -> Case:
    """The case with other images (M, 64, 64), to which noise and rounding to 8 bits are added."""
    peak = images.max(axis=(1, 2), keepdims=True)
    noisy = np.round((images / peak + rng.normal(0, NOISE, images.shape)).clip(0, 1) * 255)
    fluxes = normalized(noisy).astype(np.float32)
    observations = [
        replace(o, flux=flux) for o, flux in zip(case.observations, fluxes, strict=True)
    ]
    return replace(case, observations=observations)


def as_it_should_be(case: Case, other: Case, rng: np.random.Generator) -> Case:
    """Nothing is wrong."""
    return case


def canted(case: Case, other: Case, rng: np.random.Generator) -> Case:
    """One facet is turned by `CANTING_ERROR_MRAD`."""
    angle, facet, z = rng.uniform(0, 2 * np.pi), rng.integers(4), case.truth.copy()
    slopes = CANTING_ERROR_MRAD * 1e-3 * np.array([np.cos(angle), np.sin(angle)])
    z[facet] += np.tensordot(slopes, tilt_modes(), axes=1)
    return seen(
        replace(case, truth=z),
        render_observations(case.heliostat, case.observations, z, JUELICH_MODEL),
        rng,
    )


def broken(case: Case, other: Case, rng: np.random.Generator) -> Case:
    """One facet reflects nothing."""
    clean = np.ones(4)
    clean[rng.integers(4)] = 0
    effects = [Soiling({case.heliostat.name: clean})]
    return seen(
        case,
        render_observations(
            case.heliostat, case.observations, case.truth, JUELICH_MODEL.with_effects(effects)
        ),
        rng,
    )


def of_another(case: Case, other: Case, rng: np.random.Generator) -> Case:
    """All images show another heliostat, at another place."""
    shown = [
        replace(o, flux=p.flux) for o, p in zip(case.observations, other.observations, strict=True)
    ]
    return replace(case, observations=shown)


def one_of_another(case: Case, other: Case, rng: np.random.Generator) -> Case:
    """The third image shows another heliostat."""
    foreign = of_another(case, other, rng).observations[2]
    return replace(case, observations=[*case.observations[:2], foreign, *case.observations[3:]])


def second_spot(case: Case, other: Case, rng: np.random.Generator) -> Case:
    """On the third image another heliostat's spot lies beside, a metre off and half as strong."""
    images = np.array([o.flux for o in case.observations], dtype=np.float64)
    images[2] += 0.5 * np.roll(other.observations[2].flux, (4, 16), axis=(0, 1))
    return seen(case, images, rng)


FAULTS: dict[str, Fault] = {
    "as it should be": as_it_should_be,
    "one facet canted by 3 mrad": canted,
    "one facet without light": broken,
    "images of another heliostat": of_another,
    "one image of another heliostat": one_of_another,
    "one image with a second spot": second_spot,
}


def line(label: str, cases: list[Case], predictions: list[SurfacePrediction]) -> str:
    """Format the numbers of flagged predictions, and of those flagged for the third image alone,
    with misfits and errors of the heights.
    """
    mean, worst = (np.array([f(p.misfits) for p in predictions]) for f in (np.mean, np.max))
    untrusted = sum(not p.trusted for p in predictions)
    errors = [
        surface_error(p.z, case.truth) * 1e3 for p, case in zip(predictions, cases, strict=True)
    ]
    distances = [p.mahalanobis_distance for p in predictions]
    named = Counter(" ".join(reason.split()[:3]) for p in predictions for reason in p.warnings)
    third = sum(p.suspicious == p.used[2:3] for p in predictions)
    log_row(
        "Predictions with a known fault",
        label,
        {
            "flagged": untrusted,
            "the third image alone named": third,
            "misfit of the worst image, median": np.median(worst),
            "Mahalanobis distance, median": np.median(distances),
            "error, median [mm]": np.median(errors),
        },
        n=len(cases),
        of="mirrors",
        compared_with="the true fault",
    )
    return (
        f"  {label:<32} untrusted {untrusted:>2} of {len(mean):<3} third image alone {third:>2}  "
        f" misfit median {np.median(mean):.3f}   worst image min {worst.min():.3f} median"
        f" {np.median(worst):.3f} max {worst.max():.3f}   mahalanobis min {min(distances):.2f}"
        f" median {np.median(distances):.2f} max {max(distances):.2f}   error [mm] median"
        f" {np.median(errors):.3f}   {dict(named) or ''}"
    )


def rendered(count: int) -> None:
    """Print a line for each fault."""
    surfaces, names = load_part(data_folder(), "test")
    cases = make_cases(
        surfaces, names, load_field(data_folder()), count, CleanCamera(NOISE), seed=300
    )
    for label, fault in FAULTS.items():
        pairs = zip(cases, cases[1:] + cases[:1], strict=True)
        wrong = [
            fault(case, other, np.random.default_rng((301, i)))
            for i, (case, other) in enumerate(pairs)
        ]
        print(
            line(
                label,
                wrong,
                [predict(c.heliostat, c.observations, JUELICH_MODEL, "refined") for c in wrong],
            ),
            flush=True,
        )


def photographed() -> None:
    """Print what is made of AA39's and AC43's photographs, by their own models and by
    each other's.
    """
    folder = read_folder(data_folder(), ["AA39", "AC43"])
    seen_of = {name: read_observations(folder, name) for name in folder.plant.heliostats}
    for heliostat in folder.plant.heliostats.values():
        for owner, observations in seen_of.items():
            predicted = predict(
                heliostat, choose_diverse(observations, IMAGES), JUELICH_MODEL, "refined"
            )
            verdict, shown = (
                "trusted" if predicted.trusted else "untrusted",
                " ".join(f"{m:.3f}" for m in predicted.misfits),
            )
            log_row(
                "Real photographs, by the own and the other heliostat",
                f"{heliostat.name} from photographs of {owner}",
                {"verdict": verdict, "Mahalanobis distance": predicted.mahalanobis_distance},
                n=len(predicted.misfits),
                of="photographs",
            )
            print(f"  {heliostat.name} from photographs of {owner}: {verdict}", end="   ")
            print(f"mahalanobis {predicted.mahalanobis_distance:.2f}   misfits {shown}")


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=16, help="mirrors, each with every fault")
    arguments = parser.parse_args()
    if not data_folder().is_dir():
        print(f"selfcheck: no measured surfaces at {data_folder()}; set HELIOTWIN_STJ")
        return
    rendered(arguments.cases)
    photographed()


if __name__ == "__main__":
    with recording("selfcheck"):
        main()
