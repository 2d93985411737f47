import numpy as np
import pytest

from model.errors import InvalidInputError
from model.imaging import center_of_mass, flux_window
from model.imaging.window import overlap_matrix

PLANE = (8.6, 7.2)


@pytest.fixture
def image():
    return np.random.default_rng(1).random((50, 70))


def test_a_window_over_the_whole_plane_keeps_all_energy(image):
    for resolution in (16, 64, (33, 97)):
        window = flux_window(image, PLANE, window=PLANE, resolution=resolution)
        assert window.sum() == pytest.approx(image.sum(), rel=1e-12)
        assert np.allclose(center_of_mass(window, PLANE), center_of_mass(image, PLANE), atol=0.02)


def test_the_same_grid_is_the_identity(image):
    assert np.allclose(flux_window(image, PLANE, window=PLANE, resolution=(50, 70)), image)


def test_energy_is_counted_by_area(image):
    # A window of half the sides, centred, holds the inner quarter of a uniform image.
    window = flux_window(np.ones((50, 70)), PLANE, window=(4.3, 3.6), resolution=10)
    assert window.sum() == pytest.approx(50 * 70 / 4)
    assert np.ptp(window) < 1e-9


def test_axes_point_right_and_up():
    image = np.zeros((40, 40))
    image[2, 35] = 1.0  # upper right
    right, up = center_of_mass(image, (4.0, 4.0))
    assert (right, up) == pytest.approx((1.55, 1.75))
    centered = flux_window(image, (4.0, 4.0), (right, up), window=1.0, resolution=5)
    assert np.unravel_index(centered.argmax(), centered.shape) == (2, 2)
    assert centered.sum() == pytest.approx(1.0)


def test_a_sub_pixel_shift_moves_the_centre_of_mass_by_it(image):
    padded = np.pad(image, 30)
    shifted = flux_window(
        padded, (4.0, 4.0), (0.0123, -0.0077), window=4.0, resolution=padded.shape
    )
    before, after = center_of_mass(padded, (4.0, 4.0)), center_of_mass(shifted, (4.0, 4.0))
    assert np.allclose(after - before, [-0.0123, 0.0077], atol=1e-12)


def test_outside_the_plane_there_is_nothing(image):
    assert flux_window(image, PLANE, center=(20.0, 0.0)).sum() == 0


def test_overlap_rows_share_out_each_source_cell():
    weights = overlap_matrix(np.linspace(0, 1, 8), np.linspace(-0.5, 1.5, 30))
    assert np.allclose(weights.sum(axis=0), 1)


@pytest.mark.parametrize("bad", [np.zeros(4), np.zeros((2, 2, 2)), np.zeros((0, 3))])
def test_what_is_no_image_is_refused(bad):
    with pytest.raises(InvalidInputError):
        flux_window(bad, PLANE)


def test_sizes_must_be_positive(image):
    with pytest.raises(InvalidInputError):
        flux_window(image, PLANE, window=0.0)
    with pytest.raises(InvalidInputError):
        center_of_mass(np.zeros((4, 4)), PLANE)
