"""Networks side by side."""

import json

import numpy as np
import pytest
import torch

from model.network.architecture import NetworkConfig, SurfaceNetwork
from model.network.inputs import descents
from model.prior import default_prior
from tests.conftest import flat_heliostat
from training.ablate import VARIANTS, table, variant
from training.config import TrainConfig
from training.export import example
from training.figures import interval
from training.parts import steepest_descents
from training.render import Photographs, Setups, Situations
from training.train import Run, train_steps

ENTRIES = json.loads(VARIANTS.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ENTRIES)
def test_every_variant_answers_from_any_number_of_images(name, stj, tmp_path):
    run = variant(ENTRIES[name], TrainConfig(data=str(stj)), tmp_path)
    with torch.no_grad():
        full = run.network.eval()(*example(2, 3))[0]
        alone = run.network(*(v[:, :3] if v.shape[1] == 8 else v for v in example(2, 3)))[0]
    torch.testing.assert_close(full, alone, atol=1e-4, rtol=1e-4)


def test_runs_side_by_side_learn_from_the_same_images_apart(stj, tmp_path):
    """Another run beside it changes nothing for the first, which chooses what both look at."""
    config = TrainConfig(data=str(stj), batch=2, bfloat16=False)
    small = NetworkConfig(channels=(4, 8, 8), features=16, hidden=16)

    def run(seed: int) -> Run:
        torch.manual_seed(seed)
        return Run(config, tmp_path / str(seed), torch.device("cpu"), SurfaceNetwork(small))

    alone, first, second = run(0), run(0), run(1)
    train_steps([alone])
    train_steps([first, second])
    for a, b in zip(alone.network.parameters(), first.network.parameters(), strict=True):
        torch.testing.assert_close(a, b)
    assert first.step == second.step == 1
    errors = {"first": np.full((2, 2, 7), 0.2), "second": np.linspace(0.1, 0.3, 7) * np.ones((2, 2, 7))}
    lines = table({"first": first, "second": second}, {"first": 1.0, "second": 2.0}, errors).splitlines()
    assert "1.000 [1.000, 1.000]" in lines[2]
    assert "1.000 [0.7" in lines[3]


def test_descents_come_farther_than_the_steepest_and_forgive_the_camera():
    """They leave less of the images than steepest descent does, and hardly follow images that were shifted."""
    rng, prior = np.random.default_rng(0), default_prior()
    suns, aims = Situations().suns(4, rng), np.tile([0.0, 0.0, 40.0], (4, 1))
    setups = Setups.of([flat_heliostat(focal_length=75.0)], suns, aims, torch.device("cpu"))
    mean, basis = (torch.as_tensor(values, dtype=torch.float32) for values in (prior.mean[None], prior.basis))
    truth = torch.as_tensor(prior.surface(rng.normal(size=len(prior.basis)))[None], dtype=torch.float32)
    flux = setups.trace(truth)
    seen = Photographs(setups, flux, torch.zeros_like(flux))
    left = [
        float((setups.trace(mean + seen.descents(mean, basis, way).sum(dim=1)) - flux).square().sum())
        for way in (steepest_descents, descents)
    ]
    assert left[1] < 0.5 * left[0]
    shifted = Photographs(setups, torch.roll(flux, 1, dims=3), torch.zeros_like(flux))
    followed = [float(shifted.descents(truth, basis, way).abs().sum()) for way in (steepest_descents, descents)]
    assert followed[1] < 0.5 * followed[0]


def test_an_interval_of_a_mean_is_that_of_its_standard_error():
    values = np.random.default_rng(0).normal(size=400)
    low, high = interval(lambda drawn: float(values[drawn].mean()), len(values))
    assert (high - low) / 2 == pytest.approx(1.645 * values.std() / 20, rel=0.1)
    assert (high + low) / 2 == pytest.approx(values.mean(), abs=0.01)
