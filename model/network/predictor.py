"""Surface prediction by the shipped network, through onnxruntime."""

import hashlib
import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.network.architecture import CONDITIONS, IMAGE_SIZE, MAX_IMAGES
from model.network.inputs import conditions
from model.observation import Observation, SurfacePrediction, scene_of
from model.plant import Heliostat
from model.refinement import misfit
from model.surface import FACETS, control_points

Array = NDArray[np.float64]

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

    def run(self, flux: NDArray[Any], image_conditions: NDArray[Any], mask: NDArray[Any]) -> tuple[Array, Array]:
        """Heights and their standard deviation, each (B, 4, 8, 8) [m].

        ``flux`` is (B, 8, 64, 64), ``image_conditions`` (B, 8, 12), ``mask`` (B, 8), one where there is an image.
        """
        inputs = {"flux": flux, "conditions": image_conditions, "mask": mask}
        heights, spread = self.session.run(None, {k: v.astype(np.float32) for k, v in inputs.items()})
        # The spread is the scale of a Laplace distribution, whose standard deviation is sqrt(2) of it.
        return heights.astype(np.float64) * 1e-3, spread.astype(np.float64) * 1e-3 * np.sqrt(2)

    def predict(self, heliostat: Heliostat, observations: Sequence[Observation]) -> SurfacePrediction:
        """The surface of a heliostat from one to eight of its images.

        Raises
        ------
        InvalidInputError
            Without images, with more than eight, or for a heliostat that does not have four facets.
        """
        if not 1 <= len(observations) <= MAX_IMAGES:
            raise InvalidInputError(f"a prediction takes 1 to {MAX_IMAGES} images, got {len(observations)}")
        if len(heliostat.facets) != FACETS:
            raise InvalidInputError(f"the network knows mirrors of {FACETS} facets, {heliostat.name} has other")
        count = len(observations)
        flux = np.zeros((1, MAX_IMAGES, IMAGE_SIZE, IMAGE_SIZE), dtype=np.float32)
        geometry = np.zeros((1, MAX_IMAGES, CONDITIONS), dtype=np.float32)
        mask = np.zeros((1, MAX_IMAGES), dtype=np.float32)
        flux[0, :count] = [o.flux for o in observations]
        geometry[0, :count] = conditions(scene_of(heliostat, observations)).numpy()
        mask[0, :count] = 1
        z, z_std = (values[0] for values in self.run(flux, geometry, mask))
        return SurfacePrediction(
            z=z,
            z_std=z_std,
            control_points=control_points(heliostat, z),
            method="network",
            weights=self.name,
            misfit=misfit(heliostat, observations, z),
            used=tuple(o.identifier for o in observations),
        )


@lru_cache(maxsize=1)
def default_predictor() -> SurfacePredictor:
    """The predictor of the shipped weights, loaded once."""
    return SurfacePredictor()


def model_card() -> dict[str, Any]:
    """What the shipped network was trained on and how well it does."""
    card: dict[str, Any] = json.loads(WEIGHTS.with_suffix(".json").read_text(encoding="utf-8"))
    return card
