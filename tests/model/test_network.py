import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.errors import InvalidInputError
from model.frames import sun_direction
from model.images import normalized
from model.network.architecture import CONDITIONS, MAX_IMAGES, NetworkConfig, SurfaceNetwork
from model.network.inputs import conditions, conjugate_gradient_steps
from model.network.predictor import (
    INPUTS,
    SurfacePredictor,
    _NetworkInputs,
    default_predictor,
    mirrored_inputs,
    model_card,
)
from model.observation import Observation, spread_suns
from model.plant import Facet, TargetPlane
from model.plant_model import JUELICH_MODEL
from model.prior import default_prior
from model.refinement import refine
from model.setup import Setup
from model.surface import control_points, mirrored
from model.tracing import Scene
from model.tracing.convolution import central_rays
from service.twin import operations
from tests.conftest import flat_heliostat, target
from training.export import PARITY_MM, example, export, parity, rounded
from training.render import Renderings, SceneSampler, Setups

SMALL = NetworkConfig(channels=(8, 16, 16), features=32, hidden=32)


@pytest.fixture(scope="module")
def network() -> torch.nn.Module:
    torch.manual_seed(0)
    network = SurfaceNetwork(SMALL)
    torch.nn.init.normal_(
        network.decoder[-1].weight, std=0.1
    )  # untrained it answers with the guess
    return rounded(network.eval())


def test_order_of_images_does_not_matter(network):
    flux, geometry, mask, guess_flux, guess, descent = example(3, MAX_IMAGES)
    order = torch.randperm(MAX_IMAGES)
    with torch.no_grad():
        straight = network(flux, geometry, mask, guess_flux, guess, descent)
        shuffled = network(
            flux[:, order], geometry[:, order], mask, guess_flux[:, order], guess, descent[:, order]
        )
    for a, b in zip(straight, shuffled, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


def test_values_of_missing_images_have_no_effect(network):
    flux, geometry, mask, guess_flux, guess, descent = example(2, 3)
    noise = torch.where(mask[..., None, None] > 0, flux, torch.rand_like(flux))
    with torch.no_grad():
        full, other = (
            network(f, geometry, mask, guess_flux, guess, descent)[0] for f in (flux, noise)
        )
        alone = network(
            *(values[:, :3] for values in (flux, geometry, mask, guess_flux)), guess, descent[:, :3]
        )[0]
    torch.testing.assert_close(full, other)
    torch.testing.assert_close(full, alone, atol=1e-5, rtol=1e-5)


def test_the_answer_keeps_facet_means_and_its_spread_is_positive(network):
    inputs = example(2, 5)
    with torch.no_grad():
        heights, spread = network(*inputs)
    assert heights.shape == spread.shape == (2, 4, 8, 8)
    torch.testing.assert_close(
        heights.mean(dim=(2, 3)), inputs[-2].mean(dim=(2, 3)), atol=1e-6, rtol=0
    )
    assert (spread > 0).all()


@pytest.mark.full
@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore:# The axis name"
)
def test_onnx_equals_torch_at_every_batch_and_number_of_images(network, tmp_path):
    export(network, tmp_path / "small.onnx")
    assert parity(network, tmp_path / "small.onnx") <= PARITY_MM


def test_conditions_say_how_slopes_and_places_move_light():
    """Against the tracer: tilt the whole mirror a little, and move it a little, and see where the
    spot goes.
    """
    heliostat, plane = flat_heliostat((25.0, 70.0, 1.8)), target()
    sun = np.array([0.35, -0.5, 0.79]) / np.linalg.norm([0.35, -0.5, 0.79])
    angles = heliostat.mount.align(heliostat.position, sun, plane.center)
    points = control_points(heliostat)
    tilted = points.copy()
    tilted[..., 2] += 1e-4 * points[..., 0]  # a slope of 0.1 mrad along the mirror's x
    moved = points + [0.0, 0.01, 0.0]
    scenes = [
        Scene.from_setups([Setup(heliostat, p, sun, plane)], [angles], torch.float64)
        for p in (points, tilted, moved)
    ]
    rays = [central_rays(s, 8) for s in scenes]
    given = conditions(scenes[0])[0].numpy()
    slope = (rays[1].spot - rays[0].spot)[0].numpy() / (2e-4 * float(rays[0].slant_range))
    place = (rays[2].spot - rays[0].spot)[0].numpy() / 0.01
    np.testing.assert_allclose(given[0:2], slope, atol=5e-3)
    np.testing.assert_allclose(given[6:8], place, atol=5e-3)
    assert given.shape == (CONDITIONS,)
    assert given[8] == pytest.approx(np.log(float(rays[0].slant_range) / 100), abs=1e-3)


