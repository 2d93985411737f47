"""Whether images without background are light, or differences of sRGB counts, by what they show.

No file says it: PAINT publishes differences of counts, a simulation writes light in the same
layout. Images of known mirrors are forecast with either camera, and compared in the counts that are
stored. In linear light a wrong camera would change the images that are to judge it.

Surfaces that were measured without photographs judge best. A surface that was predicted from the
images is bent to explain a wrong camera, too. Therefore each camera has a separate prediction, and
the gain is a third of that by measured surfaces.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from model.images import FLUX_SIZE, normalized
from model.imaging.light import Camera, Power
from model.imaging.window import center_of_mass, flux_window
from model.metrics import flux_accuracies
from model.observation import Observation, SurfacePrediction, align_observations, common_side
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.study.judging import Gain, clustered_gain, few_gain

Array = NDArray[np.float64]
Answer = Literal["linear", "srgb", "undecided"]
Surfaces = Literal["measured", "predicted"]

MIN_IMAGES = 6
"""Least number of images that decide."""

MIN_GAIN = 0.01
"""Least mean gain of accuracy [1] of a camera that is chosen, beside its significance."""

DECLARATIONS: dict[str, dict[str, object]] = {"srgb": {"cameras": [{}]}, "linear": {"cameras": []}}
"""What declares each camera, in the form of ``twin.json``; either leaves photographs sRGB."""

_LINEAR, _SRGB = "linear", "srgb"

# Powers of light, which any other curve is like. Images of such a source prefer sRGB to light, too,
# and are neither. `_MIN_OTHER` is the least mean gain over sRGB that shows it.
_POWERS, _MIN_OTHER = (0.7, 0.8), 0.005

# Forecasts are wider than the images by this factor: the centre of mass is that of counts.
_MARGIN = 1.5

Curve = Callable[[Array], Array]

# Counts of light, and light of counts, of images in any unit.
_CURVES: Mapping[str, tuple[Curve, Curve]] = {
    _LINEAR: (np.asarray, np.asarray),
    _SRGB: (Camera().counts_of_difference, Camera().light_of_difference),
    **{str(power): (Power(power).light, Power(1 / power).light) for power in _POWERS},
}

Predict = Callable[[Heliostat, Sequence[Observation], PlantModel], SurfacePrediction]


class PhotographedMirror(NamedTuple):
    """A heliostat with observations in counts, and measured heights (F, 8, 8) [m] or None."""

    heliostat: Heliostat
    observations: Sequence[Observation]
    z: Array | None = None


@dataclass(frozen=True)
class CameraChoice:
    """The camera that images show, with the evidence.

    Attributes
    ----------
    answer : {"linear", "srgb", "undecided"}
    images, mirrors : int
        That judged.
    by : {"measured", "predicted"}
        The surfaces that forecast them.
    linear, srgb : float [1]
        Mean accuracy of forecasts with either camera, in stored counts.
    gain : Gain
        Of sRGB over linear; images of one mirror may err together.
    other : float or None
        A power of light that forecasts the counts better than sRGB.
    """

    answer: Answer
    images: int
    mirrors: int
    by: Surfaces
    linear: float
    srgb: float
    gain: Gain
    other: float | None = None

    @property
    def in_words(self) -> str:
        """The answer with its evidence, and how to declare the camera, in sentences."""
        taken, why = "differences of sRGB counts" if self.answer == "srgb" else "linear light", ""
        if self.other is not None:
            why = f", although light to the power {self.other:g} is better than either: study them"
        elif self.answer == "undecided":
            why = f", as {MIN_IMAGES} or more and a significant gain are needed to decide"
        return (
            f"{self.images} images without background are taken as {taken}{why}. Accuracy"
            f" of forecasts by {self.by} surfaces: {self.srgb:.3f} as differences of sRGB counts,"
            f" {self.linear:.3f} as linear light (gain {self.gain.mean:+.3f}, 95 %:"
            f" {self.gain.low:+.3f} to {self.gain.high:+.3f}). To declare them, write"
            ' "cameras": [{}] into "declared" of twin.json, or "cameras": [] for light.'
        )

    def to_json(self) -> dict[str, object]:
        """The choice in a report, with what would declare either camera."""
        return {**asdict(self), "in_words": self.in_words, "declare": DECLARATIONS}


def choose_camera(
    mirrors: Sequence[PhotographedMirror], model: PlantModel, predict: Predict
) -> CameraChoice | None:
    """Choose the camera of the images of all ``mirrors``; None without any.

    Mirrors with a measured surface judge alone if they have `MIN_IMAGES`. ``model`` declares no
    camera.
    """
    measured = [one for one in mirrors if one.z is not None]
    if sum(len(one.observations) for one in measured) >= MIN_IMAGES:
        mirrors = measured
    if not mirrors:
        return None
    judged = [{name: _accuracies(one, model, name, predict) for name in _CURVES} for one in mirrors]
    pooled = {name: np.concatenate([one[name] for one in judged]) for name in _CURVES}
    gain = clustered_gain([one[_SRGB] - one[_LINEAR] for one in judged])
    best = max(_CURVES, key=lambda name: float(pooled[name].mean()))
    over = few_gain(pooled[best] - pooled[_SRGB])
    is_other = best != _LINEAR and over.low > 0 and over.mean > _MIN_OTHER
    n_images = len(pooled[_SRGB])
    answer: Answer = "undecided"
    if n_images >= MIN_IMAGES and gain.high < 0:
        answer = "linear"
    elif n_images >= MIN_IMAGES and gain.low > 0 and gain.mean > MIN_GAIN and not is_other:
        answer = "srgb"
    by: Surfaces = "measured" if len(measured) == len(mirrors) else "predicted"
    linear, srgb = (float(pooled[name].mean()) for name in (_LINEAR, _SRGB))
    other = float(best) if is_other else None
    return CameraChoice(answer, n_images, len(mirrors), by, linear, srgb, gain, other)


def _accuracies(
    mirror: PhotographedMirror, model: PlantModel, curve: str, predict: Predict
) -> Array:
    """Accuracy (M,) of a mirror's forecasts in counts, with a curve."""
    (heliostat, observations, z), (counts_of, light_of) = mirror, _CURVES[curve]
    flux = np.array([one.flux for one in observations], dtype=np.float64)
    if z is None:
        light = normalized(np.array([light_of(image) for image in flux])).astype(np.float32)
        pairs = zip(observations, light, strict=True)
        z = predict(heliostat, [replace(one, flux=seen) for one, seen in pairs], model).z
    side = common_side(observations)
    wide = _MARGIN * side
    with torch.no_grad():
        aligned = align_observations(heliostat, observations, z, model)
        traced = aligned.flux_images(size=int(_MARGIN * FLUX_SIZE), side=wide).double().numpy()
    counts = [counts_of(image) for image in traced.clip(0)]
    size = (wide, wide)
    cut = [flux_window(one, size, center_of_mass(one, size), side) for one in counts]
    return flux_accuracies(flux, np.array(cut))
