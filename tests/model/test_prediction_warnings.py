"""Warnings about surfaces whose photographs are explained."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.effects.soiling import Soiling
from model.forecast import align
from model.metrics import flux_accuracy
from model.network.predictor import juelich_kind
from model.observation import Observation, render_observations
from model.plant import Facet, Heliostat
from model.plant_model import JUELICH_MODEL
from model.prediction_warnings import (
    canting_warnings,
    facet_light_warnings,
    geometry_warnings,
    network_warnings,
)
from model.prior import default_prior
from model.refinement import refine
from tests.conftest import flat_heliostat, target
from tests.model.scenes import SUNS, setups
from tests.rendered import observe


def seen(heliostat: Heliostat, **changes: object) -> list[Observation]:
    """What one sees of its mean surface."""
    plane = target()
    blank = np.ones((64, 64), np.float32)
    places = [Observation(blank, sun, plane, plane.center, "1") for sun in SUNS[:2]]
    images = render_observations(heliostat, places, default_prior().mean, JUELICH_MODEL, samples=12)
    return [
        replace(o, flux=image.astype(np.float32), **changes)
        for o, image in zip(places, images, strict=True)
    ]


def near() -> Heliostat:
    return flat_heliostat((15.0, 75.0, 1.8), focal_length=85.0)


def test_nothing_speaks_against_a_mirror_of_the_known_kind_nearby():
    assert geometry_warnings(near(), seen(near())) == []
    assert canting_warnings(default_prior(), default_prior().mean) == []
    assert facet_light_warnings([0.02, -0.02, 0.13, -0.13], [0.04] * 4) == []


def test_far_mirrors_are_named_with_their_spots():
    far = flat_heliostat((15.0, 450.0, 1.8), focal_length=450.0)
    distance, spots = geometry_warnings(far, seen(far))
    assert distance.startswith("the target is 452 m away")
    assert "larger than the window" in spots


def test_facets_of_another_size_and_clipped_photographs_are_named():
    large = [Facet(f.position, 1.5 * f.canting_x, f.canting_y) for f in near().facets]
    (said,) = network_warnings(replace(near(), facets=tuple(large)), seen(near()), juelich_kind())
    assert "2.41 m x 1.28 m" in said
    assert network_warnings(near(), seen(near()), juelich_kind()) == []
    (said,) = geometry_warnings(near(), seen(near(), clipped=np.ones((64, 64), np.float32)))
    assert "are saturated" in said


def test_a_facet_that_was_knocked_is_named():
    """By its canting against the others'; a tilt of the whole mirror is the mount's."""
    prior = default_prior()
    x = np.linspace(-0.8, 0.8, 8)[:, None] * np.ones(8)
    tilted = prior.mean + 4e-3 * x
    assert canting_warnings(prior, tilted) == []
    tilted[2] += 4e-3 * x
    (said,) = canting_warnings(prior, tilted)
    assert said.startswith("facet 3 is canted")


@pytest.mark.full
def test_a_facet_without_light_is_named():
    """Though a bent surface explains the photographs nearly as well."""
    heliostat, prior = near(), default_prior()
    truth = prior.surface(np.random.default_rng(2).normal(0, 0.5, len(prior.basis)))
    whole = observe(heliostat, truth, SUNS, [target()] * len(SUNS), np.random.default_rng(5))
    dark = [Soiling({heliostat.name: [1.0, 0.0, 1.0, 1.0]})]
    images = render_observations(heliostat, whole, truth, JUELICH_MODEL.with_effects(dark))
    photographs = [
        replace(o, flux=image.astype(np.float32)) for o, image in zip(whole, images, strict=True)
    ]
    found = refine(heliostat, photographs, JUELICH_MODEL)
    assert not found.suspicious
    assert not found.trusted
    (said,) = (one for one in found.warnings if "light of the others" in one)
    assert said.startswith("facet 2 sends")


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_soiled_facets_send_their_share(share: float):
    given = setups(2)
    aligned = align(given, JUELICH_MODEL, dtype=torch.float64)
    whole, soiled = (
        a.flux().sum().item()
        for a in (aligned, aligned.with_facet_light(torch.tensor([share, 1, 1, 1])))
    )
    assert soiled / whole == pytest.approx((3 + share) / 4, abs=5e-3)
    twice = aligned.with_facet_light(torch.tensor([share, 1, 1, 1])).with_facet_light(
        torch.tensor([1, share, 1, 1])
    )
    assert twice.flux().sum().item() / whole == pytest.approx((2 + 2 * share) / 4, abs=5e-3)
    once, again = (
        a.flux_images().numpy() for a in (aligned, aligned.with_facet_light(torch.ones(4)))
    )
    assert all(flux_accuracy(a, b) > 0.999 for a, b in zip(once, again, strict=True))
