"""Surface prediction by the shipped network, through onnxruntime."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model import doubts
from model.effects import Effect
from model.errors import InvalidInputError
from model.forecast import Aligned
from model.images import COARSE_SIZE, FLUX_SIZE
from model.network.architecture import MAX_IMAGES
from model.network.inputs import (
    DESCENT_SAMPLES,
    GUESS_SAMPLES,
    MIRRORED_CONDITIONS,
    conditions,
    descents,
)
from model.observation import Observation, Ranges, SurfacePrediction, align_observations, common_side, misfits
from model.plant import Heliostat
from model.prior import default_prior
from model.surface import control_points, mirrored, require_own_grid
from model.tracing import Optics

Array = NDArray[np.float64]

INPUTS = ("flux", "conditions", "mask", "guess_flux", "guess", "descent")
"""What one look takes, by the names of `SurfaceNetwork.forward`, with a batch of eight images each."""

LOOKS = 3
"""How often the network sees what a guess would throw: the mean surface first, then its own answers.

It was trained for two looks; the third still gains a little, with the last one taken twice (`mirrored_inputs`).
"""

WEIGHTS = Path(__file__).parents[1] / "weights" / "surface-network.onnx"


class SurfacePredictor:
    """The surface network of one ONNX file.

    Attributes
    ----------
    name : str
        File name and the first twelve digits of its SHA-256: which weights made a prediction.
    """

    def __init__(self, path: Path = WEIGHTS, threads: int = 1) -> None:
        # A plant's computer reports to nobody. onnxruntime asks this when it is loaded; its disable_telemetry_events()
        # comes too late: by then an id lies in the home folder, and the maker's host is looked up all the same.
        os.environ["ORT_DISABLE_TELEMETRY"] = "1"
        import onnxruntime

        content = path.read_bytes()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        self.session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        self.name = f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"

    def look(self, inputs: Mapping[str, NDArray[Any]]) -> tuple[Array, Array]:
        """Heights and their standard deviation, each (B, 4, 8, 8) [m], after one look at `INPUTS`."""
        heights, spread = self.session.run(None, {name: inputs[name].astype(np.float32) for name in INPUTS})
        # The spread is the scale of a Laplace distribution, whose standard deviation is sqrt(2) of it.
        return heights.astype(np.float64) * 1e-3, spread.astype(np.float64) * 1e-3 * np.sqrt(2)

    def heights(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        *,
        latitude_deg: float,
        looks: int = LOOKS,
    ) -> tuple[Array, Array]:
        """Heights and their standard deviation, each (4, 8, 8) [m], from one to eight images; see `predict`."""
        if not 1 <= len(observations) <= MAX_IMAGES:
            raise InvalidInputError(f"a prediction takes 1 to {MAX_IMAGES} images, got {len(observations)}")
        require_own_grid(heliostat)
        network_inputs = _NetworkInputs(heliostat, observations, optics, effects, latitude_deg)
        z = default_prior().mean
        inputs = network_inputs.inputs(z)
        for _ in range(looks - 1):
            z = self.look(inputs)[0][0]
            inputs = network_inputs.inputs(z)
        swapped = mirrored_inputs(inputs)
        both = self.look({name: np.concatenate([inputs[name], swapped[name]]) for name in INPUTS})
        z, z_std = ((values[0] + mirrored(values[1])) / 2 for values in both)
        return z, z_std

    def predict(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        optics: Optics | None = None,
        effects: Sequence[Effect] = (),
        *,
        latitude_deg: float,
        looks: int = LOOKS,
    ) -> SurfacePrediction:
        """The surface of a heliostat from one to eight of its images, as a model with these optics and effects sees it.

        ``latitude_deg`` [deg] is the plant's.

        Raises
        ------
        InvalidInputError
            Without images, with more than eight, or for a heliostat that does not have four facets.
        """
        z, z_std = self.heights(heliostat, observations, optics, effects, latitude_deg=latitude_deg, looks=looks)
        return SurfacePrediction(
            z=z,
            z_std=z_std,
            control_points=control_points(heliostat, z),
            method="network",
            weights=self.name,
            misfits=misfits(heliostat, observations, z, optics, effects, latitude_deg=latitude_deg),
            used=tuple(o.identifier for o in observations),
            mahalanobis=default_prior().mahalanobis(z),
            doubts=(
                *doubts.of_the_situation(heliostat, observations),
                *doubts.of_the_network(heliostat, observations),
                *doubts.of_canting(default_prior(), z),
            ),
        )


class _NetworkInputs:
    """What the network is shown of a heliostat's M observations under optics and effects, guess after guess."""

    def __init__(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        optics: Optics | None,
        effects: Sequence[Effect],
        latitude_deg: float,
    ) -> None:
        self.heliostat, self.observations, self.optics, self.effects = heliostat, observations, optics, effects
        self.latitude_deg = latitude_deg
        self.flux = torch.as_tensor(np.array([o.flux for o in observations]), dtype=torch.float32)
        self.ideal = torch.as_tensor(control_points(heliostat), dtype=torch.float32).movedim(-1, -3)
        self.normals = torch.as_tensor(heliostat.facet_normals, dtype=torch.float32)
        self.basis = torch.as_tensor(default_prior().basis, dtype=torch.float32)
        self.ranges = {size: Ranges(observations, size) for size in (FLUX_SIZE, COARSE_SIZE)}
        self.side = common_side(observations)
        self.aligned: Aligned | None = None

    def inputs(self, z: Array) -> dict[str, NDArray[Any]]:
        """`INPUTS` of a look at a guessed surface (4, 8, 8) [m]."""
        # The guess before differs little, and from its alignment few rounds are left.
        aligned = align_observations(
            self.heliostat, self.observations, z, self.effects, latitude_deg=self.latitude_deg, start=self.aligned
        )
        self.aligned = aligned
        with torch.no_grad():
            guess_flux = self._images(aligned, FLUX_SIZE, GUESS_SAMPLES)
        descent = descents(partial(self._changed, aligned), self.flux[None], self.basis, self.side)[0]
        return {
            "flux": _filled(self.flux.numpy()),
            "conditions": _filled(self._conditions(aligned).numpy()),
            "mask": _filled(np.ones(len(self.flux))),
            "guess_flux": _filled(guess_flux.numpy()),
            "guess": z[None] * 1e3,
            "descent": _filled(descent.numpy() * 1e3),
        }

    def _images(self, aligned: Aligned, size: int, samples: int) -> Tensor:
        """Images (M, size, size), sum 100, of aligned mirrors, as the cameras show them."""
        images = aligned.flux_images(self.optics, self.effects, size=size, side=self.side, samples=samples)
        return self.ranges[size].seen(images)

    def _changed(self, aligned: Aligned, changes: Tensor) -> Tensor:
        """Images (1, M, R, R), sum 100, of aligned mirrors, deformed by heights (1, M, 4, 8, 8) [m]."""
        deformed = aligned.deformed(torch.einsum("mfij,fk->mfkij", changes[0], self.normals))
        return self._images(deformed, COARSE_SIZE, DESCENT_SAMPLES)[None]

    def _conditions(self, aligned: Aligned) -> Tensor:
        """`conditions` (M, 12) of the ideal mirror as the guess is aligned, as in training."""
        scene = aligned.groups[0].scene
        return conditions(scene.with_(control_points=self.ideal.expand_as(scene.control_points)), self.side)


