import numpy as np
import pytest

from model.observation import TRUSTED_MAHALANOBIS
from model.prior import GROUPS, default_prior
from training.surfaces import tilt_modes


def test_a_mirror_unlike_those_known_is_strange():
    """Half of the facets turned by three milliradians, five times what the prior expects of canting."""
    prior = default_prior()
    truth = prior.surface(np.random.default_rng(2).normal(0, 0.5, len(prior.basis)))
    assert prior.mahalanobis(prior.mean) == pytest.approx(0, abs=1e-6)
    assert prior.mahalanobis(truth) < TRUSTED_MAHALANOBIS
    tilt = np.einsum("f,kij->fij", [3e-3, -3e-3, 0, 0], tilt_modes())
    assert prior.mahalanobis(truth + tilt) > TRUSTED_MAHALANOBIS


def test_prior_inverts_its_own_coefficients():
    prior = default_prior()
    c = np.random.default_rng(0).normal(size=len(prior.basis))
    np.testing.assert_allclose(prior.coefficients(prior.surface(c)), c, rtol=1e-4, atol=1e-5)


def test_a_rough_mirror_has_wider_scales():
    """As wide as it is rough where its coefficients are known; as it was where nothing is known of them."""
    prior = default_prior()
    counts = len(prior.basis)
    rough = 4 * np.random.default_rng(1).normal(size=counts)
    known, unknown = prior.precision(rough, np.zeros(counts)), prior.precision(np.zeros(counts), np.ones(counts))
    np.testing.assert_allclose(known[GROUPS[-1]] ** -0.5, 4, rtol=0.2)
    np.testing.assert_allclose(unknown, 1)
