import numpy as np
import pytest
import torch

from model.errors import InvalidInputError
from model.sunshape import (
    FREQUENCY_STEP,
    SOLAR_DISC,
    Buie,
    Gaussian,
    Pillbox,
    Tabulated,
    random_angles,
    transfer_table,
)

CPU = torch.device("cpu")
SHAPES = [Pillbox(), Gaussian(2.5e-3), Buie(0.02), Buie(0.2), Tabulated((0.0, 4e-3, 5e-3), (1.0, 0.8, 0.0))]


def table(shape):
    return transfer_table(shape, torch.float64, CPU).numpy()


def test_pillbox_transfer_is_an_airy_pattern():
    x = torch.as_tensor(2 * np.pi * SOLAR_DISC * FREQUENCY_STEP * np.arange(1, 4096))
    np.testing.assert_allclose(table(Pillbox())[1:], 2 * torch.special.bessel_j1(x) / x, atol=1e-6)


def test_gaussian_transfer_is_a_gaussian():
    frequency = FREQUENCY_STEP * np.arange(4096)
    np.testing.assert_allclose(table(Gaussian(2e-3)), np.exp(-2 * (np.pi * 2e-3 * frequency) ** 2), atol=2e-7)


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_transfer_keeps_the_energy(shape):
    values = table(shape)
    assert values[0] == pytest.approx(1)
    assert np.abs(values).max() <= 1 + 1e-9


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_random_angles_have_the_profiles_transfer(shape):
    """The mean of J0(2 pi f theta) over random rays is the transfer function: both tracers see one sun."""
    angles = torch.as_tensor(random_angles(shape, 200_000, np.random.default_rng(0)))
    for index in (10, 40, 100):
        mean = torch.special.bessel_j0(2 * np.pi * FREQUENCY_STEP * index * angles).mean()
        assert float(mean) == pytest.approx(table(shape)[index], abs=5e-3)


@pytest.mark.parametrize("chi", [0.05, 0.1, 0.2])
def test_buies_chi_is_about_the_circumsolar_share(chi):
    """Buie et al. 2003: the energy beyond the disc is about chi; far below 0.05 the formula gives less."""
    angles = random_angles(Buie(chi), 400_000, np.random.default_rng(1))
    assert (angles > SOLAR_DISC).mean() == pytest.approx(chi, rel=0.25)


def test_gradient_in_the_circumsolar_ratio():
    chi = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    transfer_table(Buie(chi), torch.float64, CPU)[60].backward()
    step = 1e-5
    expected = (table(Buie(0.05 + step))[60] - table(Buie(0.05 - step))[60]) / (2 * step)
    assert float(chi.grad) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Buie(0.6), "circumsolar_ratio"),
        (lambda: Pillbox(-1.0), "half_angle"),
        (lambda: Gaussian(float("nan")), "sigma"),
        (lambda: Tabulated((0.0, 1.0), (1.0,)), "as many"),
        (lambda: Tabulated((0.1, 1.0), (1.0, 1.0)), "rising from 0"),
    ],
)
def test_bounds_are_named(make, field):
    with pytest.raises(InvalidInputError, match=field):
        make()