def mirrored_inputs(inputs: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """`INPUTS` of the mirrored world, left and right exchanged.

    Physics makes no difference between it and ours, a network does a little: the mean of its answers to both errs less.
    """
    return {
        "flux": inputs["flux"][..., ::-1],
        "conditions": inputs["conditions"] * np.array(MIRRORED_CONDITIONS, dtype=np.float32),
        "mask": inputs["mask"],
        "guess_flux": inputs["guess_flux"][..., ::-1],
        "guess": mirrored(inputs["guess"]),
        "descent": mirrored(inputs["descent"]),
    }


def _filled(values: NDArray[Any]) -> NDArray[np.float32]:
    """One heliostat's values (M, ...) as (1, 8, ...), zero for the images that are missing."""
    padded = np.zeros((1, MAX_IMAGES, *values.shape[1:]), dtype=np.float32)
    padded[0, : len(values)] = values
    return padded


@lru_cache(maxsize=1)
def default_predictor() -> SurfacePredictor:
    """The predictor of the shipped weights, loaded once."""
    return SurfacePredictor()


def model_card() -> dict[str, Any]:
    """What the shipped network was trained on and how well it does."""
    card: dict[str, Any] = json.loads(WEIGHTS.with_suffix(".json").read_text(encoding="utf-8"))
    return card
