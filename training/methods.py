"""Ways to a surface that are compared with one another: fixed ones, networks, refinement."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from model.images import FLUX_SHAPE
from model.network.predictor import LOOKS, SurfacePredictor
from model.plant import JUELICH_LATITUDE
from model.prior import SurfacePrior
from model.refinement import refine
from training.cases import Case
from training.render import Photographs, Setups
from training.train import Run

Array = NDArray[np.float64]

Method = Callable[[Case, int], tuple[Array, Array | None]]
"""Heights (4, 8, 8) [m] from a case's first images, so many, and their standard deviation where it is told."""


def always(z: Array) -> Method:
    """The same surface (4, 8, 8) [m] whatever the images show."""
    return lambda case, images: (z, None)


def by_onnx(predictor: SurfacePredictor, looks: int = LOOKS) -> Method:
    """An exported network, asked as the product asks it."""

    def method(case: Case, images: int) -> tuple[Array, Array | None]:
        predicted = predictor.predict(
            case.heliostat, case.observations[:images], looks=looks, latitude_deg=JUELICH_LATITUDE
        )
        return predicted.z, predicted.z_std

    return method


def by_run(run: Run, looks: int | None = None) -> Method:
    """The averaged network of a training run."""

    def method(case: Case, images: int) -> tuple[Array, Array | None]:
        used = case.observations[:images]
        suns, aims = np.array([o.sun for o in used]), np.array([o.center_of_mass for o in used])
        nothing = np.zeros(FLUX_SHAPE, np.float32)
        flux, clipped = (
            torch.as_tensor(np.array(images))[None]
            for images in ([o.flux for o in used], [nothing if o.clipped is None else o.clipped for o in used])
        )
        seen = Photographs(Setups.of([case.heliostat], suns, aims, run.device), flux, clipped)
        return run.predict(seen, looks)[0].double().numpy(), None

    return method


def by_refinement(start: Method, prior: SurfacePrior | None = None) -> Method:
    """What refinement makes of another method's surface; with the shipped prior unless another is given."""

    def method(case: Case, images: int) -> tuple[Array, Array | None]:
        refined = refine(
            case.heliostat,
            case.observations[:images],
            start(case, images)[0],
            prior=prior,
            latitude_deg=JUELICH_LATITUDE,
        )
        return refined.z, refined.z_std

    return method


def by_network(path: Path, looks: int | None = None) -> Method:
    """The network of an ONNX file, or of a run's folder."""
    if path.is_dir():
        return by_run(Run.open(path), looks)
    return by_onnx(SurfacePredictor(path), looks or LOOKS)


def held_out_of(path: Path) -> list[str]:
    """The heliostats that the network of a run's folder, or of an ONNX file with its card, has not learnt from."""
    if path.is_dir():
        run = Run.open(path)
        return [name for name in run.names if name not in run.learnt]
    card = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    return list(card["trained_on"]["held_out"])
