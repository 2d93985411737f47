import numpy as np
import pytest

from model.atmosphere import HAZY_DAY, attenuation_of_visibility
from model.errors import InvalidInputError
from model.tracing.scene import CLEAR_DAY

RANGES_KM = np.linspace(0.1, 1.5, 15)


def loss(visibility_km: float) -> np.ndarray:
    return np.polynomial.polynomial.polyval(RANGES_KM, attenuation_of_visibility(visibility_km))


def test_published_days_are_met():
    assert attenuation_of_visibility(23) == pytest.approx(CLEAR_DAY)
    assert attenuation_of_visibility(5) == pytest.approx(HAZY_DAY)


def test_loss_falls_with_the_visibility_and_rises_with_the_range():
    losses = [loss(km) for km in (5, 8, 12, 22.9, 23, 40, 100, 300)]
    assert (np.diff(losses, axis=0) < 0).all()
    assert (np.diff(losses, axis=1) > 0).all()
    assert np.min(losses) > 0
    assert np.max(losses) < 0.5


@pytest.mark.parametrize("visibility_km", [0.5, 4.9, 301, float("nan")])
def test_other_visibilities_are_refused(visibility_km: float):
    with pytest.raises(InvalidInputError, match="visibility_km must lie in"):
        attenuation_of_visibility(visibility_km)
