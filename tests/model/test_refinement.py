"""Refinement on rendered images of mirrors it knows only by their light."""

from dataclasses import replace
from itertools import chain

import numpy as np
import pytest

from model.effects.camera_response import CameraResponse
from model.errors import InvalidInputError
from model.frames import sun_direction_at
from model.images import normalized
from model.metrics import surface_error
from model.observation import Observation, misfits, render_observations
from model.plant import Facet, Heliostat
from model.plant_model import JUELICH_MODEL
from model.prior import GROUPS, default_prior, ripples
from model.progress import SUBSTEPS
from model.refinement import RefinementOptions, refine
from model.refinement.half_samples import half_samples
from model.surface import halved
from tests.conftest import flat_heliostat, target
from tests.model.scenes import SUNS
from tests.rendered import observe


def images(heliostat: Heliostat, z: np.ndarray) -> list[Observation]:
    """Noisy images of a mirror under six suns."""
    return observe(heliostat, z, SUNS, [target()] * len(SUNS), np.random.default_rng(5))


@pytest.fixture(scope="module")
def heliostat() -> Heliostat:
    return flat_heliostat((15.0, 75.0, 1.8), focal_length=85.0)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    prior = default_prior()
    return prior.surface(np.random.default_rng(2).normal(0, 0.5, len(prior.basis)))


@pytest.fixture(scope="module")
def refined(heliostat, truth):
    return refine(heliostat, images(heliostat, truth), JUELICH_MODEL)


def test_the_true_surface_is_approached(refined, truth):
    """From the prior's mean alone, to some hundredths of a millimetre."""
    assert (
        surface_error(refined.z, truth) < 5e-5 < 0.25 * surface_error(default_prior().mean, truth)
    )


@pytest.mark.full
def test_a_start_at_the_truth_gains_nothing(refined, heliostat, truth):
    from_truth = refine(heliostat, images(heliostat, truth), JUELICH_MODEL, truth)
    assert surface_error(from_truth.z, refined.z) < 5e-5
    assert refined.misfit < from_truth.misfit + 1e-3


@pytest.mark.full
def test_a_start_far_off_is_left_for_the_prior_s_mean(refined, heliostat, truth):
    """From where canting is twelve standard deviations off, descent alone ends at another mirror, 4
    mm away.
    """
    prior = default_prior()
    far = np.zeros(len(prior.basis))
    far[:4] = 12
    found = refine(heliostat, images(heliostat, truth), JUELICH_MODEL, prior.surface(far))
    assert surface_error(found.z, refined.z) < 2e-5


@pytest.mark.full
def test_a_rough_mirror_is_found(heliostat):
    """Its waviness half as much again as the prior expects, its canting less: the scales of its
    directions follow.
    """
    prior = default_prior()
    coefficients = 1.5 * np.random.default_rng(3).normal(size=len(prior.basis))
    coefficients[: GROUPS[1]] /= 3
    rough = prior.surface(coefficients)
    found = refine(heliostat, images(heliostat, rough), JUELICH_MODEL)
    assert surface_error(found.z, rough) < 0.25 * surface_error(prior.mean, rough)
    assert np.mean(np.abs(found.z - rough) < 1.645 * found.z_std) > 0.8


@pytest.mark.full
def test_heights_do_not_compensate_what_they_cannot_resolve(heliostat, truth):
    """A mirror with ripples, found with them and without: without them heights make up for what
    they cannot be.
    """
    fine = ripples(heliostat.facet_frames[2])
    rippled = halved(truth) + np.tensordot(
        np.random.default_rng(8).normal(size=len(fine)), fine, axes=1
    )
    seen = images(heliostat, rippled)
    found, without = (
        refine(heliostat, seen, JUELICH_MODEL, options=RefinementOptions(with_ripples=some))
        for some in (True, False)
    )
    assert surface_error(found.z, truth) < 0.7 * surface_error(without.z, truth)
    assert surface_error(found.z, truth) < 1.2e-4
    within = [np.mean(np.abs(end.z - truth) < 1.645 * end.z_std) for end in (found, without)]
    assert within[0] > within[1] + 0.2


