"""Train the surface network: ``python -m training.train --config training/configs/best.json``.

Images are rendered as the training goes, so that no surface is seen twice under the same sun. Each batch is looked at
from the mean surface, then from what the network has just said of it. A run keeps everything in one folder: its config,
a checkpoint to resume from, its curve, and the weights of the exponential moving average.

On several GPUs, or CPU processes, which share every batch:
``torchrun --nproc-per-node 4 -m training.train --config training/configs/best.json --folder runs/best``.
"""

import argparse
import copy
import json
import math
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from model.network.architecture import MAX_IMAGES
from model.network.catalogue import build
from model.network.inputs import descents
from training import parallel
from training.config import TrainConfig
from training.prior import estimate
from training.render import Descents, Photographs, load_field, render
from training.surfaces import load_surfaces


def loss_terms(heights: Tensor, spread: Tensor, truth: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean absolute height error [mm] and slope error [mm per control spacing], and the spread's neg. log-likelihood.

    Mirrors count by their ``weight`` (B,). The spread learns from the error but does not pull at the heights.
    """
    error = heights - truth
    slopes = error.diff(dim=-1).abs().mean(dim=(1, 2, 3)) + error.diff(dim=-2).abs().mean(dim=(1, 2, 3))
    likelihood = (error.detach().abs() / spread + torch.log(spread)).mean()
    return (weight * error.abs().mean(dim=(1, 2, 3))).mean(), (weight * slopes).mean(), likelihood


def commit_of(folder: Path) -> str:
    """The repository's commit, ``+`` where tracked files differ from it; "unknown" outside of one or without git."""
    if shutil.which("git") is None:
        return "unknown"
    asked = ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    done = subprocess.run(asked, cwd=folder, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


class Run:
    """One training run in its folder, of the config's network, and its way to descents, unless others are given."""

    def __init__(
        self,
        config: TrainConfig,
        folder: Path,
        device: torch.device,
        network: nn.Module | None = None,
        way: Descents = descents,
    ) -> None:
        if config.batch % parallel.size():
            raise ValueError(f"batch {config.batch} cannot be shared evenly among {parallel.size()} processes")
        self.config, self.folder, self.device, self.way = config, folder, device, way
        surfaces, self.names = load_surfaces(Path(config.data))
        train, judges = config.parts(self.names)
        self.surfaces, self.validation = surfaces[train], surfaces[judges]
        self.learnt = [self.names[i] for i in train]
        self.field = load_field(Path(config.data))
        prior = estimate(self.surfaces)
        self.mean, self.basis = (
            torch.as_tensor(values, dtype=torch.float32, device=device) for values in (prior.mean, prior.basis)
        )
        self.usual = float(np.abs(self.surfaces - prior.mean).mean()) * 1e3
        torch.manual_seed(config.seed)
        network = network or build(config.architecture, config.network)
        self.network = network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, betas=(0.9, 0.98)
        )
        # Without AVX-512 a CPU does sums of sixteen bits one by one, ten times as slowly as those of thirty-two.
        able = device.type != "cpu" or torch.backends.cpu.get_cpu_capability().startswith("AVX512")
        self.short_floats = config.bfloat16 and able
        self.step, self.commit = 0, ""
        if (folder / "checkpoint.pt").is_file():
            self._resume()

    @classmethod
    def open(cls, folder: Path) -> "Run":
        """A run as its folder describes it, on the CPU."""
        return cls(TrainConfig.read(folder / "config.json"), folder, torch.device("cpu"))

    def _resume(self) -> None:
        state = torch.load(self.folder / "checkpoint.pt", map_location=self.device, weights_only=True)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step = state["step"]
        self.commit = state["commit"]

    def save(self) -> None:
        """Write the config and the checkpoint; a crash while writing leaves the old one."""
        if parallel.rank() > 0:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "config.json").write_text(json.dumps(asdict(self.config), indent=1) + "\n", encoding="utf-8")
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "commit": self.commit,
        }
        torch.save(state, self.folder / "checkpoint.tmp")
        (self.folder / "checkpoint.tmp").replace(self.folder / "checkpoint.pt")

    def _learning_rate(self) -> float:
        """Linear warm-up, then a cosine to a hundredth."""
        c = self.config
        if self.step < c.warmup:
            return c.learning_rate * (self.step + 1) / c.warmup
        progress = min(1.0, (self.step - c.warmup) / max(1, c.steps - c.warmup))
        return c.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress)))

    def shown(self, photographs: Photographs, guess: Tensor) -> tuple[Tensor, ...]:
        """What the network is shown of photographs of B mirrors, beside guesses (B, 4, 8, 8) [m]."""
        # Geometry does not bear sixteen bits: all of it stays outside of autocast.
        with torch.no_grad():
            guess_flux, conditions = photographs.trace(guess), photographs.setups.conditions()
            descent = photographs.descents(guess, self.basis, self.way)
        mask = torch.ones(guess_flux.shape[:2], device=self.device)
        return photographs.flux, conditions, mask, guess_flux, guess * 1e3, descent * 1e3

    def answer(self, shown: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Heights and spread (B, 4, 8, 8) [mm] that the network in training says of what it is shown."""
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.short_floats):
            heights, spread = self.network.train()(*shown)
        return heights.float(), spread.float()

    @torch.no_grad()
    def predict(self, photographs: Photographs, looks: int | None = None) -> Tensor:
        """Surfaces (B, 4, 8, 8) [m] that the averaged network sees after all its looks."""
        guess = self.mean.expand(len(photographs.flux), -1, -1, -1)
        for _ in range(self.config.looks if looks is None else looks):
            guess = self.average.eval()(*self.shown(photographs, guess))[0] * 1e-3
        return guess

    def batch(self) -> tuple[Photographs, Tensor]:
        """Photographs of the step's mirrors, and their true heights (B, 4, 8, 8) [mm]."""
        c = self.config
        rng = np.random.default_rng((c.seed, self.step, parallel.rank()))
        z = c.augmentation.sample(self.surfaces, c.batch // parallel.size(), rng)
        images = int(rng.integers(1, MAX_IMAGES + 1))
        with torch.no_grad():
            seen = render(z, images, self.field, c.situations, c.camera, self.device, int(rng.integers(2**31)))
        truth = torch.as_tensor(z * 1e3, dtype=torch.float32, device=self.device)
        return seen, truth - truth.mean(dim=(2, 3), keepdim=True)

    def train_step(self) -> float:
        """Render a batch, learn from each look at it; return the last look's height error [mm]."""
        return train_steps([self])[0]

    def descend(self, heights: Tensor, spread: Tensor, truth: Tensor) -> float:
        """Change the weights once for the network's answers to be true; return the height error [mm]."""
        c = self.config
        rough = (truth - 1e3 * self.mean).abs().mean(dim=(1, 2, 3))
        # Rough mirrors err by more; they would else have the others' share of the network.
        error, slopes, likelihood = loss_terms(heights, spread, truth, (self.usual / rough).clamp(max=1))
        self.optimizer.param_groups[0]["lr"] = self._learning_rate()
        self.optimizer.zero_grad()
        loss = error + c.slope_weight * slopes + c.spread_weight * likelihood
        loss.backward()  # type: ignore[no-untyped-call]
        parallel.average_gradients(self.network.parameters())
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        # One batch in thousands overflows; its step would be the end of the run.
        if torch.isfinite(norm):
            self.optimizer.step()
            self._update_average()
        return float((heights.detach() - truth).abs().mean())

    def _update_average(self) -> None:
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for mean, current in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(current, 1 - decay)

    def validate(self, repeats: int = 8) -> list[float]:
        """Mean absolute height error [mm] on validation mirrors, eight clean images each, after each look."""
        if not len(self.validation):
            return []
        z = self.validation.repeat(repeats, axis=0)
        seen = render(z, MAX_IMAGES, self.field, self.config.situations, None, self.device, seed=0)
        truth = torch.as_tensor(z, dtype=torch.float32, device=self.device)
        truth = truth - truth.mean(dim=(2, 3), keepdim=True)
        guesses = [self.predict(seen, looks) for looks in range(1, self.config.looks + 1)]
        return [round(float((guess - truth).abs().mean()) * 1e3, 4) for guess in guesses]

    def train(self, minutes: float, every: int = 250) -> None:
        """Train to the last step, or until the time is up."""
        end = time.monotonic() + 60 * minutes
        # A run that goes on by other code than it began with says so.
        self.commit = " ".join(dict.fromkeys([*self.commit.split(), commit_of(Path(__file__).parent)]))
        errors: list[float] = []
        while self.step < self.config.steps and not parallel.agreed(time.monotonic() >= end, self.device):
            errors.append(self.train_step())
            if self.step % every == 0 or self.step == self.config.steps:
                self._report(float(np.mean(errors)))
                errors.clear()
        self.save()

    def _report(self, error: float) -> None:
        """One line of the curve, and a checkpoint."""
        self.save()
        if parallel.rank() > 0:
            return
        line = {"step": self.step, "train_mae_mm": round(error, 4), "validation_mae_mm": self.validate()}
        with (self.folder / "curve.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)


def train_steps(runs: Sequence[Run]) -> list[float]:
    """One step of runs side by side, on the same images: those of the first; their last looks' height errors [mm].

    A batch is looked at several times, from the mean surface first and then from what the first run has just said, and
    each look changes the weights.
    """
    leading, ways = runs[0], {run.way: run for run in runs}
    photographs, truth = leading.batch()
    guess = leading.mean.expand(len(truth), -1, -1, -1)
    for _ in range(leading.config.looks):
        shown = {way: run.shown(photographs, guess) for way, run in ways.items()}
        answers = [run.answer(shown[run.way]) for run in runs]
        errors = [run.descend(*answer, truth) for run, answer in zip(runs, answers, strict=True)]
        guess = answers[0][0].detach() * 1e-3
    for run in runs:
        run.step += 1
    return errors


def main() -> None:
    """Train, or resume, one run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", type=Path, help="JSON of TrainConfig; defaults without one")
    # torchrun takes "--run" for a beginning of its own "--run-path", wherever it stands.
    parser.add_argument("--run", "--folder", type=Path, default=Path("runs/best"), help="folder of the run")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so many minutes")
    parser.add_argument("--fold", type=int, help="which heliostats to keep back, for a cross-validation")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--device", help="a GPU where there is one, unless given")
    arguments = parser.parse_args()
    config = TrainConfig.read(arguments.config) if arguments.config else TrainConfig()
    if arguments.fold is not None:
        config = replace(config, fold=arguments.fold, folds=arguments.folds)
    with parallel.team(arguments.device) as device:
        Run(config, arguments.run, device).train(arguments.minutes)


if __name__ == "__main__":
    main()
