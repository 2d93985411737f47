"""A network for the heliostats of one type: scenes, training and its files.

Mirrors are drawn from the type's prior. They stand where the plant's heliostats of the type stand,
and shine on the plant's targets. `heliotwin.networks` reads these from ``plant.yaml``. The files
are those of `model.network.networks`.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from model.checksums import digests
from model.errors import InvalidInputError
from model.metrics import spot_window
from model.mirror_kind import MirrorKind
from model.network.architecture import MAX_IMAGES
from model.network.networks import prior_path
from model.plant import Heliostat, TargetPlane
from model.prior import SurfacePrior, draw_surfaces
from model.setup import Setup
from model.site import Site
from model.surface import control_points
from model.tracing import Optics
from training.config import TrainConfig
from training.export import export_checked
from training.render import RealCamera, Setups, draw_suns, take
from training.train import Trainer, TrainingBatch, height_errors
from training.type_prior import type_prior

Array = NDArray[np.float64]

MIN_ELEVATION_DEG = 12.0
"""Smallest elevation of drawn suns."""

MIN_COSINE = 0.3
"""Smallest cosine of incidence of drawn scenes, and of the light on the target."""

MAX_VALIDATED = 32
"""Largest number of drawn mirrors that the network is judged by: those of two batches at most."""


class Place(NamedTuple):
    """A heliostat, and a target that it can shine on."""

    heliostat: Heliostat
    target: TargetPlane


@dataclass(frozen=True, eq=False)
class TypeScenes:
    """Where photographs of one type of heliostats are taken.

    Attributes
    ----------
    name : str
        Of the type.
    heliostats : sequence of Heliostat
        All of the type, canted and focused as the plant says.
    targets : sequence of TargetPlane
    site : Site
    optics : Optics
        Sun and air.
    measured : (N, F, 8, 8) [m]
        Measured mirrors of the type, none or more.
    """

    name: str
    heliostats: Sequence[Heliostat]
    targets: Sequence[TargetPlane]
    site: Site
    optics: Optics
    measured: Array

    @cached_property
    def places(self) -> dict[float, list[Place]]:
        """Heliostats and targets by the width of their flux images [m].

        Raises
        ------
        InvalidInputError
            If no heliostat of the type can shine on a target.
        """
        found: dict[float, list[Place]] = {}
        for heliostat in self.heliostats:
            for target in self.targets:
                beam = target.center - heliostat.position
                distance = float(np.linalg.norm(beam))
                if -(beam @ target.normal) >= MIN_COSINE * distance:
                    side = spot_window(heliostat, distance)
                    found.setdefault(side, []).append(Place(heliostat, target))
        if not found:
            raise InvalidInputError(
                f"targets: no heliostat of type {self.name} can shine on one of them; add a target"
                " that faces them"
            )
        return found

    @cached_property
    def kind(self) -> MirrorKind:
        """The mirrors that the network is for."""
        return MirrorKind.of(self.heliostats[0], tuple(sorted(self.places)), self.name)

    @cached_property
    def prior(self) -> SurfacePrior:
        """The prior that mirrors are drawn from."""
        return type_prior(self.heliostats[0], self.measured)

    def draw(self, count: int, images: int, rng: np.random.Generator) -> Setups:
        """Draw ``count`` heliostats with images of one width, and as many suns for each image."""
        counts = np.array([len(places) for places in self.places.values()])
        sides = list(self.places)
        side = sides[int(rng.choice(len(sides), p=counts / counts.sum()))]
        places = self.places[side]
        chosen = [places[int(i)] for i in rng.integers(len(places), size=count)]
        setups = [
            Setup(place.heliostat, control_points(place.heliostat), sun, place.target)
            for place in chosen
            for sun in self._suns(place, images, rng)
        ]
        return Setups.placed(setups, images, side, self.optics)

    def _suns(self, place: Place, count: int, rng: np.random.Generator) -> Array:
        """Suns (count, 3) that a heliostat can reflect to a target."""
        beam = place.target.center - place.heliostat.position
        beam = beam / np.linalg.norm(beam)
        found = np.empty((0, 3))
        while len(found) < count:
            suns = draw_suns(4 * count, self.site, MIN_ELEVATION_DEG, rng)
            cosines = np.sqrt((1 + suns @ beam) / 2)
            found = np.concatenate([found, suns[cosines >= MIN_COSINE]])
        return found[:count]


class TypeRun(Trainer):
    """A training run for one type of heliostats."""

    def __init__(
        self, scenes: TypeScenes, config: TrainConfig, folder: Path, device: torch.device
    ) -> None:
        self.scenes, prior = scenes, scenes.prior
        drawn = draw_surfaces(prior, 64, np.random.default_rng(0))
        usual = 1e3 * float(np.abs(drawn - prior.mean).mean())
        super().__init__(config, folder, device, prior, usual, scale=usual)

    def batch(self) -> TrainingBatch:
        """Render photographs of the step's mirrors."""
        c = self.config
        rng = np.random.default_rng((c.seed, self.step, 1))
        return self._rendered(c.batch, int(rng.integers(1, MAX_IMAGES + 1)), c.camera, rng)

    def validate(self) -> list[float]:
        """Mean absolute height error [mm] on `validation` after each iteration."""
        return height_errors(self, self.validation)

    @cached_property
    def validation(self) -> TrainingBatch:
        """Drawn mirrors with eight clean images."""
        count = min(MAX_VALIDATED, 2 * self.config.batch)
        return self._rendered(count, MAX_IMAGES, None, np.random.default_rng(0))

    def _rendered(
        self, count: int, images: int, camera: RealCamera | None, rng: np.random.Generator
    ) -> TrainingBatch:
        z = draw_surfaces(self.scenes.prior, count, rng)
        with torch.no_grad():
            setups = self.scenes.draw(count, images, rng)
            return TrainingBatch.of(take(setups, z, camera, rng), z)


