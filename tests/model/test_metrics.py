import numpy as np
import pytest

from model.errors import InvalidInputError
from model.metrics import compare_on_target, flux_accuracy, surface_error


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


def test_energy_outside_the_window_is_told():
    compared = compare_on_target(spot((0, 0), sigma=1.2), spot((0, 0), sigma=0.3), (8.0, 7.0))
    assert compared.measured_outside > 0.1
    assert compared.forecast_outside < 1e-6


@pytest.mark.parametrize("bad", [np.zeros((2, 2)), np.full((2, 2), np.nan), np.ones((3, 2))])
def test_bad_flux_is_refused(bad):
    with pytest.raises(InvalidInputError, match="fluxes must"):
        flux_accuracy(np.ones((2, 2)), bad)


def test_surface_error_does_not_see_a_facets_height():
    z = np.random.default_rng(0).normal(size=(4, 8, 8))
    assert surface_error(z + np.arange(4)[:, None, None], z) == pytest.approx(0, abs=1e-12)
    assert surface_error(np.stack([z[0] * 0 + s for s in (1, 2, 3, 4)]), z * 0) == pytest.approx(0)
