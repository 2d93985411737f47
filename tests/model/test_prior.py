from dataclasses import replace

import numpy as np
import pytest

from model.observation import TRUSTED_MAHALANOBIS
from model.plant import Facet
from model.prior import (
    GROUPS,
    MEASURED_FACET,
    FacetKind,
    default_prior,
    generic_prior,
    prior_of,
    ripples,
    tilt_modes,
)
from model.surface import halved
from tests.conftest import flat_heliostat


def test_mirror_unlike_those_known_has_a_large_mahalanobis_distance():
    """Half of the facets turned by three milliradians, five times what the prior expects of
    canting.
    """
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
    """As wide as it is rough where its coefficients are known; as it was where nothing is known of
    them.
    """
    prior = default_prior()
    counts = len(prior.basis)
    rough = 4 * np.random.default_rng(1).normal(size=counts)
    known, unknown = (
        prior.precision(rough, np.zeros(counts)),
        prior.precision(np.zeros(counts), np.ones(counts)),
    )
    np.testing.assert_allclose(known[GROUPS[-1]] ** -0.5, 4, rtol=0.2)
    np.testing.assert_allclose(unknown, 1)


def test_facets_of_another_size_have_the_generic_prior():
    """Twice as large they bend by twice as much, over twice the length: slopes are the same."""
    known = flat_heliostat()
    assert prior_of(known) is default_prior()
    twice = tuple(Facet(2 * f.position, 2 * f.canting_x, 2 * f.canting_y) for f in known.facets)
    found, same = prior_of(replace(known, facets=twice)), generic_prior(known.facet_frames[2])
    assert found.name == "generic"
    np.testing.assert_allclose(
        (found.basis**2).sum(axis=0), 4 * (same.basis**2).sum(axis=0), rtol=1e-6
    )


def test_a_generic_mirror_has_no_tilt_of_its_own_and_facets_that_are_alike():
    prior = generic_prior(flat_heliostat().facet_frames[2])
    np.testing.assert_allclose(prior.basis.mean(axis=(2, 3)), 0, atol=1e-12)
    tilts = np.repeat(tilt_modes()[:, None], 4, axis=1)
    np.testing.assert_allclose(np.einsum("kfij,tfij->kt", prior.basis, tilts), 0, atol=1e-9)
    bent = tilt_modes()[0] ** 2
    first, last = np.einsum("kfij,ij->fk", prior.basis, bent - bent.mean())[[0, -1]]
    assert first @ last / (np.linalg.norm(first) * np.linalg.norm(last)) == pytest.approx(
        FacetKind().alike, abs=0.02
    )


def test_ripples_are_what_heights_do_not_reach():
    """And grow with the facets."""
    half_sizes = np.tile(MEASURED_FACET, (4, 1))
    fine = ripples(half_sizes)
    assert fine.shape == (4 * (13**2 - 8**2), 4, 13, 13)
    z = halved(np.random.default_rng(1).normal(0, 1e-4, (4, 8, 8)))
    np.testing.assert_allclose(np.einsum("nfij,fij->n", fine, z), 0, atol=1e-15)
    spread = np.sqrt((fine**2).sum(axis=(1, 2, 3)))
    np.testing.assert_allclose(spread, FacetKind().ripple * 2 * np.sqrt(np.prod(MEASURED_FACET)))
    np.testing.assert_allclose(ripples(2 * half_sizes), 2 * fine)
