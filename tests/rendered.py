"""Rendered observations: what a clean camera would see of a mirror that is known."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from model.observation import Observation, scene_of
from model.plant import Heliostat, TargetPlane
from model.tracing import Window, trace

Array = NDArray[np.float64]


def observe(
    heliostat: Heliostat,
    z: Array,
    suns: Array,
    planes: Sequence[TargetPlane],
    rng: np.random.Generator,
    noise: float = 0.01,
) -> list[Observation]:
    """8-bit images of heights ``z`` (4, 8, 8) [m] under suns (N, 3) on N planes, with noise relative to the peak."""
    blank = np.ones((64, 64), np.float32)
    places = [Observation(blank, s, p, p.center, str(i)) for i, (s, p) in enumerate(zip(suns, planes, strict=True))]
    with torch.no_grad():
        flux = trace(scene_of(heliostat, places, [z]), Window(on_spot=True), samples=48).irradiance.numpy()
    flux = flux / flux.max(axis=(1, 2), keepdims=True) + rng.normal(0, noise, flux.shape)
    images = np.round(flux.clip(0, 1) * 255).astype(np.float32)
    return [
        Observation(100 * image / image.sum(), o.sun, o.target, o.center_of_mass, o.identifier)
        for image, o in zip(images, places, strict=True)
    ]
