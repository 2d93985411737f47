"""The camera that images without background show, of mirrors that are known."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from model.camera_choice import CameraChoice, PhotographedMirror, choose_camera
from model.images import normalized
from model.imaging import Camera
from model.observation import Observation
from model.plant_model import JUELICH_MODEL
from model.prior import default_prior
from tests.conftest import flat_heliostat, target
from tests.model.scenes import SUNS
from tests.rendered import observe

HELIOSTAT = flat_heliostat((15.0, 75.0, 1.8), focal_length=85.0)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    prior = default_prior()
    return prior.surface(np.random.default_rng(2).normal(0, 0.5, len(prior.basis)))


@pytest.fixture(scope="module")
def light(truth: np.ndarray) -> list[Observation]:
    return observe(HELIOSTAT, truth, SUNS, [target()] * len(SUNS), np.random.default_rng(5))


def stored(light: list[Observation], counts: Callable[[np.ndarray], np.ndarray]):
    """Observations as a camera's counts show them."""
    return [
        replace(one, flux=normalized(counts(one.flux.astype(float))).astype(np.float32))
        for one in light
    ]


def chosen(observations: list[Observation], z: np.ndarray) -> CameraChoice:
    mirror = PhotographedMirror(HELIOSTAT, observations, z)
    found = choose_camera([mirror], JUELICH_MODEL, lambda *_: pytest.fail("it is measured"))
    assert found is not None
    return found


def test_images_of_a_known_mirror_say_which_camera_took_them(light, truth):
    srgb = stored(light, Camera().counts_of_difference)
    assert chosen(light, truth).answer == "linear"
    found = chosen(srgb, truth)
    assert found.answer == "srgb"
    assert found.srgb > 0.93 > found.linear
    assert "twin.json" in found.in_words
    assert found.to_json()["declare"]["srgb"] == {"cameras": [{}]}


def test_another_curve_is_neither(light, truth):
    found = chosen(stored(light, lambda flux: flux**0.75), truth)
    assert found.gain.low > 0
    assert (found.answer, found.other in (0.7, 0.8)) == ("undecided", True)
    assert "study them" in found.in_words


def test_few_images_say_what_the_other_camera_would_change(light, truth):
    found = chosen(stored(light, Camera().counts_of_difference)[:5], truth)
    assert found.answer == "undecided"
    assert "6 or more" in found.in_words
    assert f"{found.srgb:.3f}" in found.in_words


def test_without_a_measured_surface_each_camera_has_its_own_prediction(light, truth):
    seen = []

    def predict(heliostat, observations, model):
        seen.append(observations[0].flux)
        return SimpleNamespace(z=truth)

    mirror = PhotographedMirror(HELIOSTAT, light, None)
    found = choose_camera([mirror], JUELICH_MODEL, predict)
    assert found is not None
    assert (found.by, found.answer) == ("predicted", "linear")
    assert len({flux.max() for flux in seen}) == 4
    assert choose_camera([], JUELICH_MODEL, predict) is None


def test_counts_of_a_difference_are_turned_back_into_its_light():
    camera, light = Camera(), np.linspace(0, 3, 50)
    np.testing.assert_allclose(
        camera.light_of_difference(camera.counts_of_difference(light)) / light.max(),
        camera.light_of_difference(camera.counts_of_difference(light / 3)) / light.max(),
    )
    back = camera.light_of_difference(camera.counts_of_difference(light))
    np.testing.assert_allclose(back / back.max(), light / 3, atol=1e-12)
