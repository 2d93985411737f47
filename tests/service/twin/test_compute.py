"""Forecasts hold no more light than the mirror reflects, cosine and all."""

from typing import Any

import numpy as np
import pytest
import torch

from model.effects import effects_from_json
from model.forecast import align
from model.frames import sun_direction
from model.plant import Heliostat, TargetPlane
from model.plant_model import JUELICH_MODEL, PlantModel
from model.setup import Setup
from model.site import JUELICH
from model.sunshape import Buie, Gaussian, Pillbox, SunShape
from model.surface import control_points
from model.tracing import Optics
from model.tracing.convolution import central_rays
from service.twin import operations

PLANE = TargetPlane(
    "target", np.array([0.0, -3, 40]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8.0, 7.0
)


def effect(name: str, **parameters: float) -> dict[str, Any]:
    return {"name": name, "parameters": parameters}


LIGHTS: list[tuple[SunShape, list[dict[str, Any]]]] = [
    (Buie(0.02), []),
    (Buie(0.4), [effect("camera_shoulder", compression=2.0)]),
    (Buie(0.02), [effect("sun_shape", circumsolar_ratio=0.4), effect("background", level=0.1)]),
    (Pillbox(), [effect("sun_shape", circumsolar_ratio=0.0), effect("camera_response", gamma=0.5)]),
    (
        Gaussian(3e-3),
        [effect("slope_error", sigma_mrad=4.0), effect("camera_ghost", share=0.3, right_m=1.0)],
    ),
]
"""Suns that are declared, and effects of the sun, the mirror and the camera."""


@pytest.mark.full
@pytest.mark.parametrize("window", [None, 5.0, 30.0])
@pytest.mark.parametrize("sun", [(-30.0, 40.0), (80.0, 12.0), (0.0, 62.0)])
@pytest.mark.parametrize("distance", [40.0, 120.0, 350.0])
def test_no_forecast_holds_more_power_than_the_mirror_reflects(distance, sun, window):
    """In a window that holds the whole spot all of it is there, but for what the aureole sends
    beyond.
    """
    mirror, towards = (
        Heliostat.juelich("A", np.array([10.0, distance, 1.8]), distance),
        sun_direction(*sun),
    )
    setup = Setup(mirror, control_points(mirror), towards, PLANE)
    scene = align([setup], JUELICH_MODEL, dtype=torch.float64)
    incident = float(central_rays(scene.groups[0].scene, 64).power.sum())
    for shape, effects in LIGHTS:
        optics = Optics(sun_shape=shape, reflectivity=0.9)
        model = PlantModel(JUELICH, optics, tuple(effects_from_json(effects)))
        forecast = operations.forecast(setup, model, (64, 64), window)
        share = forecast.power / (0.9 * optics.dni * incident)
        assert (0.998 if window == 30 else 0) < share <= 1, (shape, effects)
