"""A clock error acts along the sun's path at the plant's own latitude, wherever light is traced."""

from dataclasses import replace

import numpy as np
import pytest

from model.effects.sun_position import SunPosition
from model.frames import sun_direction_at
from model.network.predictor import default_predictor
from model.observation import Observation, align_observations, misfits, render_observations
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.prior import default_prior
from model.refinement import RefinementOptions, refine
from model.site import Site
from tests.conftest import flat_heliostat, target
from tests.rendered import observe

MINUTES = 20.0
DECLINATIONS, HOUR_ANGLES = np.array([-10.0, 5.0]), np.array([-25.0, 35.0])


def situation(latitude: float) -> tuple[Heliostat, list[Observation], list[Observation]]:
    """A heliostat on the tower's side that the sun shines on; its images with the recorded and with
    the true suns.
    """
    side = 1.0 if latitude > 0 else -1.0
    heliostat = flat_heliostat((15.0, side * 75.0, 1.8), focal_length=85.0)
    plane = replace(target(), normal=np.array([0.0, side, 0.0]))
    recorded, true = (
        sun_direction_at(DECLINATIONS, HOUR_ANGLES + turned, latitude)
        for turned in (0.0, MINUTES / 4)
    )
    z, rng = (
        default_prior().surface(np.full(len(default_prior().basis), 0.3)),
        np.random.default_rng(3),
    )
    seen = observe(heliostat, z, true, [plane] * len(true), rng)
    return heliostat, [replace(o, sun=sun) for o, sun in zip(seen, recorded, strict=True)], seen


@pytest.mark.parametrize("latitude", [pytest.param(37.0, marks=pytest.mark.full), -30.0])
def test_alignment_images_and_predictions_are_those_of_the_true_sun(latitude: float):
    heliostat, recorded, true = situation(latitude)
    right, z = PlantModel(Site(latitude, 0.0, 0.0)), default_prior().mean
    late = right.with_effects([SunPosition(MINUTES)])
    as_recorded, as_true = (
        align_observations(heliostat, recorded, z, late),
        align_observations(heliostat, true, z, right),
    )
    np.testing.assert_allclose(as_recorded.angles, as_true.angles, atol=1e-9)
    for made in (render_observations, misfits):
        np.testing.assert_allclose(
            made(heliostat, recorded, z, late), made(heliostat, true, z, right), atol=1e-5
        )
    found, expected = (
        default_predictor().predict(heliostat, images, model)
        for images, model in ((recorded, late), (true, right))
    )
    np.testing.assert_allclose(found.z, expected.z, atol=1e-7)
    quick = RefinementOptions(annealing=(0.5,), rounds=1, max_steps=2)
    found, expected = (
        refine(heliostat, images, model, options=quick)
        for images, model in ((recorded, late), (true, right))
    )
    np.testing.assert_allclose(found.z, expected.z, atol=1e-7)


def test_nothing_has_a_site_by_default():
    heliostat, recorded, _ = situation(37.0)
    for call in (
        lambda: align_observations(heliostat, recorded, default_prior().mean),
        lambda: refine(heliostat, recorded),
        lambda: default_predictor().predict(heliostat, recorded),
    ):
        with pytest.raises(TypeError, match="'model'"):
            call()
    with pytest.raises(TypeError, match="'site'"):
        PlantModel()