def test_conditions_are_independent_of_scale():
    """A world enlarged by two, in images of twice the side, looks the same; its mirror has twice as
    many metres.
    """
    small, plane = (
        flat_heliostat((25.0, 70.0, 0.0), focal_length=80.0),
        target(center=(0.0, 0.0, 0.0)),
    )
    facets = (Facet(2 * f.position, 2 * f.canting_x, 2 * f.canting_y) for f in small.facets)
    large = replace(small, position=2 * small.position, facets=tuple(facets))
    suns = np.array([sun_direction(180 - azimuth, 40.0) for azimuth in (-40.0, 0.0, 40.0)])
    blank = np.ones((64, 64), np.float32)
    given = []
    for heliostat, side in ((small, 4.0), (large, 8.0)):
        seen = [Observation(blank, sun, plane, plane.center, "1", side=side) for sun in suns]
        network_inputs = _NetworkInputs(heliostat, seen, JUELICH_MODEL, default_prior())
        given.append(network_inputs.inputs(np.zeros((4, 8, 8))))
    given[1]["conditions"][..., 4:8] *= 2
    for name in ("conditions", "guess_flux"):
        np.testing.assert_allclose(given[1][name], given[0][name], atol=2e-3, err_msg=name)


def test_images_of_several_sides_are_refused():
    sides = [replace(observation(str(side)), side=side) for side in (4.0, 6.0)]
    with pytest.raises(InvalidInputError, match=r"one size, got sides \[4.0, 6.0\] m"):
        refine(flat_heliostat(focal_length=75.0), sides, JUELICH_MODEL)


def test_a_descent_leads_towards_the_surface_that_threw_the_images():
    rng, prior = np.random.default_rng(0), default_prior()
    suns = SceneSampler().suns(4, rng)
    setups = Setups.of(
        [flat_heliostat(focal_length=75.0)],
        suns,
        np.tile([0.0, 0.0, 40.0], (4, 1)),
        torch.device("cpu"),
    )
    mean, basis = (
        torch.as_tensor(values, dtype=torch.float32) for values in (prior.mean[None], prior.basis)
    )
    truth = torch.as_tensor(
        prior.surface(rng.normal(size=len(prior.basis)))[None], dtype=torch.float32
    )
    flux = setups.trace(truth)
    seen = Renderings(setups, flux, torch.zeros_like(flux))
    descent = seen.conjugate_gradient_steps(mean, basis)
    assert descent.shape == (1, 4, 4, 8, 8)
    misfit = [
        float((setups.trace(z) - flux).square().sum()) for z in (mean, mean + descent.sum(dim=1))
    ]
    assert misfit[1] < 0.5 * misfit[0]
    arrived = seen.conjugate_gradient_steps(truth, basis)
    assert float(arrived.abs().max()) < 0.1 * float(descent.abs().max())


def test_images_that_do_not_do_what_was_differentiated_lead_nowhere():
    """Clipped light may: a step against its own derivative is none, rather than one without end."""
    prior, generator = default_prior(), torch.Generator().manual_seed(0)
    basis = torch.as_tensor(prior.basis, dtype=torch.float32)
    base, patterns = (
        torch.rand(32, 32, generator=generator) + 1,
        torch.randn(256, 1024, generator=generator),
    )

    def trace(changes: torch.Tensor) -> torch.Tensor:
        moved = (1e2 * changes.flatten(2) @ patterns).view(1, 2, 32, 32)
        return base + moved - 2 * moved.detach()

    descent = conjugate_gradient_steps(
        trace, base + torch.randn(1, 2, 32, 32, generator=generator), basis
    )
    assert float(descent.abs().max()) == 0


