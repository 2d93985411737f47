"""Refinement on rendered images of mirrors it knows only by their light."""

import numpy as np
import pytest

from model.errors import InvalidInputError
from model.frames import sun_direction_at
from model.metrics import surface_error
from model.observation import Observation
from model.plant import Heliostat
from model.refinement import default_prior, misfit, refine
from tests.conftest import flat_heliostat, target
from tests.rendered import observe

SUNS = sun_direction_at(np.array([-20.0, -5, 5, 20, 15, 0]), np.array([-40.0, 30, -15, 50, 0, 10]), 50.9)


def images(heliostat: Heliostat, z: np.ndarray) -> list[Observation]:
    """Noisy images of a mirror under six suns."""
    return observe(heliostat, z, SUNS, [target()] * len(SUNS), np.random.default_rng(5))


@pytest.fixture(scope="module")
def heliostat() -> Heliostat:
    return flat_heliostat((15.0, 75.0, 1.8), focal_length=85.0)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    prior = default_prior()
    return prior.surface(np.random.default_rng(8).normal(0, 0.9, len(prior.basis)))


@pytest.fixture(scope="module")
def refined(heliostat, truth):
    return refine(heliostat, images(heliostat, truth))


def test_the_true_surface_is_approached(refined, truth):
    """From the prior's mean alone; a mirror drawn from the wide prior is harder than a real one."""
    assert surface_error(refined.z, truth) < 0.4 * surface_error(default_prior().mean, truth)


def test_the_images_are_explained_as_well_as_by_the_truth(refined, heliostat, truth):
    assert refined.misfit < misfit(heliostat, images(heliostat, truth), truth) + 0.01


def test_the_uncertainty_covers_the_error(refined, truth):
    error = np.abs(refined.z - truth)
    assert (refined.z_std > 0).all()
    assert 0.3 < np.mean(error < 1.645 * refined.z_std) <= 1


def test_misfit_tells_a_surface_from_another(heliostat, truth, refined):
    assert refined.misfit < 0.08
    assert misfit(heliostat, images(heliostat, truth), default_prior().mean) > 1.5 * refined.misfit


def test_prior_inverts_its_own_coefficients():
    prior = default_prior()
    c = np.random.default_rng(0).normal(size=len(prior.basis))
    np.testing.assert_allclose(prior.coefficients(prior.surface(c)), c, rtol=1e-5)


def test_no_image_is_named(heliostat):
    with pytest.raises(InvalidInputError, match="at least one image"):
        refine(heliostat, [])
