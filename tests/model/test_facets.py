"""Surfaces of mirrors of any number of facets: prior, derivatives, refinement and windows."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.forecast import flux_changes
from model.frames import sun_direction
from model.heliostat_type import HeliostatType, MountDesign, facet_grid
from model.images import FLUX_SHAPE
from model.metrics import flux_accuracies, spot_window
from model.observation import Observation, align_observations, render_observations
from model.plant import Heliostat, MirrorOptics
from model.plant_model import JUELICH_MODEL
from model.prior import FacetKind, generic_covariance, generic_prior, tilt_modes, without
from model.refinement import RefinementOptions, refine
from model.refinement.half_samples import exchange_facets
from model.refinement.other_modes import OtherModes, between_mode_variance, changed_facets
from model.tracing.sensitivity import HeightChanges
from tests.conftest import target

GRIDS = {
    1: facet_grid(1, 1, 3.0, 3.0, 0.0),
    6: facet_grid(2, 3, 1.6, 1.2, 0.02),
    25: facet_grid(5, 5, 1.22, 1.22, 0.02),
}
SUNS = np.array([sun_direction(*place) for place in ((140.0, 30.0), (180, 50), (230, 25))])
OTHER = sun_direction(200.0, 35.0)[None]
QUICK = RefinementOptions(annealing=(0.05,), rounds=1, max_steps=4, resolution=16, samples=16)


def mirror(count: int, distance: float = 100.0) -> Heliostat:
    kind = HeliostatType("test", GRIDS[count], MountDesign(pivot_height=4.0))
    return kind.heliostat(f"of {count}", (0.0, distance, 0.0), (0.0, 0.0, 40.0))


def setups(suns: np.ndarray) -> list[Observation]:
    blank, plane = np.ones(FLUX_SHAPE, np.float32), target(12.0)
    return [Observation(blank, sun, plane, plane.center, str(i)) for i, sun in enumerate(suns)]


def half_sizes(count: int) -> np.ndarray:
    return mirror(count).facet_frames.half_sizes


def covariance(count: int) -> np.ndarray:
    """Covariance of heights without facet means and the whole mirror's tilt, in full."""
    sizes = half_sizes(count)
    free = np.eye(64 * count).reshape(-1, count, 8, 8)
    free = free - free.mean(axis=(2, 3), keepdims=True)
    free = without(free, np.repeat(tilt_modes(sizes.mean(axis=0))[:, None], count, axis=1))
    flat = free.reshape(len(free), -1)
    return flat @ generic_covariance(sizes, FacetKind()) @ flat.T


@pytest.mark.parametrize("count", [1, 6])
def test_prior_of_few_facets_is_the_whole_covariance(count):
    """Made of two blocks, each of one facet."""
    prior = generic_prior(half_sizes(count))
    flat = prior.basis.reshape(len(prior.basis), -1)
    np.testing.assert_allclose(flat.T @ flat, covariance(count), atol=1e-13)
    assert prior.basis.shape == (63 * count - 2, count, 8, 8)
    assert len(prior.fine) == 0


def test_prior_of_many_facets_has_hundreds_of_directions_and_all_of_the_variance():
    prior = generic_prior(half_sizes(25))
    assert 300 < len(prior.basis) <= 480
    spread = prior.deviation(np.eye(len(prior.basis))) ** 2
    whole = np.diag(covariance(25)).reshape(25, 8, 8)
    np.testing.assert_allclose(spread.sum(), whole.sum(), rtol=0.01)
    assert (prior.fine**2).sum() < 0.02 * whole[0].sum()
    assert prior.shapes is not None
    np.testing.assert_allclose(
        np.einsum("kfl,lij->kfij", prior.weights, prior.shapes), prior.basis, atol=1e-12
    )


def test_groups_of_scales_are_in_proportion_to_the_facets():
    assert generic_prior(half_sizes(1)).groups == [0, 1, 2, 6, 16, 32]
    assert generic_prior(half_sizes(25)).groups == [0, 25, 50, 150, 400]


def test_kind_of_given_slopes():
    kind = FacetKind.of_slopes(2.0, 1.38)
    assert kind.canting == pytest.approx(2e-3)
    assert kind.bending == pytest.approx(FacetKind().bending, rel=0.01)


