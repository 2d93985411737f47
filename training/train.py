"""Train the surface network: ``python -m training.train --config training/configs/best.json``.

Images are rendered during training, so that no surface occurs twice under the same sun. The network
is applied to each batch first from the mean surface, then from its previous output. A run has one
folder: its config, a checkpoint to resume from, its learning curve, and the weights of the
exponential moving average.
"""

import argparse
import copy
import json
import math
import shutil
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from model.network.architecture import MAX_IMAGES, SurfaceNetwork
from model.prior import SurfacePrior
from training.config import TrainConfig
from training.prior import estimate
from training.render import Renderings, load_field, render
from training.surfaces import load_surfaces

Array = NDArray[np.float64]


class LossTerms(NamedTuple):
    """Height error [mm], slope error [mm per control spacing], and the spread's loss.

    Errors are mean absolute ones. The spread's loss is its negative log-likelihood.
    """

    error: Tensor
    slopes: Tensor
    likelihood: Tensor


def loss_terms(heights: Tensor, spread: Tensor, truth: Tensor, weight: Tensor) -> LossTerms:
    """Compute the loss; mirrors count by their ``weight`` (B,).

    The spread learns from the height error, but its gradient does not change the heights.
    """
    error = heights - truth
    slopes = error.diff(dim=-1).abs().mean(dim=(1, 2, 3)) + error.diff(dim=-2).abs().mean(
        dim=(1, 2, 3)
    )
    likelihood = (error.detach().abs() / spread + torch.log(spread)).mean()
    height_error = (weight * error.abs().mean(dim=(1, 2, 3))).mean()
    return LossTerms(height_error, (weight * slopes).mean(), likelihood)


