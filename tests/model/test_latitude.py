"""A clock error acts along the sun's path at the plant's own latitude, wherever light is traced."""

from dataclasses import replace

import numpy as np
import pytest

from model.effects.sun_position import SunPosition
from model.frames import sun_direction_at
from model.network.predictor import default_predictor
from model.observation import Observation, align_observations, misfits, render_observations
from model.plant import Heliostat
from model.prior import default_prior
from model.refinement import RefinementOptions, refine
from model.study import StudyOptions
from tests.conftest import flat_heliostat, target
from tests.rendered import observe

MINUTES = 20.0
DECLINATIONS, HOUR_ANGLES = np.array([-10.0, 5.0]), np.array([-25.0, 35.0])


def situation(latitude: float) -> tuple[Heliostat, list[Observation], list[Observation]]:
    """A heliostat on the tower's side that the sun shines on; its images with the recorded and with the true suns."""
    side = 1.0 if latitude > 0 else -1.0
    heliostat = flat_heliostat((15.0, side * 75.0, 1.8), focal_length=85.0)
    plane = replace(target(), normal=np.array([0.0, side, 0.0]))
    recorded, true = (sun_direction_at(DECLINATIONS, HOUR_ANGLES + turned, latitude) for turned in (0.0, MINUTES / 4))
    z, rng = default_prior().surface(np.full(len(default_prior().basis), 0.3)), np.random.default_rng(3)
    seen = observe(heliostat, z, true, [plane] * len(true), rng)
    return heliostat, [replace(o, sun=sun) for o, sun in zip(seen, recorded, strict=True)], seen


@pytest.mark.parametrize("latitude", [37.0, -30.0])
def test_alignment_images_and_predictions_are_those_of_the_true_sun(latitude: float):
    heliostat, recorded, true = situation(latitude)
    known, z = [SunPosition(MINUTES)], default_prior().mean
    as_recorded = align_observations(heliostat, recorded, z, known, latitude_deg=latitude)
    as_true = align_observations(heliostat, true, z, latitude_deg=latitude)
    np.testing.assert_allclose(as_recorded.angles, as_true.angles, atol=1e-9)
    for made in (render_observations, misfits):
        np.testing.assert_allclose(
            made(heliostat, recorded, z, None, known, latitude_deg=latitude),
            made(heliostat, true, z, latitude_deg=latitude),
            atol=1e-5,
        )
    found, expected = (
        default_predictor().predict(heliostat, images, None, effects, latitude_deg=latitude)
        for images, effects in ((recorded, known), (true, ()))
    )
    np.testing.assert_allclose(found.z, expected.z, atol=1e-7)
    quick = RefinementOptions(annealing=(0.5,), rounds=1, steps=2)
    found, expected = (
        refine(heliostat, images, effects=effects, options=quick, latitude_deg=latitude)
        for images, effects in ((recorded, known), (true, ()))
    )
    np.testing.assert_allclose(found.z, expected.z, atol=1e-7)


def test_nothing_has_a_latitude_of_its_own():
    heliostat, recorded, _ = situation(37.0)
    for call in (
        lambda: align_observations(heliostat, recorded, default_prior().mean),
        lambda: refine(heliostat, recorded),
        lambda: default_predictor().predict(heliostat, recorded),
        lambda: StudyOptions(latitude_deg=50.0),
    ):
        with pytest.raises(TypeError, match="latitude_deg"):
            call()