@pytest.mark.full
def test_a_mirror_of_a_kind_that_nobody_measured_is_found(heliostat, truth):
    larger = tuple(
        Facet(1.5 * f.position, 1.5 * f.canting_x, 1.5 * f.canting_y) for f in heliostat.facets
    )
    unknown = replace(heliostat, facets=larger)
    found = refine(unknown, images(unknown, 1.5 * truth), JUELICH_MODEL)
    assert found.weights == "generic"
    assert surface_error(found.z, 1.5 * truth) < 1.2e-4
    assert np.mean(np.abs(found.z - 1.5 * truth) < 1.645 * found.z_std) > 0.8


def mean_misfit(heliostat: Heliostat, z: np.ndarray, truth: np.ndarray) -> float:
    return float(np.mean(misfits(heliostat, images(heliostat, truth), z, JUELICH_MODEL)))


def test_the_images_are_explained_as_well_as_by_the_truth(refined, heliostat, truth):
    assert refined.misfit < mean_misfit(heliostat, truth, truth) + 0.01


def test_the_uncertainty_covers_the_error(refined, truth):
    error = np.abs(refined.z - truth)
    assert (refined.z_std > 0).all()
    assert refined.contradicting == ()
    assert 0.8 < np.mean(error < 1.645 * refined.z_std) <= 1


@pytest.mark.full
def test_intervals_hold_what_photographs_disagree_about(refined, heliostat, truth):
    """Under eastern suns the facets stand canted otherwise: no surface is right, and the answer
    says so.
    """
    slope = np.linspace(-1, 1, 8)[:, None] * np.ones(8)
    other = truth + 3e-4 * np.array([1, -1, -1, 1])[:, None, None] * slope
    of_truth, of_other = images(heliostat, truth), images(heliostat, other)
    mixed = [b if b.sun[0] > 0 else a for a, b in zip(of_truth, of_other, strict=True)]
    assert 0 < sum(o.sun[0] > 0 for o in mixed) < len(mixed)
    found = refine(heliostat, mixed, JUELICH_MODEL)
    assert found.z_std.mean() > 1.2 * refined.z_std.mean()
    assert np.mean(np.abs(found.z - (truth + other) / 2) < 1.645 * found.z_std) > 0.8


@pytest.mark.parametrize("count", [2, 3, 4, 5, 8])
def test_half_samples_are_balanced(count):
    """Each image is in one half of each pair; two images of different groups are apart in two pairs
    of three.
    """
    suns = sun_direction_at(np.full(count, 10.0), np.linspace(-60, 60, count), 50.9)
    pairs = half_samples(suns, 8)
    assert all(sorted(a + b) == list(range(count)) and a and b for a, b in pairs)
    if count == 4:
        apart = [sum((i in a) != (j in a) for a, _ in pairs) for i in range(4) for j in range(i)]
        assert apart == [2] * 6


def test_half_samples_of_many_images_are_of_a_few_with_suns_far_apart():
    suns = sun_direction_at(np.full(64, 10.0), np.linspace(-60, 60, 64), 50.9)
    for half in chain.from_iterable(half_samples(suns, 8)):
        assert len(set(half)) == 8
        around = np.arccos(np.clip(suns[half] @ suns[half].T, -1, 1))
        assert np.degrees(around.max()) > 40


def test_no_image_narrows_the_tilt_of_the_whole_mirror(refined):
    hidden = np.sqrt((default_prior().hidden ** 2).sum(axis=0))
    assert hidden.max() > 1e-5
    assert (refined.z_std > hidden).all()


def test_misfit_distinguishes_surfaces(heliostat, truth, refined):
    assert refined.trusted
    assert mean_misfit(heliostat, default_prior().mean, truth) > 1.5 * refined.misfit


@pytest.mark.full
def test_a_foreign_image_is_named(heliostat, truth):
    """On one of six images another heliostat's spot lies beside: the others still agree, and that
    one is found out.
    """
    observations = images(heliostat, truth)
    observations[2] = replace(
        observations[2], flux=observations[2].flux + 0.5 * np.roll(observations[2].flux, 20, axis=1)
    )
    found = refine(heliostat, observations, JUELICH_MODEL, options=RefinementOptions(rounds=2))
    assert found.suspicious == found.contradicting == ("2",)
    assert surface_error(found.z, truth) < 2e-4
    assert not found.trusted


