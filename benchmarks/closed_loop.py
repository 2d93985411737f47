"""The closed loop on data: ``python -m benchmarks.closed_loop``.

The six sets of ``../shared/undeclared``; the real plant (AA39, AC43), studied as a folder and by
leaving out one image at a time, with measured surfaces and with predicted ones; and what the effect
found buys where it matters: surfaces refined with it against deflectometry.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from benchmarks import data_folder
from benchmarks.folders import read_observations, read_photographs
from benchmarks.record import log_row, recording
from heliotwin.folder import predict_folder, surface_errors
from heliotwin.folder_study import study_folder
from model.effects import CATALOGUE, Effect, effect_from_json
from model.forecast import View
from model.metrics import flux_accuracies, flux_accuracy
from model.network.predictor import default_predictor
from model.observation import Observation, align_observations, render_observations
from model.plant import Heliostat, TargetPlane
from model.plant_model import JUELICH_MODEL, PlantModel
from model.refinement import refine
from model.site import JUELICH
from model.study import FluxImage, Study, StudyOptions, study_to_json
from model.study.fitting import Fitter
from model.study.flux_images import Forecaster
from model.study.parameters import ParameterVector, Term
from service.sources.folder import measured_heights, read_folder
from training.render import CleanCamera, SceneSampler, load_field, places
from training.surfaces import load_part

HELIOSTATS = ["AA39", "AC43"]
COMBINATIONS = (
    (),
    ("camera_response",),
    ("camera_shoulder",),
    ("gravity_bending",),
    ("camera_shoulder", "gravity_bending"),
    ("camera_shoulder", "soiling"),
    ("camera_shoulder", "facet_canting"),
    ("camera_shoulder", "sun_shape"),
    ("camera_shoulder", "background"),
    ("camera_shoulder", "target_registration"),
)


def plain(parameters: dict[str, Any]) -> str:
    """Parameters of a report's effect in one line; of many the largest."""
    parts = []
    for name, entry in parameters.items():
        if isinstance(entry["value"], dict):
            flat = [v for values in entry["value"].values() for v in np.atleast_1d(values)]
            parts.append(
                f"{name}: {len(flat)} values, largest {max(flat, key=abs):.2f} {entry['unit']}"
            )
        else:
            low, high = entry["ci95"]
            parts.append(f"{name} {entry['value']:.3f} [{low:.3f}, {high:.3f}] {entry['unit']}")
    return "; ".join(parts)


