"""How well a run predicts surfaces it never saw: ``python -m training.evaluate --run runs/best``.

Held-out measured surfaces are placed over the field, photographed under random suns, predicted, and traced again under
new suns. Beside the network stand the ideal surface and the mean surface of the training heliostats, which a network
that has learnt anything must beat.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from model.metrics import flux_accuracy, surface_error
from model.network.architecture import MAX_IMAGES
from training.render import Camera, render
from training.train import Run, TrainConfig

Array = NDArray[np.float64]


def _accuracy(predicted: Array, truth: Array, run: Run, seed: int) -> float:
    """Mean flux accuracy of surfaces (B, 4, 8, 8) [m] against the true ones at four suns the prediction did not see."""
    forecast, measured = (
        render(z, 4, run.field, run.config.situations, None, torch.device("cpu"), seed)[0] for z in (predicted, truth)
    )
    pairs = zip(forecast.flatten(0, 1).numpy(), measured.flatten(0, 1).numpy(), strict=True)
    return float(np.mean([flux_accuracy(b, a) for a, b in pairs]))


def _errors(predicted: Array, truth: Array) -> dict[str, float]:
    """Median, mean and quartiles [mm] of the error of control heights."""
    errors = np.array([surface_error(p, t) * 1e3 for p, t in zip(predicted, truth, strict=True)])
    names = ("min", "q1", "median", "q3", "max")
    figures = dict(zip(names, np.quantile(errors, [0, 0.25, 0.5, 0.75, 1]), strict=True))
    return {name: round(float(value), 4) for name, value in {**figures, "mean": errors.mean()}.items()}


@torch.no_grad()
def predict(run: Run, truth: Array, images: int, camera: Camera | None, seed: int) -> Array:
    """Surfaces (B, 4, 8, 8) [m] that the run's averaged network sees in rendered images of true ones."""
    flux, shots = render(truth, images, run.field, run.config.situations, camera, torch.device("cpu"), seed)
    return run.predict(flux, shots).double().numpy()


def evaluate(run: Run, repeats: int = 16, seed: int = 100) -> dict[str, Any]:
    """Figures on the held-out heliostats, each placed ``repeats`` times in the field."""
    truth = run.held_out.repeat(repeats, axis=0)
    mean = np.broadcast_to(run.surfaces.mean(axis=0), truth.shape)
    surfaces = {
        "ideal surface": np.zeros_like(truth),
        "mean surface": mean,
        "network, 8 clean images": predict(run, truth, MAX_IMAGES, None, seed),
        "network, 8 images of imperfect cameras": predict(run, truth, MAX_IMAGES, run.config.camera, seed),
        "network, 1 clean image": predict(run, truth, 1, None, seed),
    }
    return {
        name: {"mae_mm": _errors(z, truth), "flux_accuracy": round(_accuracy(z, truth, run, seed + 1), 4)}
        for name, z in surfaces.items()
    }


def main() -> None:
    """Print the figures of one run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/best"))
    arguments = parser.parse_args()
    run = Run(TrainConfig.read(arguments.run / "config.json"), arguments.run, torch.device("cpu"))
    print(json.dumps(evaluate(run), indent=1))


if __name__ == "__main__":
    main()
