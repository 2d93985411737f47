"""Rendered observations: what a clean camera would see of a mirror that is known."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.observation import Observation
from model.plant import Heliostat, TargetPlane
from training import render

Array = NDArray[np.float64]


def observe(
    heliostat: Heliostat,
    z: Array,
    suns: Array,
    planes: Sequence[TargetPlane],
    rng: np.random.Generator,
    noise: float = 0.01,
) -> list[Observation]:
    """8-bit images of heights ``z`` (4, 8, 8) [m] under suns (N, 3) on N planes, with noise
    relative to the peak.
    """
    return render.observe(heliostat, z, render.places(suns, planes), render.CleanCamera(noise), rng)
