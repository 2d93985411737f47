"""Surface prediction by a network, through onnxruntime: the shipped one or that of a type."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model import prediction_warnings
from model.checksums import read_verified
from model.errors import InvalidInputError
from model.forecast import Aligned
from model.images import COARSE_SIZE, FLUX_SIZE
from model.mirror_kind import MirrorKind, mirror_order
from model.network.architecture import MAX_IMAGES
from model.network.inputs import (
    GUESS_SAMPLES,
    MIRRORED_CONDITIONS,
    STEP_SAMPLES,
    conditions,
    conjugate_gradient_steps,
)
from model.observation import (
    Observation,
    Saturation,
    SurfacePrediction,
    align_observations,
    common_side,
    misfits,
)
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.prior import SurfacePrior, default_prior
from model.surface import control_points, mirrored

Array = NDArray[np.float64]

INPUTS = ("flux", "conditions", "mask", "guess_flux", "guess", "descent")
"""Inputs of one iteration, as in `SurfaceNetwork.forward`, with eight images each."""

N_ITERATIONS = 3
"""Number of iterations: from the mean surface first, then from the network's previous answer.

It was trained for two. The third reduces the error a little more; the last is made twice
(`mirrored_inputs`).
"""

WEIGHTS = Path(__file__).parents[1] / "weights" / "surface-network.onnx"


class HeightEstimate(NamedTuple):
    """Heights (..., F, 8, 8) [m] and their standard deviation."""

    z: Array
    z_std: Array


class SurfacePredictor:
    """The surface network of one ONNX file.

    Attributes
    ----------
    name : str
        File name and the first twelve digits of its SHA-256: which weights made a prediction.
    kind : MirrorKind
        The mirrors that it was trained for; by default those of Juelich.
    prior : SurfacePrior
        Its mean is the first guess.
    """

    def __init__(
        self,
        path: Path = WEIGHTS,
        threads: int = 1,
        read: Callable[[Path], bytes] = Path.read_bytes,
        *,
        kind: MirrorKind | None = None,
        prior: SurfacePrior | None = None,
    ) -> None:
        self.kind, self.prior = kind or juelich_kind(), prior or default_prior()
        # onnxruntime reads this when it is loaded. Its disable_telemetry_events() is too late: by
        # then it has written an id into the home folder and looked up the maker's host.
        os.environ["ORT_DISABLE_TELEMETRY"] = "1"
        import onnxruntime

        content = read(path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = threads
        self.session = onnxruntime.InferenceSession(
            content, options, providers=["CPUExecutionProvider"]
        )
        self.name = f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"

    def iterate(self, inputs: Mapping[str, NDArray[Any]]) -> HeightEstimate:
        """Heights (B, F, 8, 8) after one iteration."""
        heights, spread = self.session.run(
            None, {name: inputs[name].astype(np.float32) for name in INPUTS}
        )
        # The spread is the scale of a Laplace distribution: its deviation is sqrt(2) of that.
        z_std = spread.astype(np.float64) * 1e-3 * np.sqrt(2)
        return HeightEstimate(heights.astype(np.float64) * 1e-3, z_std)

    def heights(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        model: PlantModel,
        *,
        n_iterations: int = N_ITERATIONS,
    ) -> HeightEstimate:
        """Heights (F, 8, 8) from one to eight images; see `predict`."""
        if not 1 <= len(observations) <= MAX_IMAGES:
            raise InvalidInputError(
                f"a prediction takes 1 to {MAX_IMAGES} images, got {len(observations)}"
            )
        n_facets = len(self.kind.centers)
        if len(heliostat.facets) != n_facets:
            raise InvalidInputError(
                f"the network predicts mirrors of {n_facets} facets, {heliostat.name} has"
                f" {len(heliostat.facets)}; use the method refined"
            )
        network_inputs = _NetworkInputs(heliostat, observations, model, self.prior)
        z = self.prior.mean
        inputs = network_inputs.inputs(z)
        for _ in range(n_iterations - 1):
            z = self.iterate(inputs).z[0]
            inputs = network_inputs.inputs(z)
        order = mirror_order(heliostat)
        if order is None:
            return HeightEstimate(*(values[0] for values in self.iterate(inputs)))
        swapped = mirrored_inputs(inputs, order)
        both = self.iterate(
            {name: np.concatenate([inputs[name], swapped[name]]) for name in INPUTS}
        )
        return HeightEstimate(*((values[0] + mirrored(values[1], order)) / 2 for values in both))

    def predict(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        model: PlantModel,
        *,
        n_iterations: int = N_ITERATIONS,
    ) -> SurfacePrediction:
        """The surface of a heliostat from one to eight of its images.

        Raises
        ------
        InvalidInputError
            Without images, with more than eight, or for a heliostat with another number of facets.
        """
        z, z_std = self.heights(heliostat, observations, model, n_iterations=n_iterations)
        return SurfacePrediction(
            z=z,
            z_std=z_std,
            control_points=control_points(heliostat, z),
            method="network",
            weights=self.name,
            misfits=misfits(heliostat, observations, z, model),
            used=tuple(o.identifier for o in observations),
            mahalanobis_distance=self.prior.mahalanobis(z),
            warnings=(
                *prediction_warnings.geometry_warnings(heliostat, observations),
                *prediction_warnings.network_warnings(heliostat, observations, self.kind),
                *prediction_warnings.canting_warnings(self.prior, z),
            ),
        )


@lru_cache(maxsize=1)
def juelich_kind() -> MirrorKind:
    """The mirrors of Juelich, which the shipped network was trained for."""
    return MirrorKind.of(Heliostat.juelich("juelich", (0.0, 100.0, 0.0), 100.0), name="juelich")


class _NetworkInputs:
    """Computes the inputs of each iteration for M observations of a heliostat."""

    def __init__(
        self,
        heliostat: Heliostat,
        observations: Sequence[Observation],
        model: PlantModel,
        prior: SurfacePrior,
    ) -> None:
        self.heliostat, self.observations, self.model = heliostat, observations, model
        self.flux = torch.as_tensor(np.array([o.flux for o in observations]), dtype=torch.float32)
        self.ideal = torch.as_tensor(control_points(heliostat), dtype=torch.float32).movedim(-1, -3)
        self.normals = torch.as_tensor(heliostat.facet_normals, dtype=torch.float32)
        self.basis = torch.as_tensor(prior.basis, dtype=torch.float32)
        self.saturation = {
            size: Saturation(observations, size) for size in (FLUX_SIZE, COARSE_SIZE)
        }
        self.side = common_side(observations)
        self.aligned: Aligned | None = None

    def inputs(self, z: Array) -> dict[str, NDArray[Any]]:
        """Return `INPUTS` for the current surface (F, 8, 8) [m]."""
        # The previous surface is similar, so that its alignment is a good start.
        aligned = align_observations(self.heliostat, self.observations, z, self.model, self.aligned)
        self.aligned = aligned
        with torch.no_grad():
            guess_flux = self._images(aligned, FLUX_SIZE, GUESS_SAMPLES)
        descent = conjugate_gradient_steps(
            partial(self._changed, aligned), self.flux[None], self.basis, self.side
        )[0]
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
        images = aligned.flux_images(size=size, side=self.side, samples=samples)
        return self.saturation[size].apply(images)

    def _changed(self, aligned: Aligned, changes: Tensor) -> Tensor:
        """Images (1, M, R, R), sum 100, of mirrors deformed by heights (1, M, F, 8, 8) [m]."""
        deformed = aligned.deformed(torch.einsum("mfij,fk->mfkij", changes[0], self.normals))
        return self._images(deformed, COARSE_SIZE, STEP_SAMPLES)[None]

    def _conditions(self, aligned: Aligned) -> Tensor:
        """`conditions` (M, 12) of the ideal mirror as the guess is aligned, as in training."""
        scene = aligned.groups[0].scene
        return conditions(
            scene.with_(control_points=self.ideal.expand_as(scene.control_points)), self.side
        )


def mirrored_inputs(
    inputs: Mapping[str, NDArray[Any]], order: Sequence[int]
) -> dict[str, NDArray[Any]]:
    """`INPUTS` with left and right exchanged, and facets in the ``order`` of `mirror_order`.

    Physics is symmetric, the network not quite: the mean of both predictions has smaller errors.
    """
    return {
        "flux": inputs["flux"][..., ::-1],
        "conditions": inputs["conditions"] * np.array(MIRRORED_CONDITIONS, dtype=np.float32),
        "mask": inputs["mask"],
        "guess_flux": inputs["guess_flux"][..., ::-1],
        "guess": mirrored(inputs["guess"], order),
        "descent": mirrored(inputs["descent"], order),
    }


def _filled(values: NDArray[Any]) -> NDArray[np.float32]:
    """One heliostat's values (M, ...) as (1, 8, ...), zero for the images that are missing."""
    padded = np.zeros((1, MAX_IMAGES, *values.shape[1:]), dtype=np.float32)
    padded[0, : len(values)] = values
    return padded


@lru_cache(maxsize=1)
def default_predictor() -> SurfacePredictor:
    """The predictor of the shipped weights, loaded once; `WeightsError` if they differ."""
    return SurfacePredictor(read=read_verified)


def model_card() -> dict[str, Any]:
    """What the shipped network was trained on and how well it does."""
    card: dict[str, Any] = json.loads(WEIGHTS.with_suffix(".json").read_text(encoding="utf-8"))
    return card