def test_a_guess_whose_light_is_one_pixel_has_a_descent():
    """A rough mirror that sends its light out of the window: what cameras may do outweighs all
    else.
    """
    basis = torch.as_tensor(default_prior().basis, dtype=torch.float32)
    guess, along = torch.zeros(32, 32), torch.linspace(-3, 3, 32)
    guess[0, 0] = 100.0
    spot = normalized(torch.exp(-(along[:, None] ** 2 + along**2) / 2)).expand(1, 2, 32, 32)
    patterns = torch.randn(256, 1024, generator=torch.Generator().manual_seed(0))

    def trace(changes: torch.Tensor) -> torch.Tensor:
        return guess + (changes.flatten(2) @ patterns).view(1, 2, 32, 32)

    assert torch.isfinite(conjugate_gradient_steps(trace, spot, basis)).all()


def test_mirrored_geometry_has_mirrored_inputs():
    """A mirror image of everything, traced, gives what `mirrored_inputs` makes of the original."""
    rng, prior = np.random.default_rng(0), default_prior()
    suns, aims = SceneSampler().suns(3, rng), np.tile([2.0, 0.0, 40.0], (3, 1))
    z, basis = (
        torch.as_tensor(values, dtype=torch.float32) for values in (prior.mean[None], prior.basis)
    )
    truth = torch.as_tensor(
        prior.surface(rng.normal(size=len(prior.basis)))[None], dtype=torch.float32
    )
    given = []
    for sign in (1.0, -1.0):
        flip = [sign, 1.0, 1.0]
        heliostat = flat_heliostat((sign * 25.0, 70.0, 1.8), focal_length=75.0)
        setups = Setups.of([heliostat], suns * flip, aims * flip, torch.device("cpu"))
        surfaces = [
            values if sign > 0 else mirrored(values.numpy()).copy() for values in (z, truth)
        ]
        guess, thrower = (torch.as_tensor(values) for values in surfaces)
        flux = setups.trace(thrower)
        photographs = Renderings(setups, flux, torch.zeros_like(flux))
        mask, shown, descent = (
            torch.ones(1, 3),
            photographs.trace(guess),
            photographs.conjugate_gradient_steps(guess, basis),
        )
        values = (flux, setups.conditions(), mask, shown, guess, descent)
        given.append({name: value.numpy() for name, value in zip(INPUTS, values, strict=True)})
    for name, expected in mirrored_inputs(given[0], (1, 0, 3, 2)).items():
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            given[1][name] / scale, expected / scale, atol=0.02, err_msg=name
        )


def observation(identifier="1") -> Observation:
    flux = np.exp(-0.5 * ((np.arange(64) - 31.5) / 12) ** 2)
    image = np.outer(flux, flux).astype(np.float32)
    plane: TargetPlane = target()
    return Observation(
        image / image.sum() * 100, np.array([0.0, -0.6, 0.8]), plane, plane.center, identifier
    )


def test_shipped_predictor_names_its_weights_and_keeps_the_contract():
    predicted = default_predictor().predict(
        flat_heliostat(focal_length=75.0), [observation("a"), observation("b")], JUELICH_MODEL
    )
    assert predicted.z.shape == predicted.z_std.shape == (4, 8, 8)
    assert predicted.control_points.shape == (4, 8, 8, 3)
    assert predicted.used == ("a", "b")
    assert predicted.weights.startswith("surface-network-")
    assert (predicted.z_std > 0).all()
    assert 0 < predicted.misfit < 1


