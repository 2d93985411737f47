"""Surface prediction by the shipped network, through onnxruntime."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from model.effects import Effect
from model.errors import InvalidInputError
from model.network.architecture import MAX_IMAGES
from model.network.inputs import GUESS_SAMPLES, conditions
from model.observation import Observation, SurfacePrediction, render_observations, scene_of
from model.plant import Heliostat
from model.refinement import default_prior, misfits
from model.surface import FACETS, control_points
from model.tracing import Optics

Array = NDArray[np.float64]

INPUTS = ("flux", "conditions", "mask", "guess_flux", "guess")
"""What one look takes, by the names of `SurfaceNetwork.forward`, with a batch of eight images each."""

LOOKS = 1
"""How often the network sees what a guess would throw, the mean surface and then its own.

It was trained for two looks, and the second one still does a little harm (RESULTS.md): its own guesses leave residuals
that it has not yet learnt to read.
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
        measured = np.array([o.flux for o in observations])
        inputs = {
            "flux": _filled(measured),
            "conditions": _filled(conditions(scene_of(heliostat, observations)).numpy()),
            "mask": _filled(np.ones(len(observations))),
        }
        z = default_prior().mean
        for _ in range(looks):
            traced = render_observations(heliostat, observations, z, optics, effects, samples=GUESS_SAMPLES)
            z, z_std = (
                values[0] for values in self.look({**inputs, "guess_flux": _filled(traced), "guess": z[None] * 1e3})
            )
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
        )


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
