"""Train the surface network: ``python -m training.train --config training/configs/best.json``.

Images are rendered as the training goes, so that no surface is seen twice under the same sun. Half of each batch starts
from the mean surface, half from what the network has just said of it. A run keeps everything in one folder: its config,
a checkpoint to resume from, its curve, and the weights of the exponential moving average.

On several GPUs, or CPU processes, which share every batch:
``torchrun --nproc-per-node 4 -m training.train --config training/configs/best.json --folder runs/best``.
"""

import argparse
import copy
import json
import math
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from model.network.architecture import MAX_IMAGES
from model.network.catalogue import build
from training import parallel
from training.config import TrainConfig
from training.prior import estimate
from training.render import Setups, load_field, render
from training.surfaces import load_surfaces, split_by_heliostat


def loss_terms(heights: Tensor, spread: Tensor, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean absolute height error [mm] and slope error [mm per control spacing], and the spread's neg. log-likelihood.

    The spread learns from the error but does not pull at the heights.
    """
    error = heights - truth
    slopes = error.diff(dim=-1).abs().mean() + error.diff(dim=-2).abs().mean()
    likelihood = (error.detach().abs() / spread + torch.log(spread)).mean()
    return error.abs().mean(), slopes, likelihood


class Run:
    """One training run in its folder."""

    def __init__(self, config: TrainConfig, folder: Path, device: torch.device) -> None:
        if config.batch % parallel.size():
            raise ValueError(f"batch {config.batch} cannot be shared evenly among {parallel.size()} processes")
        self.config, self.folder, self.device = config, folder, device
        surfaces, self.names = load_surfaces(Path(config.data))
        train, held_out = split_by_heliostat(len(surfaces), config.held_out, config.seed, config.fold)
        self.surfaces, self.held_out = surfaces[train], surfaces[held_out]
        self.held_out_names = [self.names[i] for i in held_out]
        self.field = load_field(Path(config.data))
        prior = estimate(self.surfaces)
        self.mean, self.basis = (
            torch.as_tensor(values, dtype=torch.float32, device=device) for values in (prior.mean, prior.basis)
        )
        torch.manual_seed(config.seed)
        network = build(config.architecture, config.network)
        self.network = network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, betas=(0.9, 0.98)
        )
        self.step = 0
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

    def start_from(self, checkpoint: Path) -> None:
        """Begin with the averaged weights of another run of the same network; a run that has begun goes on instead."""
        if self.step == 0:
            state = torch.load(checkpoint, map_location=self.device, weights_only=True)
            self.network.load_state_dict(state["average"])
            self.average.load_state_dict(state["average"])

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

    def look(self, network: nn.Module, flux: Tensor, setups: Setups, guess: Tensor) -> tuple[Tensor, Tensor]:
        """Heights and spread (B, 4, 8, 8) [mm] after one look at flux (B, M, 64, 64), from guesses (B, 4, 8, 8) [m]."""
        # Geometry does not bear sixteen bits: all of it stays outside of autocast.
        with torch.no_grad():
            guess_flux, conditions = setups.trace(guess), setups.conditions()
            descent = setups.descents(guess, flux, self.basis)
        mask = torch.ones(flux.shape[:2], device=self.device)
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.config.bfloat16 and network.training):
            heights, spread = network(flux, conditions, mask, guess_flux, guess * 1e3, descent * 1e3)
        return heights.float(), spread.float()

    @torch.no_grad()
    def predict(self, flux: Tensor, setups: Setups, looks: int | None = None) -> Tensor:
        """Surfaces (B, 4, 8, 8) [m] that the averaged network sees in flux (B, M, 64, 64) after all its looks."""
        guess = self.mean.expand(len(flux), -1, -1, -1)
        for _ in range(self.config.looks if looks is None else looks):
            guess = self.look(self.average.eval(), flux, setups, guess)[0] * 1e-3
        return guess

    def _guesses(self, flux: Tensor, setups: Setups) -> Tensor:
        """Guesses (B, 4, 8, 8) [m]: the mean surface, and for an equal share of the batch the later looks' guesses."""
        guess = self.mean.expand(len(flux), -1, -1, -1).clone()
        for look in range(1, self.config.looks):
            rows = slice(0, len(flux) * (self.config.looks - look) // self.config.looks)
            with torch.no_grad():
                guess[rows] = self.look(self.network, flux[rows], setups[rows], guess[rows])[0] * 1e-3
        return guess

    def train_step(self) -> float:
        """Render a batch, descend once, return the height error [mm]."""
        c = self.config
        rng = np.random.default_rng((c.seed, self.step, parallel.rank()))
        z = c.augmentation.sample(self.surfaces, c.batch // parallel.size(), rng)
        images = int(rng.integers(1, MAX_IMAGES + 1))
        with torch.no_grad():
            flux, setups = render(z, images, self.field, c.situations, c.camera, self.device, int(rng.integers(2**31)))
        truth = torch.as_tensor(z * 1e3, dtype=torch.float32, device=self.device)
        truth = truth - truth.mean(dim=(2, 3), keepdim=True)
        heights, spread = self.look(self.network.train(), flux, setups, self._guesses(flux, setups))
        error, slopes, likelihood = loss_terms(heights, spread, truth)
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
        self.step += 1
        return float(error.detach())

    def _update_average(self) -> None:
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for mean, current in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(current, 1 - decay)

    def validate(self, repeats: int = 8) -> list[float]:
        """Mean absolute height error [mm] on held-out heliostats, eight clean images each, after each look."""
        z = self.held_out.repeat(repeats, axis=0)
        flux, setups = render(z, MAX_IMAGES, self.field, self.config.situations, None, self.device, seed=0)
        truth = torch.as_tensor(z, dtype=torch.float32, device=self.device)
        truth = truth - truth.mean(dim=(2, 3), keepdim=True)
        guesses = [self.predict(flux, setups, looks) for looks in range(1, self.config.looks + 1)]
        return [round(float((guess - truth).abs().mean()) * 1e3, 4) for guess in guesses]

    def train(self, minutes: float, every: int = 250) -> None:
        """Train to the last step, or until the time is up."""
        end = time.monotonic() + 60 * minutes
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
        line = {"step": self.step, "train_mae_mm": round(error, 4), "held_out_mae_mm": self.validate()}
        with (self.folder / "curve.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)


def main() -> None:
    """Train, or resume, one run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", type=Path, help="JSON of TrainConfig; defaults without one")
    # torchrun takes "--run" for a beginning of its own "--run-path", wherever it stands.
    parser.add_argument("--run", "--folder", type=Path, default=Path("runs/best"), help="folder of the run")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so many minutes")
    parser.add_argument("--fold", type=int, help="which heliostats to keep back, for a cross-validation")
    parser.add_argument("--start", type=Path, help="checkpoint of another run, whose weights to begin with")
    parser.add_argument("--device", help="a GPU where there is one, unless given")
    arguments = parser.parse_args()
    config = TrainConfig.read(arguments.config) if arguments.config else TrainConfig()
    if arguments.fold is not None:
        config = replace(config, fold=arguments.fold)
    with parallel.team(arguments.device) as device:
        run = Run(config, arguments.run, device)
        if arguments.start is not None:
            run.start_from(arguments.start)
        run.train(arguments.minutes)


if __name__ == "__main__":
    main()