def test_changes_by_shapes_are_those_by_heights():
    heliostat, prior = mirror(6), generic_prior(half_sizes(6))
    assert prior.shapes is not None
    assert prior.weights is not None
    some = slice(0, 40, 13)
    aligned = align_observations(heliostat, setups(SUNS[:1]), prior.mean, JUELICH_MODEL)
    directions, shapes, weights = (
        torch.as_tensor(part, dtype=torch.float32)
        for part in (prior.basis[some], prior.shapes, prior.weights[some])
    )
    dense = flux_changes(aligned, directions, size=32, samples=12)
    by_shape = flux_changes(aligned, HeightChanges(shapes, weights), size=32, samples=12)
    change = (dense[1:] - dense[:1]).abs().max()
    assert change > 1e-3
    torch.testing.assert_close(by_shape, dense, rtol=0, atol=1e-3 * float(change))


@pytest.mark.parametrize("count", [1, 6, pytest.param(25, marks=pytest.mark.full)])
def test_mirrors_of_any_facets_are_refined(count):
    """From three clean images; its light under another sun is forecast far better."""
    heliostat, prior = mirror(count), generic_prior(half_sizes(count))
    truth = prior.surface(np.random.default_rng(1).normal(size=len(prior.basis)))
    places, (judge,) = (
        setups(SUNS),
        render_observations(heliostat, setups(OTHER), truth, JUELICH_MODEL),
    )
    images = render_observations(heliostat, places, truth, JUELICH_MODEL)
    seen = [
        replace(place, flux=image.clip(min=0).astype(np.float32))
        for place, image in zip(places, images, strict=True)
    ]
    found = refine(heliostat, seen, JUELICH_MODEL, options=QUICK)
    ideal, refined = (
        1
        - flux_accuracies(
            judge, render_observations(heliostat, setups(OTHER), z, JUELICH_MODEL)[0].clip(min=0)
        )
        for z in (np.zeros_like(truth), found.z)
    )
    assert found.z.shape == found.z_std.shape == (count, 8, 8)
    assert found.control_points.shape == (count, 8, 8, 3)
    assert (found.z_std > 0).all()
    assert (found.method, found.weights) == ("refined", "generic")
    assert refined < 0.4 * ideal


def test_half_samples_begin_with_other_surfaces():
    """Of one facet the same surface turned, of more two facets exchanged, as often as asked."""
    for count in (1, 2, 6):
        prior = generic_prior(half_sizes(1).repeat(count, axis=0))
        coefficients = np.random.default_rng(0).normal(size=len(prior.basis))
        starts = exchange_facets(prior, coefficients)
        for _ in range(6):
            start = next(starts)
            assert start.shape == coefficients.shape
            assert np.abs(prior.surface(start) - prior.surface(coefficients)).max() > 1e-5


def test_permuted_facets_stay_facets_of_the_mirror():
    prior = generic_prior(half_sizes(6))
    coefficients = np.random.default_rng(0).normal(size=len(prior.basis))
    known = {tuple(np.round(1e6 * f.ravel(), 2)) for f in prior.surface(coefficients)}
    for start in changed_facets(prior, coefficients):
        assert {tuple(np.round(1e6 * f.ravel(), 2)) for f in prior.surface(start)} == known


def test_difference_of_modes_is_their_groups_variance():
    prior = generic_prior(half_sizes(6))
    best = np.zeros(len(prior.basis))
    others = np.zeros((2, len(best)))
    others[:, : prior.groups[1]] = 2.0
    variance = between_mode_variance(prior, best, OtherModes(others, np.zeros(2)))
    np.testing.assert_allclose(variance[: prior.groups[1]], 4)
    assert not variance[prior.groups[1] :].any()


def test_window_follows_disc_mirror_and_distance():
    """The paper's 4 m for Juelich's mirrors at their distances."""
    juelich = {r: spot_window(Heliostat.juelich("a", (0.0, r, 1.8), r), r) for r in (60.0, 300.0)}
    assert set(juelich.values()) == {4.0}
    assert spot_window(mirror(1, 300.0), 300.0) > spot_window(mirror(25, 100.0), 100.0)
    rough = replace(mirror(25), optics=MirrorOptics(slope_error=4e-3))
    assert spot_window(rough, 200.0) > spot_window(mirror(25), 200.0)
    assert spot_window(mirror(25), 2000.0) >= 0.9 * 2000 * 9.3e-3
