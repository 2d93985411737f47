"""What a camera's range cut off says only that there was at least so much light."""

from dataclasses import replace

import numpy as np
import pytest

from model.errors import InvalidInputError
from model.frames import sun_direction
from model.observation import Observation, misfits
from model.plant_model import JUELICH_MODEL
from model.prior import default_prior
from model.refinement import RefinementOptions, refine
from tests.conftest import flat_heliostat, target
from tests.rendered import observe

HELIOSTAT = flat_heliostat((-10.0, 60.0, 1.8), 70.0)
SUNS = np.array([sun_direction(180 - azimuth, 40.0) for azimuth in (-40.0, 0.0, 40.0)])


def cut_off(taken: Observation, level: float) -> Observation:
    """As a camera shows it whose range ends at ``level`` of the peak."""
    most = level * taken.flux.max()
    flux = np.minimum(taken.flux, most)
    return replace(
        taken, flux=flux / flux.sum() * 100, clipped=(taken.flux >= most).astype(np.float32)
    )


@pytest.fixture(scope="module")
def taken() -> tuple[np.ndarray, list[Observation], list[Observation]]:
    prior = default_prior()
    z = prior.surface(np.random.default_rng(0).normal(size=len(prior.basis)))
    whole = observe(HELIOSTAT, z, SUNS, [target()] * 3, np.random.default_rng(1), noise=0.002)
    return z, whole, [cut_off(one, 0.5) for one in whole]


def test_the_true_mirror_explains_photographs_that_were_cut_off(taken):
    z, whole, clipped = taken
    blind = [replace(one, clipped=None) for one in clipped]
    errors = [np.mean(misfits(HELIOSTAT, o, z, JUELICH_MODEL)) for o in (whole, clipped, blind)]
    assert errors[1] < errors[0] + 0.02
    assert errors[2] > errors[0] + 0.08
    assert clipped[0].clipped_share > 0.6 > whole[0].clipped_share == 0


@pytest.mark.full
def test_a_refinement_is_not_misled_by_what_was_cut_off(taken):
    z, _, clipped = taken
    options = RefinementOptions(rounds=1)
    start = default_prior().mean
    errors = [
        np.abs(refine(HELIOSTAT, one, JUELICH_MODEL, start, options=options).z - z).mean()
        for one in (clipped, [replace(o, clipped=None) for o in clipped])
    ]
    assert errors[0] < 0.5 * errors[1]


def test_a_mask_of_another_size_is_named(taken):
    _, whole, _ = taken
    with pytest.raises(InvalidInputError, match="clipped of 0 must be"):
        replace(whole[0], clipped=np.zeros((3, 3), np.float32))
