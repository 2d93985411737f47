import numpy as np
import pytest

from model.errors import InvalidInputError
from model.metrics import (
    accuracy_window,
    compare_on_target,
    flux_accuracies,
    flux_accuracy,
    surface_error,
)


def spot(center, size=(8.0, 7.0), pixels=(128, 160), sigma=0.6) -> np.ndarray:
    x = ((np.arange(pixels[1]) + 0.5) / pixels[1] - 0.5) * size[0] - center[0]
    y = (0.5 - (np.arange(pixels[0]) + 0.5) / pixels[0]) * size[1] - center[1]
    return np.exp(-0.5 * (x[None, :] ** 2 + y[:, None] ** 2) / sigma**2)


def test_accuracy_ignores_exposure_and_is_one_for_equal_shapes():
    image = spot((0, 0))
    assert flux_accuracy(image, 7 * image) == pytest.approx(1)
    assert flux_accuracy([[1.0, 0.0]], [[0.0, 1.0]]) == pytest.approx(-1)


def test_comparison_ignores_where_the_spot_lies_and_how_it_is_sampled():
    compared = compare_on_target(spot((0, 0)), spot((0.83, -0.61), pixels=(256, 256)), (8.0, 7.0))
    assert compared.accuracy > 0.985
    assert compared.window == 4.0


def test_energy_outside_the_window_is_reported():
    compared = compare_on_target(spot((0, 0), sigma=1.2), spot((0, 0), sigma=0.3), (8.0, 7.0))
    assert compared.measured_outside > 0.1
    assert compared.forecast_outside < 1e-6


@pytest.mark.parametrize("bad", [np.zeros((2, 2)), np.full((2, 2), np.nan), np.ones((3, 2))])
def test_bad_flux_is_refused(bad):
    with pytest.raises(InvalidInputError, match="fluxes must"):
        flux_accuracy(np.ones((2, 2)), bad)


def test_many_accuracies_at_once_are_those_of_each():
    a, b = np.random.default_rng(0).uniform(size=(2, 3, 8, 8))
    np.testing.assert_allclose(
        flux_accuracies(a, b), [flux_accuracy(*pair) for pair in zip(a, b, strict=True)]
    )


def test_window_grows_with_the_spot():
    """Beyond w / 2 of a Gaussian, right and left, lies the share erfc(w / (sqrt(8) sigma)); up and
    down as much.
    """
    size = (16.0, 16.0)
    chosen = [
        accuracy_window([spot((0, 0), size, sigma=sigma)], [size])
        for sigma in (0.7, 1.0, 1.4, 2.2, 4.0)
    ]
    assert chosen == [4.0, 6.0, 8.0, 12.0, 16.0]
    wide = spot((0, 0), size, sigma=2.2)
    assert accuracy_window([wide], [size], widest=8.0) == 8.0
    assert accuracy_window([spot((0, 0), size, sigma=0.8)], [size], spill=0.001) == 6.0


def test_surface_error_does_not_see_a_facets_height():
    z = np.random.default_rng(0).normal(size=(4, 8, 8))
    assert surface_error(z + np.arange(4)[:, None, None], z) == pytest.approx(0, abs=1e-12)
    assert surface_error(np.stack([z[0] * 0 + s for s in (1, 2, 3, 4)]), z * 0) == pytest.approx(0)
