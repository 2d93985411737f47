"""Which parts of the network pay: ``python -m training.ablate``.

Networks of `ablation.json` are trained side by side for a short while, on the same images of training mirrors, and
judged on validation mirrors; intervals are bootstrapped over mirrors, differences paired.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from model.network.architecture import MAX_IMAGES, SurfaceNetwork
from model.network.catalogue import sizes_of
from model.network.inputs import descents
from training.config import TrainConfig
from training.figures import interval, markdown
from training.parts import CHANGES, PartsConfig, PartsNetwork, steepest_descents
from training.render import Camera, Photographs, render
from training.train import Run, train_steps

Array = NDArray[np.float64]

VARIANTS = Path(__file__).parent / "ablation.json"

PLACES = 8
"""Places of the field at which each validation mirror is judged."""


def variant(values: dict[str, Any], config: TrainConfig, folder: Path) -> Run:
    """A run of the network of one entry of `VARIANTS`."""
    config = replace(config, learning_rate=values.get("learning_rate", config.learning_rate))
    torch.manual_seed(config.seed)
    network: nn.Module
    if "parts" in values:
        network = PartsNetwork(PartsConfig(**values["parts"]))
    else:
        network = CHANGES[values.get("change", "")](SurfaceNetwork(sizes_of("ours", values.get("network", {}))))
    way = steepest_descents if values.get("descents") == "steepest" else descents
    return Run(config, folder, torch.device("cpu"), network, way)


def errors_of(run: Run, seen: Photographs, truth: Tensor) -> Array:
    """Mean absolute height errors (looks, mirrors) [mm]; photographs are of each mirror at `PLACES`."""
    found = []
    for looks in range(1, run.config.looks + 1):
        parts = [slice(start, start + 16) for start in range(0, len(truth), 16)]
        guess = torch.cat([run.predict(seen[part], looks) for part in parts])
        found.append((guess - truth).abs().mean(dim=(1, 2, 3)).view(PLACES, -1).mean(dim=0))
    return np.asarray(torch.stack(found).double().numpy()) * 1e3


def train(runs: dict[str, Run], steps: int) -> dict[str, float]:
    """Train runs side by side; how long each has taken for a step of all its looks [ms]."""
    trained = list(runs.values())
    for step in range(1, steps + 1):
        errors = train_steps(trained)
        if step % 100 == 0:
            print(step, *(f"{error:.3f}" for error in errors), file=sys.stderr, flush=True)
    leading = trained[0]
    photographs, truth = leading.batch()
    shown = leading.shown(photographs, leading.mean.expand(len(truth), -1, -1, -1))
    return {name: 1e3 * min(_seconds(run, shown, truth) for _ in range(5)) for name, run in runs.items()}


def _seconds(run: Run, shown: tuple[Tensor, ...], truth: Tensor) -> float:
    start = time.perf_counter()
    run.descend(*run.answer(shown), truth)
    return time.perf_counter() - start


def judge(runs: dict[str, Run]) -> dict[str, Array]:
    """Errors (cameras, looks, mirrors) [mm] on validation mirrors, of clean and imperfect cameras."""
    first = next(iter(runs.values()))
    surfaces = np.tile(first.validation, (PLACES, 1, 1, 1))
    truth = torch.as_tensor(surfaces, dtype=torch.float32)
    truth = truth - truth.mean(dim=(2, 3), keepdim=True)
    errors: dict[str, list[Array]] = {name: [] for name in runs}
    for camera in (None, Camera()):
        seen = render(surfaces, MAX_IMAGES, first.field, first.config.situations, camera, first.device, seed=1)
        for name, run in runs.items():
            errors[name].append(errors_of(run, seen, truth))
    return {name: np.stack(found) for name, found in errors.items()}


def table(runs: dict[str, Run], milliseconds: dict[str, float], errors: dict[str, Array]) -> str:
    """Mean errors of each camera and look, and of both cameras' last looks beside those of the first run."""
    first = next(iter(errors.values()))[:, -1].mean(axis=0)
    rows = []
    for name, run in runs.items():
        last = errors[name][:, -1].mean(axis=0)
        low, high = interval(lambda drawn, e=last: e[drawn].mean() / first[drawn].mean(), len(first))  # type: ignore[misc]
        rows.append(
            [
                name,
                f"{sum(p.numel() for p in run.network.parameters()) / 1e6:.2f}",
                f"{milliseconds[name]:.0f}",
                *(f"{look.mean():.4f}" for camera in errors[name] for look in camera),
                f"{last.mean() / first.mean():.3f} [{low:.3f}, {high:.3f}]",
            ]
        )
    looks = range(1, next(iter(runs.values())).config.looks + 1)
    columns = [f"{camera}, look {look} [mm]" for camera in ("clean", "imperfect") for look in looks]
    head = [
        "network",
        "parameters [M]",
        "a look in training [ms]",
        *columns,
        "last looks, to the first network's, 90 %",
    ]
    return markdown(head, rows)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default=TrainConfig().data)
    parser.add_argument("--variants", type=Path, default=VARIANTS, help="JSON of networks by name")
    parser.add_argument("--only", nargs="+", help="names of those to train; the others are compared with the first")
    parser.add_argument("--steps", type=int, default=700, help="batches, each looked at as often as training does")
    arguments = parser.parse_args()
    config = TrainConfig(data=arguments.data, steps=arguments.steps)
    with tempfile.TemporaryDirectory() as folder:
        variants = json.loads(arguments.variants.read_text(encoding="utf-8"))
        chosen = arguments.only or list(variants)
        if unknown := set(chosen) - set(variants):
            parser.error(f"--only: {', '.join(sorted(unknown))} not in {arguments.variants.name}")
        runs = {name: variant(variants[name], config, Path(folder)) for name in chosen}
        milliseconds = train(runs, arguments.steps)
        print(table(runs, milliseconds, judge(runs)))


if __name__ == "__main__":
    main()