def test_predictor_takes_a_batch_of_any_size():
    predictor: SurfacePredictor = default_predictor()
    for batch in (1, 5):
        z, z_std = predictor.iterate(
            {n: t.numpy() for n, t in zip(INPUTS, example(batch, 4), strict=True)}
        )
        assert z.shape == z_std.shape == (batch, 4, 8, 8)


def test_shipped_network_beats_the_mean_surface_by_its_own_card():
    figures = model_card()["evaluation"]
    network, mean = figures["network, 8 clean images"], figures["mean surface"]
    assert network["mae_mm"]["median"] < 0.8 * mean["mae_mm"]["median"]
    assert network["flux_accuracy"] > mean["flux_accuracy"]


def test_wrong_number_of_images_is_named():
    for images in ([], [observation(str(i)) for i in range(9)]):
        with pytest.raises(InvalidInputError, match="1 to 8 images"):
            default_predictor().predict(flat_heliostat(), images, JUELICH_MODEL)


def test_bad_flux_is_named():
    with pytest.raises(InvalidInputError, match="flux of x"):
        Observation(
            np.zeros((64, 64), np.float32), np.array([0, -0.6, 0.8]), target(), np.zeros(3), "x"
        )


def test_spread_suns_takes_the_extremes():
    angles = np.radians([0, 1, 2, 50, 51, -50])
    suns = np.stack([np.sin(angles), -np.cos(angles), np.zeros(6)], axis=-1)
    assert sorted(spread_suns(suns, 3)) in ([0, 4, 5], [0, 3, 5])
    assert len(spread_suns(suns, 8)) == 6


_LOADS = """
from model.network.predictor import default_predictor
default_predictor()
"""


@pytest.mark.full
def test_runtime_of_the_network_keeps_no_id_and_has_nothing_to_send(tmp_path: Path):
    """With telemetry on it writes an id and a queue of events under the home folder, as soon as it
    is loaded.
    """
    places = {
        "HOME": str(tmp_path),
        "XDG_CACHE_HOME": str(tmp_path),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    done = subprocess.run(
        [sys.executable, "-c", _LOADS],
        env=os.environ | places,
        check=True,
        capture_output=True,
        text=True,
    )
    assert "telemetry" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_mirror_of_other_facets_is_refused_with_the_remedy_and_rendered_all_the_same():
    three = replace(flat_heliostat(), facets=flat_heliostat().facets[:3])
    with pytest.raises(
        InvalidInputError, match="mirrors of 4 facets, flat has 3; use the method refined"
    ):
        default_predictor().predict(three, [observation("a")], JUELICH_MODEL)
    flux = operations.render(three, [observation("a")], None, JUELICH_MODEL)
    assert flux.shape == (1, 64, 64)
    with pytest.raises(InvalidInputError, match="for 3 facets"):
        operations.render(three, [observation("a")], np.zeros((4, 8, 8)), JUELICH_MODEL)


def test_the_network_answers_if_its_surface_is_the_better_one(monkeypatch):
    heliostat, seen = flat_heliostat(focal_length=75.0), [observation("a"), observation("b")]
    network = operations.predict(heliostat, seen, JUELICH_MODEL)
    for is_better, method in ((True, "network"), (False, "refined")):
        refined = replace(network, method="refined", is_start_better=is_better)
        monkeypatch.setattr(operations, "refine", lambda *_, answer=refined, **__: answer)
        assert operations.predict(heliostat, seen, JUELICH_MODEL, "refined").method == method


@pytest.mark.parametrize("method", ["network", "refined"])
def test_a_mirror_of_other_facets_is_refined_by_either_method(method, monkeypatch):
    """There is no network for it, and no start by the network."""
    three, asked = replace(flat_heliostat(), facets=flat_heliostat().facets[:3]), []

    def refined(heliostat, observations, model, start=None, *, progress):
        asked.append((heliostat, start))
        return "refined"

    monkeypatch.setattr(operations, "refine", refined)
    assert operations.predict(three, [observation("a")], JUELICH_MODEL, method) == "refined"
    assert asked == [(three, None)]
