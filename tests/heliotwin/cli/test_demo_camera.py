import numpy as np
import pytest

from heliotwin.demo.camera import CameraOptions, photograph, target_corners
from model.errors import InvalidInputError
from model.imaging.light import Srgb
from model.plant import TargetPlane
from tests.imaging import gaussian


@pytest.fixture
def plane():
    return TargetPlane("tower", np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 5.4, 6.4)


@pytest.fixture
def spot(plane):
    return gaussian(plane, 0.3, -0.2, 0.8, 0.5, 0.6)


@pytest.mark.full
def test_a_frame_depends_on_its_generator_alone(plane, spot):
    frames = [photograph(spot, plane, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert frames[0].shape == (1080, 1440, 3)
    assert frames[0].dtype == np.uint8
    assert np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])


def test_corners_lie_in_the_frame(plane):
    for perspective in (0.0, 0.3):
        options = CameraOptions(perspective=perspective)
        corners = target_corners(plane, options)
        assert (corners > 0).all()
        assert (corners < np.array(options.size)[::-1]).all()


def test_brightness_is_daylight_plus_flux(plane, spot):
    options = CameraOptions(
        noise=0.0, gradient=(0.0, 0.0), grid_step=0.0, time_stamp="", perspective=0.0
    )
    frame = photograph(spot, plane, np.random.default_rng(0), options)
    red = frame[..., 0].astype(float)
    assert red.max() == pytest.approx(255 * Srgb().counts(0.85), abs=2)
    assert np.median(frame[300:340, 900:930, 1]) == pytest.approx(255 * Srgb().counts(0.25), abs=2)


@pytest.mark.parametrize("bad", [np.full((4, 4), np.nan), -np.ones((4, 4)), np.ones(4)])
def test_what_is_no_flux_is_refused(plane, bad):
    with pytest.raises(InvalidInputError):
        photograph(bad, plane, np.random.default_rng(0))
