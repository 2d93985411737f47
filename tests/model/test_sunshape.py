import numpy as np
import pytest
import torch

from model.effects.sun_shape import SunShapeEffect
from model.errors import InvalidInputError
from model.sunshape import (
    FREQUENCY_STEP,
    SOLAR_DISC,
    Buie,
    Gaussian,
    Pillbox,
    Tabulated,
    half_angle,
    random_angles,
    transfer_table,
)
from model.sunshape.buie import chi_of_csr, csr_of_chi
from model.tracing import Optics

CPU = torch.device("cpu")
SHAPES = [
    Pillbox(),
    Gaussian(2.5e-3),
    Buie(0.02),
    Buie(0.2),
    Tabulated((0.0, 4e-3, 5e-3), (1.0, 0.8, 0.0)),
]


def table(shape):
    return transfer_table(shape, torch.float64, CPU).numpy()


def test_pillbox_transfer_is_an_airy_pattern():
    x = torch.as_tensor(2 * np.pi * SOLAR_DISC * FREQUENCY_STEP * np.arange(1, 4096))
    np.testing.assert_allclose(table(Pillbox())[1:], 2 * torch.special.bessel_j1(x) / x, atol=1e-6)


def test_gaussian_transfer_is_a_gaussian():
    frequency = FREQUENCY_STEP * np.arange(4096)
    np.testing.assert_allclose(
        table(Gaussian(2e-3)), np.exp(-2 * (np.pi * 2e-3 * frequency) ** 2), atol=2e-7
    )


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_transfer_keeps_the_energy(shape):
    values = table(shape)
    assert values[0] == pytest.approx(1)
    assert np.abs(values).max() <= 1 + 1e-9


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_random_angles_have_the_profiles_transfer(shape):
    """The mean of J0(2 pi f theta) over random rays is the transfer function: both tracers see one
    sun.
    """
    angles = torch.as_tensor(random_angles(shape, 200_000, np.random.default_rng(0)))
    for index in (10, 40, 100):
        mean = torch.special.bessel_j0(2 * np.pi * FREQUENCY_STEP * index * angles).mean()
        assert float(mean) == pytest.approx(table(shape)[index], abs=5e-3)


@pytest.mark.parametrize("chi", [0.05, 0.1, 0.2])
def test_buies_chi_is_about_the_circumsolar_share(chi):
    """Buie et al. 2003: the energy beyond the disc is about chi; far below 0.05 the formula gives
    less.
    """
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


@pytest.mark.parametrize("shape", [*SHAPES, Pillbox(2e-3), Gaussian(8e-3)], ids=repr)
def test_a_clear_sky_leaves_any_declared_sun_as_it_is(shape):
    neutral = SunShapeEffect().on_optics(Optics(sun_shape=shape)).sun_shape
    np.testing.assert_allclose(table(neutral), table(shape), atol=2e-6)


def test_haze_before_a_pillbox_takes_light_from_the_disc_into_the_aureole():
    hazy = SunShapeEffect(circumsolar_ratio=0.2).on_optics(Optics(sun_shape=Pillbox())).sun_shape
    angles = random_angles(hazy, 400_000, np.random.default_rng(2))
    assert (angles > SOLAR_DISC).mean() == pytest.approx(0.2, rel=0.25)
    assert SunShapeEffect(circumsolar_ratio=0.2).on_optics(Optics()).sun_shape == Buie(0.2)


def test_light_beyond_an_end_is_lost_and_the_rest_stays():
    whole, near = (
        table(Buie(0.3)),
        transfer_table(Buie(0.3), torch.float64, CPU, (20e-3, 0.1)).numpy(),
    )
    np.testing.assert_allclose(near[1], whole, atol=1e-12)
    angles = random_angles(Buie(0.3), 400_000, np.random.default_rng(3))
    assert (angles < 18e-3).mean() < near[0, 0] < (angles < 20e-3).mean()
    assert half_angle(Buie(0.3), 0.9) == pytest.approx(np.quantile(angles, 0.9), rel=0.01)


@pytest.mark.parametrize(
    ("chi", "csr"), [(0.01, 0.0004), (0.02, 0.0058), (0.05, 0.043), (0.1, 0.100)]
)
def test_true_circumsolar_ratio_of_chi(chi: float, csr: float):
    """As published with the six tools' cases (Wang et al. 2020)."""
    assert csr_of_chi(chi) == pytest.approx(csr, abs=6e-4)


def test_true_circumsolar_ratio_is_the_light_beyond_the_disc():
    angles = random_angles(Buie(0.2), 400_000, np.random.default_rng(4))
    assert csr_of_chi(0.2) == pytest.approx((angles > SOLAR_DISC).mean(), abs=2e-3)


@pytest.mark.parametrize("csr", [0.0, 1e-4, 0.01, 0.1, 0.48])
def test_chi_has_the_true_circumsolar_ratio(csr: float):
    assert csr_of_chi(chi_of_csr(csr)) == pytest.approx(csr, abs=1e-12)


def test_circumsolar_ratio_without_a_chi_is_refused():
    with pytest.raises(InvalidInputError, match="csr must lie in"):
        chi_of_csr(0.6)
