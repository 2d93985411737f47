"""Derivatives of flux in closed form, against differences of finely traced images."""

import numpy as np
import pytest
import torch

from model.effects.camera_response import CameraResponse
from model.forecast import flux_changes
from model.frames import sun_direction
from model.observation import align_observations
from model.plant_model import JUELICH_MODEL
from model.prior import default_prior
from tests.conftest import flat_heliostat, target
from training.render import places

HELIOSTAT = flat_heliostat((15.0, 75.0, 1.8), focal_length=85.0)
SETUPS = places(
    np.array([sun_direction(180 - azimuth, 35.0) for azimuth in (-40.0, 20.0)]), [target()] * 2
)


def images(z: np.ndarray, effects: list, samples: int = 96) -> torch.Tensor:
    aligned = align_observations(HELIOSTAT, SETUPS, z, JUELICH_MODEL.with_effects(effects))
    return aligned.flux_images(size=32, samples=samples)


@pytest.mark.parametrize("effects", [[], [CameraResponse(gamma=0.7)]])
def test_changes_are_those_of_changed_mirrors(effects):
    """Canting, large and fine waves, each of twenty microns; the mounts turn the spots back."""
    prior = default_prior()
    z = prior.surface(np.random.default_rng(0).normal(0, 0.5, len(prior.basis)))
    chosen = prior.basis[[0, 3, 16, 40]]
    changes = 2e-5 * chosen / np.sqrt((chosen**2).mean(axis=(1, 2, 3), keepdims=True))
    aligned = align_observations(HELIOSTAT, SETUPS, z, JUELICH_MODEL.with_effects(effects))
    directions = torch.as_tensor(changes, dtype=torch.float32)
    found = flux_changes(aligned, directions, size=32, samples=32)
    torch.testing.assert_close(found[0], images(z, effects, samples=32), rtol=0, atol=1e-5)
    for change, image in zip(changes, found[1:] - found[:1], strict=True):
        expected = (images(z + change, effects) - images(z - change, effects)) / 2
        assert (image - expected).norm() < 0.1 * expected.norm()