def learning_rate(config: TrainConfig, step: int) -> float:
    """Linear warm-up, then a cosine to a hundredth."""
    if step < config.warmup:
        return config.learning_rate * (step + 1) / config.warmup
    progress = min(1.0, (step - config.warmup) / max(1, config.steps - config.warmup))
    return config.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress)))


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Move the exponential moving average of the weights towards a network."""
    for mean, current in zip(average.parameters(), network.parameters(), strict=True):
        mean.lerp_(current, 1 - decay)


def commit_of(folder: Path) -> str:
    """The repository's commit, with ``+`` if tracked files differ from it.

    The result is "unknown" outside of a repository or without git.
    """
    if shutil.which("git") is None:
        return "unknown"
    asked = ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    done = subprocess.run(asked, cwd=folder, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


class TrainingBatch(NamedTuple):
    """Photographs of mirrors, and their true heights (B, F, 8, 8) [mm]."""

    photographs: Renderings
    truth: Tensor

    @classmethod
    def of(cls, seen: Renderings, z: Array) -> "TrainingBatch":
        """Photographs of heights ``z`` (B, F, 8, 8) [m]."""
        truth = torch.as_tensor(z * 1e3, dtype=torch.float32, device=seen.flux.device)
        return cls(seen, truth - truth.mean(dim=(2, 3), keepdim=True))


class Trainer(ABC):
    """A training run in its folder; each derived class has a kind of mirrors.

    The mean of the ``prior`` is the first guess. ``usual`` [mm] is the usual mean absolute height
    over it, and ``scale`` [mm] the unit of heights inside the network.
    """

    def __init__(
        self,
        config: TrainConfig,
        folder: Path,
        device: torch.device,
        prior: SurfacePrior,
        usual: float,
        scale: float = 0.35,
    ) -> None:
        self.config, self.folder, self.device, self.usual = config, folder, device, usual
        self.mean, self.basis = (
            torch.as_tensor(values, dtype=torch.float32, device=device)
            for values in (prior.mean, prior.basis)
        )
        torch.manual_seed(config.seed)
        network = SurfaceNetwork(config.network, scale, len(prior.mean)).to(device)
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            betas=(0.9, 0.98),
        )
        # Without AVX-512, a CPU is ten times slower with sixteen bits than with thirty-two.
        able = device.type != "cpu" or torch.backends.cpu.get_cpu_capability().startswith("AVX512")
        self.short_floats = config.bfloat16 and able
        self.step, self.commit = 0, ""
        self.validation_errors: list[float] = []
        if (folder / "checkpoint.pt").is_file():
            self._resume()

    @property
    def _stateful(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("network", "average", "optimizer")}

    def _resume(self) -> None:
        state = torch.load(
            self.folder / "checkpoint.pt", map_location=self.device, weights_only=True
        )
        for name, part in self._stateful.items():
            part.load_state_dict(state[name])
        self.step, self.commit = state["step"], state["commit"]

    def save(self) -> None:
        """Write the config and the checkpoint; the old one remains if a crash interrupts."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "config.json").write_text(
            json.dumps(asdict(self.config), indent=1) + "\n", encoding="utf-8"
        )
        state = {name: part.state_dict() for name, part in self._stateful.items()}
        state |= {"step": self.step, "commit": self.commit}
        torch.save(state, self.folder / "checkpoint.tmp")
        (self.folder / "checkpoint.tmp").replace(self.folder / "checkpoint.pt")

    def inputs(self, photographs: Renderings, guess: Tensor) -> Sequence[Tensor]:
        """Return the network's inputs for photographs of B mirrors and guesses (B, F, 8, 8) [m]."""
        # Geometry needs more than sixteen bits: all of it is outside of autocast.
        with torch.no_grad():
            guess_flux, conditions = photographs.trace(guess), photographs.setups.conditions()
            descent = photographs.conjugate_gradient_steps(guess, self.basis)
        mask = torch.ones(guess_flux.shape[:2], device=self.device)
        return photographs.flux, conditions, mask, guess_flux, guess * 1e3, descent * 1e3

    @torch.no_grad()
    def predict(self, photographs: Renderings, n_iterations: int | None = None) -> Tensor:
        """Return the surfaces (B, F, 8, 8) [m] of the averaged network after all iterations."""
        guess = self.mean.expand(len(photographs.flux), -1, -1, -1)
        for _ in range(self.config.n_iterations if n_iterations is None else n_iterations):
            guess = self.average.eval()(*self.inputs(photographs, guess))[0] * 1e-3
        return guess

    @abstractmethod
    def batch(self) -> TrainingBatch:
        """Render photographs of the step's mirrors."""

    @abstractmethod
    def validate(self) -> list[float]:
        """Mean absolute height error [mm] on validation mirrors after each iteration."""

    def train_step(self) -> float:
        """Render a batch and learn from each iteration on it; return the last height error [mm]."""
        photographs, truth = self.batch()
        guess = self.mean.expand(len(truth), -1, -1, -1)
        for _ in range(self.config.n_iterations):
            inputs = self.inputs(photographs, guess)
            with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.short_floats):
                heights, spread = (values.float() for values in self.network.train()(*inputs))
            error = self.optimizer_step(heights, spread, truth)
            guess = heights.detach() * 1e-3
        self.step += 1
        return error

    def optimizer_step(self, heights: Tensor, spread: Tensor, truth: Tensor) -> float:
        """Update the weights once; return the height error [mm]."""
        c = self.config
        rough = (truth - 1e3 * self.mean).abs().mean(dim=(1, 2, 3))
        # Rough mirrors have larger errors; without the weight they would dominate the loss.
        error, slopes, likelihood = loss_terms(
            heights, spread, truth, (self.usual / rough).clamp(max=1)
        )
        self.optimizer.param_groups[0]["lr"] = learning_rate(c, self.step)
        self.optimizer.zero_grad()
        loss = error + c.slope_weight * slopes + c.spread_weight * likelihood
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        # One batch in thousands overflows; its step would end the run.
        if torch.isfinite(norm):
            self.optimizer.step()
            decay = min(c.ema, (1 + self.step) / (10 + self.step))
            update_average(self.average, self.network, decay)
        return float((heights.detach() - truth).abs().mean())

    def train(self, minutes: float, every: int = 250) -> None:
        """Train to the last step, or until the time is up."""
        end = time.monotonic() + 60 * minutes
        # A run that continues with other code records both commits.
        self.commit = " ".join(
            dict.fromkeys([*self.commit.split(), commit_of(Path(__file__).parent)])
        )
        errors: list[float] = []
        while self.step < self.config.steps and time.monotonic() < end:
            errors.append(self.train_step())
            if self.step % every == 0 or self.step == self.config.steps:
                self._report(float(np.mean(errors)))
                errors.clear()
        self.save()

    def _report(self, error: float) -> None:
        """Append one line to the learning curve, and write a checkpoint."""
        self.save()
        self.validation_errors = self.validate()
        line = {
            "step": self.step,
            "train_mae_mm": round(error, 4),
            "validation_mae_mm": self.validation_errors,
        }
        with (self.folder / "curve.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)


def height_errors(run: Trainer, batch: TrainingBatch) -> list[float]:
    """Mean absolute height error [mm] on a batch after each iteration."""
    counts = range(1, run.config.n_iterations + 1)
    guesses = (run.predict(batch.photographs, count) for count in counts)
    return [round(float((1e3 * guess - batch.truth).abs().mean()), 4) for guess in guesses]


class Run(Trainer):
    """A training run on the measured mirrors of Juelich."""

    def __init__(self, config: TrainConfig, folder: Path, device: torch.device) -> None:
        surfaces, self.names = load_surfaces(Path(config.data))
        parts = config.parts(self.names)
        self.surfaces, self.validation = surfaces[parts.training], surfaces[parts.held_out]
        self.learnt = [self.names[i] for i in parts.training]
        self.field = load_field(Path(config.data))
        prior = estimate(self.surfaces)
        usual = float(np.abs(self.surfaces - prior.mean).mean()) * 1e3
        super().__init__(config, folder, device, prior, usual)

    @classmethod
    def open(cls, folder: Path) -> "Run":
        """Open a run from its folder, on the CPU."""
        return cls(TrainConfig.read(folder / "config.json"), folder, torch.device("cpu"))

    def batch(self) -> TrainingBatch:
        """Render photographs of the step's mirrors."""
        c = self.config
        rng = np.random.default_rng((c.seed, self.step, 0))
        z = c.augmentation.sample(self.surfaces, c.batch, rng)
        images = int(rng.integers(1, MAX_IMAGES + 1))
        with torch.no_grad():
            seen = render(
                z, images, self.field, c.scenes, c.camera, self.device, int(rng.integers(2**31))
            )
        return TrainingBatch.of(seen, z)

    def validate(self, repeats: int = 8) -> list[float]:
        """Mean absolute height error [mm] on validation mirrors after each iteration.

        Each mirror has eight clean images.
        """
        if not len(self.validation):
            return []
        z = self.validation.repeat(repeats, axis=0)
        seen = render(z, MAX_IMAGES, self.field, self.config.scenes, None, self.device, seed=0)
        return height_errors(self, TrainingBatch.of(seen, z))


def main() -> None:
    """Train, or resume, one run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", type=Path, help="JSON of TrainConfig; defaults without one")
    parser.add_argument("--run", type=Path, default=Path("runs/best"), help="folder of the run")
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="stop after so many minutes"
    )
    parser.add_argument(
        "--fold", type=int, help="which heliostats to keep back, for a cross-validation"
    )
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--device", help="a GPU where there is one, unless given")
    arguments = parser.parse_args()
    config = TrainConfig.read(arguments.config) if arguments.config else TrainConfig()
    if arguments.fold is not None:
        config = replace(config, fold=arguments.fold, folds=arguments.folds)
    device = arguments.device or ("cuda" if torch.cuda.is_available() else "cpu")
    Run(config, arguments.run, torch.device(device)).train(arguments.minutes)


if __name__ == "__main__":
    main()