@pytest.mark.full
def test_poor_image_has_less_weight(refined, heliostat, truth):
    """One whose patches err by a tenth of the peak: the surface goes by the others, and says so."""
    taken = images(heliostat, truth)
    patches = np.kron(np.random.default_rng(7).normal(0, 0.1, (16, 16)), np.ones((4, 4)))
    poor = taken[2].flux + (taken[2].flux.max() * patches).clip(min=0)
    taken[2] = replace(taken[2], flux=normalized(poor).astype(np.float32))
    found = refine(heliostat, taken, JUELICH_MODEL)
    others = np.delete(found.information_shares, 2)
    assert found.information_shares[2] < 0.5 * others.mean()
    assert sum(found.information_shares) == pytest.approx(1)
    assert surface_error(found.z, truth) < 2 * surface_error(refined.z, truth)


@pytest.mark.full
def test_adopted_effects_are_not_taken_for_shape(heliostat, truth):
    """A camera's response that the model knows spoils the surface no more; one that it does not
    know does.
    """
    response, options = [CameraResponse(gamma=0.6)], RefinementOptions(rounds=1)
    few = images(heliostat, truth)[:3]
    seen = [
        replace(o, flux=image.astype(np.float32))
        for o, image in zip(
            few,
            render_observations(heliostat, few, truth, JUELICH_MODEL.with_effects(response)),
            strict=True,
        )
    ]
    known = refine(heliostat, seen, JUELICH_MODEL.with_effects(response), options=options)
    assert surface_error(known.z, truth) < 0.8 * surface_error(
        refine(heliostat, seen, JUELICH_MODEL, options=options).z, truth
    )


@pytest.mark.full
def test_few_images_say_whether_the_start_was_better(heliostat, truth):
    """Two photographs of AC43 left a refined surface farther from its deflectometry than the
    network's was.
    """
    seen, far = (
        images(heliostat, truth),
        default_prior().surface(np.eye(len(default_prior().basis))[0] * 9),
    )
    options = RefinementOptions(with_half_samples=False)

    def is_better(start: np.ndarray, count: int) -> bool:
        return refine(
            heliostat, seen[:count], JUELICH_MODEL, start, options=options
        ).is_start_better

    assert is_better(truth, 2)
    assert not is_better(far, 6)
    assert not is_better(truth, 1)


def test_no_image_is_named(heliostat):
    with pytest.raises(InvalidInputError, match="at least one image"):
        refine(heliostat, [], JUELICH_MODEL)


QUICK = RefinementOptions(annealing=(0.5,), rounds=1, max_steps=2, samples=8)


@pytest.mark.full
def test_progress_of_a_refinement_is_counted_to_its_end(heliostat, truth):
    """A job's page showed 0 % for its minute."""
    reports: list[tuple[str, int, int]] = []
    refine(
        heliostat,
        images(heliostat, truth)[:4],
        JUELICH_MODEL,
        options=QUICK,
        progress=lambda *counts: reports.append(counts),
    )
    phases = list(dict.fromkeys(phase for phase, _, _ in reports))
    assert phases == [
        "fitting the surface to 4 images",
        "estimating the noise of 4 images",
        "comparing half-samples of the images",
    ]
    shares = [done / total for _, done, total in reports]
    assert shares == sorted(shares)
    assert reports[-1][1] == reports[-1][2] == 14 * SUBSTEPS
    assert 0 < shares[len(reports) // 10] < 1 / 14  # during the first of the 14 minimizations
    assert len(reports) > 2 * 14


def test_refinement_ends_if_progress_raises(heliostat, truth):
    """A job was cancelled 62 s after somebody asked for it."""
    calls = []

    class EnoughError(Exception):
        pass

    def enough(*counts: object) -> None:
        calls.append(counts)
        if len(calls) >= 5:
            raise EnoughError

    with pytest.raises(EnoughError):
        refine(
            heliostat, images(heliostat, truth)[:4], JUELICH_MODEL, options=QUICK, progress=enough
        )
    assert len(calls) <= 6  # the other of two threads stops at its next report