def write_network(run: TypeRun, out: Path) -> dict[str, Any]:
    """Write ``out/NAME.onnx``, its prior and its model card; return the card.

    The card is written last, so that a network without one is not complete.
    """
    out.mkdir(parents=True, exist_ok=True)
    scenes, path = run.scenes, out / f"{run.scenes.name}.onnx"
    path.with_suffix(".json").unlink(missing_ok=True)
    difference = export_checked(run.average, path)
    prior = scenes.prior
    arrays = {
        name: getattr(prior, name).astype(np.float32)
        for name in ("mean", "basis", "hidden", "fine")
    }
    if prior.shapes is not None:
        arrays["shapes"] = prior.shapes.astype(np.float32)
    np.savez_compressed(prior_path(path), **arrays)
    card = {
        "name": path.stem,
        **digests(path),
        "prior": digests(prior_path(path)),
        "task": "mirror surface from 1 to 8 flux images of one heliostat of the type",
        "mirrors": scenes.kind.to_json(),
        "parameters": sum(p.numel() for p in run.average.parameters()),
        "trained_on": {
            "surfaces": (
                f"drawn from a prior estimated from {len(scenes.measured)} measured mirrors"
                if len(scenes.measured)
                else "drawn from the type's prior by its declared errors"
            ),
            "images": "convolution-traced flux with random cameras, suns of the year, the layout",
            "steps": run.step,
            "samples": run.step * run.config.batch,
            "commit": run.commit,
        },
        "config": asdict(run.config),
        "onnx_parity_mm": difference,
        "evaluation": evaluation(run),
    }
    path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
    return card


def evaluation(run: TypeRun) -> dict[str, Any]:
    """Mean absolute errors [mm] on drawn mirrors: of the prior's mean, and of the network."""
    error = (run.validation.truth - 1e3 * run.mean).abs().mean()
    return {
        "mirrors": len(run.validation.truth),
        "mean_surface_mae_mm": round(float(error), 4),
        "network_mae_mm": (run.validation_errors or run.validate())[-1],
    }
