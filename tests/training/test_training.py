"""Training end to end, small: surfaces, rendering, steps, resuming."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.effects import effect_to_json
from model.errors import InvalidInputError
from model.network.architecture import NetworkConfig
from model.surface import mirrored, split_canting
from training.config import TrainConfig
from training.prior import estimate
from training.render import RealCamera, SceneSampler, load_field, render
from training.surfaces import (
    Augmentation,
    load_surfaces,
    rotated,
    split,
    tilt_modes,
    untilted,
    with_symmetries,
)
from training.train import Run, commit_of, loss_terms

SMALL = NetworkConfig(channels=(8, 16, 16), features=32, hidden=32)


@pytest.fixture(scope="module")
def surfaces(stj) -> np.ndarray:
    return load_surfaces(stj)[0]


def test_every_heliostat_has_one_part_and_those_apart_have_none_in_learning(stj):
    names = load_surfaces(stj)[1]
    parts = split(names)
    assert sorted(i for part in parts.values() for i in part) == list(range(47))
    apart = json.loads((stj / "surfaces-apart.json").read_text(encoding="utf-8"))
    assert {names[i] for i in parts["apart"]} == set(apart)
    learnt, judges = TrainConfig().parts(names)
    assert (learnt, judges) == (parts["training"], parts["validation"])
    both = replace(TrainConfig(), learns_from=("training", "validation")).parts(names)
    assert both == (sorted(parts["training"] + parts["validation"]), [])
    with pytest.raises(InvalidInputError, match=r"split\.json must name STJ-999 once"):
        split([*names, "STJ-999"])


def test_turning_twice_and_mirroring_twice_change_nothing(surfaces):
    np.testing.assert_array_equal(rotated(rotated(surfaces)), surfaces)
    np.testing.assert_array_equal(mirrored(mirrored(surfaces)), surfaces)


def test_a_mirrored_surface_throws_a_mirrored_spot(surfaces):
    """On a heliostat due north under a noon sun the flux of the mirrored surface is the mirrored
    flux.
    """
    from model.plant import Heliostat, TargetPlane
    from model.setup import Setup
    from model.surface import control_points
    from model.tracing import Scene, Window, trace

    heliostat = Heliostat.juelich("synthetic", np.array([0.0, 80.0, 1.8]), 90.0)
    plane = TargetPlane(
        "t", np.array([0.0, 0, 40]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8, 8
    )
    sun = np.array([0.0, -0.6, 0.8])
    angles = heliostat.mount.align(heliostat.position, sun, plane.center)
    flux = []
    for z in (surfaces[3], mirrored(surfaces[3])):
        scene = Scene.from_setups(
            [Setup(heliostat, control_points(heliostat, z), sun, plane)], [angles]
        )
        flux.append(trace(scene, Window(8, 8)).normalized()[0])
    assert float((flux[1].flip(1) - flux[0]).abs().sum()) < 0.1


def test_samples_resemble_the_measured_surfaces(surfaces):
    drawn = Augmentation().sample(surfaces, 400, np.random.default_rng(0))
    mean = surfaces.mean(axis=0)
    for part, (low, high) in zip((0, 1), ((0.8, 3.0), (0.8, 2.0)), strict=True):
        sizes = [
            np.median(split_canting(z - mean)[part].std(axis=(1, 2, 3))) for z in (drawn, surfaces)
        ]
        assert low < sizes[0] / sizes[1] < high


def test_some_samples_are_many_times_as_rough_as_most(surfaces):
    waviness = split_canting(
        Augmentation().sample(surfaces, 1000, np.random.default_rng(0)) - surfaces.mean(axis=0)
    )[1]
    size = waviness.std(axis=(1, 2, 3))
    assert 0.01 < (size > 3 * np.median(size)).mean() < 0.15


def test_fresh_samples_are_no_mixtures_of_the_measured_surfaces(surfaces):
    """The span of the measured mirrors and their mirror images does not hold them."""
    plain = Augmentation(exchange=0.0, tilt_mrad=0.0, focus_mrad=0.0, freedom=1e9)
    few = surfaces[:6]
    span = np.linalg.svd(with_symmetries(few).reshape(-1, 256), full_matrices=False)[2]

    def outside(fresh: float) -> float:
        z = replace(plain, fresh=fresh).sample(few, 50, np.random.default_rng(1)).reshape(50, -1)
        return float(np.linalg.norm(z - z @ span.T @ span) / np.linalg.norm(z))

    assert outside(1.0) > 2 * outside(0.0)


def test_rendered_images_are_normalised_and_reproducible(surfaces, stj):
    field, device = load_field(stj), torch.device("cpu")
    first, again, other = (
        render(surfaces[:3], 4, field, SceneSampler(), RealCamera(), device, seed)
        for seed in (1, 1, 2)
    )
    assert first.flux.shape == first.clipped.shape == (3, 4, 64, 64)
    assert first.setups.conditions().shape == (3, 4, 12)
    torch.testing.assert_close(first.flux.sum(dim=(2, 3)), torch.full((3, 4), 100.0))
    torch.testing.assert_close(first.flux, again.flux, rtol=0, atol=0)
    assert not torch.equal(first.flux, other.flux)


PERFECT = RealCamera(
    0.02, 0.0, gamma=1.0, compression=0.0, warp=0.0, background=0.0, noise=0.0, exposure=(0.9, 1.0)
)


def test_a_perfect_camera_sees_what_was_traced(surfaces, stj):
    seen, traced = (
        render(
            surfaces[:2], 4, load_field(stj), SceneSampler(), camera, torch.device("cpu"), 3
        ).flux
        for camera in (PERFECT, None)
    )
    assert (
        float((seen - traced).abs().sum(dim=(2, 3)).max()) < 2.5
    )  # of 100: the sun's haze is drawn, and 8 bits
    assert not torch.equal(seen, traced)


def test_what_a_camera_cuts_off_is_cut_off_of_guesses_too(surfaces, stj):
    """Light above the range is no error of a surface: the true one still explains the
    photograph.
    """
    bright = replace(PERFECT, exposure=(1.4, 1.5))
    seen = render(surfaces[:2], 4, load_field(stj), SceneSampler(), bright, torch.device("cpu"), 3)
    assert 0.005 < float(seen.clipped.mean()) < 0.3
    truth = torch.as_tensor(surfaces[:2], dtype=torch.float32)
    misfit = [
        float((shown - seen.flux).abs().sum(dim=(2, 3)).mean())
        for shown in (seen.trace(truth, samples=24), seen.setups.trace(truth, samples=24))
    ]
    assert misfit[0] < 2.5
    assert misfit[1] > 3 * misfit[0]


def test_conditions_of_a_camera_stay_within_its_limits():
    camera, rng = RealCamera(gamma=1.2, compression=1.0), np.random.default_rng(0)
    conditions = [
        {e.name: effect_to_json(e)["parameters"] for e in camera.effects(0.5, rng)}
        for _ in range(200)
    ]
    gammas = [world["camera_response"]["gamma"] for world in conditions]
    assert 1.2**-0.5 <= min(gammas) < 0.93
    assert 1.07 < max(gammas) <= 1.2**0.5
    assert 0.4 < max(world["camera_shoulder"]["compression"] for world in conditions) <= 0.5
    assert max(world["sun_shape"]["circumsolar_ratio"] for world in conditions) <= (0.02 + 0.15) / 2


def test_prior_explains_measured_surfaces_and_holds_no_tilt_of_the_whole_mirror(surfaces):
    prior = estimate(surfaces)
    whole = np.repeat(tilt_modes()[:, None], 4, axis=1)
    np.testing.assert_allclose(np.einsum("kfij,mfij->km", prior.basis, whole), 0, atol=1e-9)
    flat = untilted(surfaces[5])
    rest = flat - prior.surface(prior.coefficients(flat))
    assert np.sqrt((rest**2).mean()) < 0.1 * np.sqrt((flat**2).mean())


def test_prior_hides_as_much_tilt_as_the_measured_surfaces_have(surfaces):
    hidden = estimate(surfaces).hidden
    np.testing.assert_allclose(untilted(hidden), 0, atol=1e-12)
    np.testing.assert_allclose(
        (hidden**2).sum(axis=0).mean(), ((surfaces - untilted(surfaces)) ** 2).mean(), rtol=0.05
    )


def test_a_run_learns_saves_and_resumes(stj, tmp_path):
    config = TrainConfig(data=str(stj), steps=6, batch=4, warmup=2, network=SMALL, bfloat16=False)
    device = torch.device("cpu")
    whole = Run(config, tmp_path / "whole", device)
    for _ in range(4):
        assert np.isfinite(whole.train_step())
    half = Run(config, tmp_path / "half", device)
    for _ in range(2):
        half.train_step()
    half.save()
    resumed = Run(config, tmp_path / "half", device)
    assert resumed.step == 2
    for _ in range(2):
        resumed.train_step()
    for a, b in zip(whole.network.parameters(), resumed.network.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)
    assert TrainConfig.read(tmp_path / "half" / "config.json") == config
    assert np.isfinite(resumed.validate(repeats=1)).all()


def test_rough_mirrors_weigh_less_and_their_spread_all_the_same():
    truth = torch.zeros(2, 4, 8, 8)
    heights = torch.rand(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    spread = torch.ones_like(heights)
    error, slopes, likelihood = loss_terms(heights, spread, truth, torch.tensor([1.0, 0.0]))
    assert float(error) == pytest.approx(float(heights[0].mean()) / 2)
    assert float(slopes) > 0
    assert float(likelihood) == pytest.approx(float(heights.mean()))


def test_unfinished_training_stops_when_time_is_up(stj, tmp_path):
    run = Run(
        TrainConfig(data=str(stj), steps=5, batch=2, network=SMALL), tmp_path, torch.device("cpu")
    )
    run.train(minutes=0.0)
    assert run.step == 0
    resumed = Run(run.config, tmp_path, torch.device("cpu"))
    assert resumed.commit == run.commit == commit_of(Path(__file__).parent)
    assert json.loads(Path(tmp_path / "config.json").read_text())["steps"] == 5