def studies(root: Path) -> None:
    """Verdicts of all sets."""
    print(
        "| set | verdict | effect and 95 % interval | accuracy before | after | left of the error"
        " beyond noise |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for path in sorted((root.parent / "undeclared").glob("set-*")):
        print(row(path.name, study_folder(read_folder(path)).study), flush=True)
    for window in (4.0, 6.0):
        for label, without in (("", ()), (", without `camera_shoulder`", ("camera_shoulder",))):
            print(
                row(f"AA39, AC43, {window:.0f} m{label}", real_study(root, window, without)),
                flush=True,
            )
    with TemporaryDirectory() as predicted:
        folder = read_folder(root, ["AA39"])
        predict_folder(folder, Path(predicted), images=4)
        print(
            row(
                "AA39, surface predicted from 4 of its images",
                study_folder(folder, predicted).study,
            ),
            flush=True,
        )


def real_study(root: Path, window: float | None = None, without: Sequence[str] = ()) -> Study:
    """The study of the real plant's photographs with measured surfaces and a catalogue without some
    effects.
    """
    candidates = tuple(name for name in CATALOGUE if name not in without)
    options = StudyOptions(window=window, candidates=candidates)
    return study_folder(read_folder(root, HELIOSTATS), options=options).study


def row(label: str, study: Study) -> str:
    """A study as a line of the table."""
    report = study_to_json(study)
    found = "<br>".join(f"{e['name']}: {plain(e['parameters'])}" for e in report["effects"]) or "-"
    before, after = (report[key]["accuracy_mean"] for key in ("before", "after"))
    share = report["unexplained_share"]
    effects = "; ".join(f"`{e['name']}` {plain(e['parameters'])}" for e in report["effects"])
    log_row(
        "Studies of data with unknown effects",
        label,
        {
            "verdict": report["verdict"],
            "effect with 95 % interval": effects or "none",
            "accuracy without": before,
            "accuracy with": after,
            "share of the error beyond noise that is left": share,
        },
        n=report["images"]["held_out"],
        of="held-out images",
        compared_with="measured flux images",
    )
    return f"| {label} | {report['verdict']} | {found} | {before:.3f} | {after:.3f} | {share:.2f} |"


def left_out(photographs: Sequence[FluxImage], kinds: tuple[str, ...], window: float) -> np.ndarray:
    """Accuracy (N,) of each photograph under effects that were fitted to all others."""
    folder_facets = tuple(sorted({(p.heliostat, len(p.setup.control_points)) for p in photographs}))
    unknowns = ParameterVector(tuple(Term(CATALOGUE[kind]) for kind in kinds), folder_facets)
    optics = read_folder(data_folder(), HELIOSTATS).model.optics
    accuracy = np.empty(len(photographs))
    for index, photograph in enumerate(photographs):
        rest = [p for p in photographs if p is not photograph]
        effects: list[Effect] = []
        if kinds:
            views = StudyOptions().fit_view, StudyOptions().view
            coarse, fine = (
                Forecaster(rest, PlantModel(JUELICH, optics), window, view) for view in views
            )
            fitter = Fitter(coarse, fine)
            effects = unknowns.effects(fitter.fit(unknowns, unknowns.neutral).values)
        judge = Forecaster([photograph], PlantModel(JUELICH, optics), window, StudyOptions().view)
        accuracy[index] = flux_accuracies(judge.measured(), judge.cuts(effects))[0]
    return accuracy


def real_plant(root: Path) -> None:
    """Leave-one-out accuracies of some combinations of effects."""
    photographs, _ = read_photographs(read_folder(root, HELIOSTATS))
    print(
        "\nReal plant, 6 m window, each of 11 images forecast with effects fitted to the other ten"
    )
    print("| effects | mean | median | worst |")
    print("| --- | --- | --- | --- |")
    for kinds in COMBINATIONS:
        values = left_out(photographs, kinds, 6.0)
        label = " + ".join(kinds) or "none"
        print(
            f"| {label} | {values.mean():.4f} | {np.median(values):.4f} | {values.min():.3f} |",
            flush=True,
        )
        log_row(
            "AA39 and AC43, each photograph forecast with effects fitted to the others",
            " + ".join(f"`{kind}`" for kind in kinds) or "none",
            {"mean": values.mean(), "median": np.median(values), "worst": values.min()},
            n=len(values),
            of="photographs",
            compared_with="measured flux images",
        )


Method = Callable[[Heliostat, list[Observation], Sequence[Effect]], np.ndarray]


def by_network(
    heliostat: Heliostat, images: list[Observation], effects: Sequence[Effect]
) -> np.ndarray:
    """Heights (4, 8, 8) [m] that the network predicts."""
    return default_predictor().heights(heliostat, images, JUELICH_MODEL.with_effects(effects))[0]


def by_refinement(
    heliostat: Heliostat, images: list[Observation], effects: Sequence[Effect]
) -> np.ndarray:
    """Heights (4, 8, 8) [m] of the most probable surface."""
    return refine(heliostat, images, JUELICH_MODEL.with_effects(effects)).z


METHODS: dict[str, Method] = {"predicted": by_network, "refined": by_refinement}


def real_surfaces(root: Path, effects: Sequence[Effect]) -> None:
    """Surfaces of AA39 and AC43 from their photographs, with and without effects, against
    deflectometry.
    """
    folder = read_folder(root, HELIOSTATS)
    for name, heliostat in folder.plant.heliostats.items():
        measured = folder.measured_surface(name)
        assert measured is not None
        truth = measured_heights(heliostat, measured)

        def by_deflectometry(*_: object, truth: np.ndarray = truth) -> np.ndarray:
            return truth

        # The effects may be a curve of the camera. Then the images are taken as counts.
        images = [read_observations(folder, name, model) for model in ((), effects)]
        for method, surface in {**METHODS, "measured": by_deflectometry}.items():
            for label, model, own in zip(("without", "with"), ((), effects), images, strict=True):
                errors = surface_errors(surface(heliostat, own[:8], model), truth)
                fresh = (
                    left_out_accuracy(heliostat, own, model, surface)
                    if len(own) > 2
                    else float("nan")
                )
                log_errors(f"{name}, {method}, {label} the effect", errors, len(own[:8]), fresh)
                label = f"{name}, {len(own[:8])} photographs, {method} | {label}"
                print(f"| {label} | {figures(errors)} | {fresh:.3f} |", flush=True)


def log_errors(row: str, errors: dict[str, float], n: int, accuracy: float | None = None) -> None:
    """Record the errors of a surface from ``n`` images."""
    log_row(
        "Surfaces with and without the effect that the study finds",
        row,
        {
            "error [mm]": errors["mae_mm"],
            "canting [mm]": errors["mae_canting_mm"],
            "waviness [mm]": errors["mae_waviness_mm"],
            "accuracy of images left out": accuracy,
        },
        n=n,
        of="images",
        compared_with="deflectometry",
    )


def figures(errors: dict[str, float]) -> str:
    """Errors of a surface [mm] in three columns."""
    return " | ".join(
        f"{errors[key]:.3f}" for key in ("mae_mm", "mae_canting_mm", "mae_waviness_mm")
    )


def left_out_accuracy(
    heliostat: Heliostat, images: list[Observation], effects: Sequence[Effect], surface: Method
) -> float:
    """Mean accuracy of every fourth image under the surface made from the others."""
    kept = images[::4]
    z = surface(heliostat, [o for o in images if o not in kept][:8], effects)
    traced = render_observations(heliostat, kept, z, JUELICH_MODEL.with_effects(effects)).clip(
        min=0
    )
    return float(
        np.mean([flux_accuracy(o.flux, image) for o, image in zip(kept, traced, strict=True)])
    )


def simulated_surfaces(root: Path, effects: Sequence[Effect], count: int) -> None:
    """Held-out surfaces photographed by a camera that has the effects, predicted and refined with
    and without them.
    """
    surfaces, _ = load_part(root, "test")
    field, rng = load_field(root), np.random.default_rng(11)
    found: dict[str, list[dict[str, float]]] = {}
    for truth in surfaces[:count]:
        position = field[rng.integers(len(field))]
        heliostat = Heliostat.juelich(
            "synthetic", position, float(np.linalg.norm(position - [0, 0, 55]))
        )
        images = photograph(heliostat, truth, effects, rng)
        for method, surface in METHODS.items():
            for label, model in (("without", []), ("with", list(effects))):
                errors = surface_errors(surface(heliostat, images, model), truth)
                found.setdefault(f"{method} | {label}", []).append(errors)
    for label, own in found.items():
        mean = {key: float(np.mean([errors[key] for errors in own])) for key in own[0]}
        method, _, effect = label.partition(" | ")
        log_errors(f"{count} held-out surfaces, {method}, {effect} the effect", mean, 8)
        print(f"| {count} held-out surfaces, 8 rendered images each, {label} | {figures(mean)} | |")


def photograph(
    heliostat: Heliostat, z: np.ndarray, effects: Sequence[Effect], rng: np.random.Generator
) -> list[Observation]:
    """Eight 8-bit images with 1 % noise of a mirror as a camera with effects shows it."""
    suns = SceneSampler().suns(8, rng)
    centers = np.stack([rng.uniform(-10, 10, 8), np.zeros(8), rng.uniform(30, 55, 8)], axis=-1)
    planes = [
        TargetPlane("t", c, np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8, 8) for c in centers
    ]
    setups = places(suns, planes)
    view = View(64, 64, window=4.0, samples=48)
    with torch.no_grad():
        flux = (
            align_observations(heliostat, setups, z, JUELICH_MODEL.with_effects(effects))
            .images(view)
            .numpy()
        )
    images = []
    for setup, image in zip(setups, flux, strict=True):
        noisy = image / image.max() + rng.normal(0, CleanCamera().noise, image.shape)
        digital = np.round(noisy.clip(0, 1) * 255).astype(np.float32)
        images.append(
            Observation(
                digital / digital.sum() * 100,
                setup.sun,
                setup.target,
                setup.center_of_mass,
                setup.identifier,
            )
        )
    return images


def surfaces(root: Path, simulated: int) -> None:
    """What the effect that the study of the real plant finds buys for surfaces."""
    report = study_to_json(real_study(root))
    found = [effect_from_json(entry) for entry in report["effects"]]
    print(
        "\nSurfaces made with and without what the study found, errors against deflectometry [mm]"
    )
    print("| images | effect | all | canting | waviness | accuracy of images left out |")
    print("| --- | --- | --- | --- | --- | --- |")
    real_surfaces(root, found)
    simulated_surfaces(root, found, simulated)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=("studies", "plant", "surfaces"), help="one part of it")
    parser.add_argument("--simulated", type=int, default=8, help="held-out surfaces to refine")
    arguments = parser.parse_args()
    root = data_folder()
    if not root.is_dir():
        print(f"closed loop: no real measurements at {root}; set HELIOTWIN_STJ")
        return
    parts: dict[str, Callable[[], None]] = {
        "studies": lambda: studies(root),
        "plant": lambda: real_plant(root),
        "surfaces": lambda: surfaces(root, arguments.simulated),
    }
    for name, part in parts.items():
        if arguments.only in (None, name):
            with recording(f"closed-loop-{name}"):
                part()


if __name__ == "__main__":
    main()
