"""Surface prediction by the shipped network, through onnxruntime."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.effects import Effect
from model.errors import InvalidInputError
from model.forecast import Aligned, View
from model.network.architecture import MAX_IMAGES
from model.network.inputs import (
    DESCENT_SAMPLES,
    DESCENT_SIZE,
    GUESS_SAMPLES,
    MIRRORED_CONDITIONS,
    conditions,
    descents,
)
from model.observation import (
    FLUX_SHAPE,
    FLUX_WINDOW,
    Observation,
    SurfacePrediction,
    align_observations,
)
from model.plant import Heliostat
from model.refinement import default_prior, misfits
from model.surface import FACETS, control_points, mirrored
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
        # A plant's computer reports to nobody.
        onnxruntime.disable_telemetry_events()
        content = path.read_bytes()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
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
        looks: int = LOOKS,
    ) -> tuple[Array, Array]:
        """Heights and their standard deviation, each (4, 8, 8) [m], from one to eight images; see `predict`."""
        if not 1 <= len(observations) <= MAX_IMAGES:
            raise InvalidInputError(f"a prediction takes 1 to {MAX_IMAGES} images, got {len(observations)}")
        if len(heliostat.facets) != FACETS:
            raise InvalidInputError(f"the network knows mirrors of {FACETS} facets, {heliostat.name} has other")
        z, guess = default_prior().mean, None
        for left in reversed(range(looks)):
            guess = _Guess.of(heliostat, observations, z, effects, None if guess is None else guess.aligned)
            inputs = guess.inputs(optics, effects)
            if left:
                z = self.look(inputs)[0][0]
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
        looks: int = LOOKS,
    ) -> SurfacePrediction:
        """The surface of a heliostat from one to eight of its images, as a model with these optics and effects sees it.

        Raises
        ------
        InvalidInputError
            Without images, with more than eight, or for a heliostat that does not have four facets.
        """
        z, z_std = self.heights(heliostat, observations, optics, effects, looks=looks)
        return SurfacePrediction(
            z=z,
            z_std=z_std,
            control_points=control_points(heliostat, z),
            method="network",
            weights=self.name,
            misfits=misfits(heliostat, observations, z, optics, effects),
            used=tuple(o.identifier for o in observations),
            strangeness=default_prior().strangeness(z),
        )


@dataclass(frozen=True, eq=False)
class _Guess:
    """A guessed surface (4, 8, 8) [m] of a heliostat, which stands as it must for its M observations."""

    heliostat: Heliostat
    observations: Sequence[Observation]
    z: Array
    aligned: Aligned

    @classmethod
    def of(
        cls,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        z: Array,
        effects: Sequence[Effect],
        start: Aligned | None,
    ) -> "_Guess":
        """A guess under effects on sun, mount and mirror; ``start`` is that of another guess and saves rounds."""
        return cls(heliostat, observations, z, align_observations(heliostat, observations, z, effects, start=start))

    def inputs(self, optics: Optics | None, effects: Sequence[Effect]) -> dict[str, NDArray[Any]]:
        """`INPUTS` of one look under a model with these optics and effects."""
        ideal = control_points(self.heliostat)
        normal = torch.as_tensor(control_points(self.heliostat, np.ones_like(self.z)) - ideal, dtype=torch.float32)
        flux = np.array([o.flux for o in self.observations])

        def trace(changes: Tensor) -> Tensor:
            """Images (1, M, R, R), sum 100, of the guess changed by heights (1, M, 4, 8, 8) [m]."""
            raised = torch.einsum("mfij,fijk->mfkij", changes[0], normal)
            view = View(DESCENT_SIZE, DESCENT_SIZE, window=FLUX_WINDOW, samples=DESCENT_SAMPLES)
            return _normalized(self.aligned.raised(raised).images(optics, effects, view))[None]

        with torch.no_grad():
            view = View(*FLUX_SHAPE, window=FLUX_WINDOW, samples=GUESS_SAMPLES)
            guess_flux = _normalized(self.aligned.images(optics, effects, view)).numpy()
        basis = torch.as_tensor(default_prior().basis, dtype=torch.float32)
        descent = descents(trace, torch.as_tensor(flux[None], dtype=torch.float32), basis)[0].numpy()
        # What is told of the geometry is that of the ideal mirror, as in training.
        scene = self.aligned.groups[0].scene
        points = torch.as_tensor(ideal, dtype=torch.float32).movedim(-1, -3).expand_as(scene.control_points)
        return {
            "flux": _filled(flux),
            "conditions": _filled(conditions(scene.with_(control_points=points)).numpy()),
            "mask": _filled(np.ones(len(flux))),
            "guess_flux": _filled(guess_flux),
            "guess": self.z[None] * 1e3,
            "descent": _filled(descent * 1e3),
        }


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


def _normalized(images: Tensor) -> Tensor:
    """Images (M, R, R) scaled to a sum of 100."""
    return 100 * images / images.sum(dim=(1, 2), keepdim=True)


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
