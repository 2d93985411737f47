"""Prediction methods for comparison: fixed surfaces, networks, refinement."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from model.images import FLUX_SHAPE
from model.network.predictor import N_ITERATIONS, SurfacePredictor
from model.plant_model import JUELICH_MODEL
from model.prior import SurfacePrior
from model.refinement import refine
from training.cases import Case
from training.render import Renderings, Setups
from training.train import Run

Array = NDArray[np.float64]


class Heights(NamedTuple):
    """Heights (4, 8, 8) [m], and their standard deviation if it is known."""

    z: Array
    z_std: Array | None = None


Method = Callable[[Case, int], Heights]
"""Predicts heights from the first images of a case; the second argument is their number."""


def always(z: Array) -> Method:
    """The same surface (4, 8, 8) [m] for all images."""
    return lambda case, images: Heights(z)


def by_onnx(predictor: SurfacePredictor, n_iterations: int = N_ITERATIONS) -> Method:
    """An exported network, called as the product calls it."""

    def method(case: Case, images: int) -> Heights:
        predicted = predictor.predict(
            case.heliostat, case.observations[:images], JUELICH_MODEL, n_iterations=n_iterations
        )
        return Heights(predicted.z, predicted.z_std)

    return method


def by_run(run: Run, n_iterations: int | None = None) -> Method:
    """The averaged network of a training run."""

    def method(case: Case, images: int) -> Heights:
        used = case.observations[:images]
        suns, aims = np.array([o.sun for o in used]), np.array([o.center_of_mass for o in used])
        nothing = np.zeros(FLUX_SHAPE, np.float32)
        flux, clipped = (
            torch.as_tensor(np.array(images))[None]
            for images in (
                [o.flux for o in used],
                [nothing if o.clipped is None else o.clipped for o in used],
            )
        )
        seen = Renderings(Setups.of([case.heliostat], suns, aims, run.device), flux, clipped)
        return Heights(run.predict(seen, n_iterations)[0].double().numpy())

    return method


def by_refinement(start: Method, prior: SurfacePrior | None = None) -> Method:
    """Refinement that starts from another method's surface, by default with the shipped prior."""

    def method(case: Case, images: int) -> Heights:
        refined = refine(
            case.heliostat,
            case.observations[:images],
            JUELICH_MODEL,
            start(case, images).z,
            prior=prior,
        )
        return Heights(refined.z, refined.z_std)

    return method


def by_network(path: Path, n_iterations: int | None = None) -> Method:
    """The network of an ONNX file, or of a run's folder."""
    if path.is_dir():
        return by_run(Run.open(path), n_iterations)
    return by_onnx(SurfacePredictor(path), n_iterations or N_ITERATIONS)


def held_out_of(path: Path) -> list[str]:
    """Heliostats that a network has not learnt from.

    ``path`` is a run's folder, or an ONNX file with its model card.
    """
    if path.is_dir():
        run = Run.open(path)
        return [name for name in run.names if name not in run.learnt]
    card = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    return list(card["trained_on"]["held_out"])
