"""Generic terms: their derivatives are those of the exact changes, and regressions find them."""

from functools import cache

import numpy as np
import pytest

from model.covariates import SCALINGS
from model.effects.generic_kinds import IMAGE_KINDS, mirror_kinds
from model.forecast import View
from model.plant_model import JUELICH_MODEL
from model.study.discrepancy import Design, Fields, GenericTerm, Regression, photographs_to_compare
from model.study.flux_images import Forecaster, centers, spot_window
from model.study.generic_terms import GenericModel
from model.study.halves import LEVEL, MIN_DRIFT_ESTIMATED, Strength, p_equal, strength
from tests.undeclared.adapter import flux_images
from tests.undeclared.generator import generate

CENTERS = np.array([[-0.8, 0.6], [0.8, 0.6], [-0.8, -0.6], [0.8, -0.6]])

KINDS = {kind.name: kind for kind in (*IMAGE_KINDS, *mirror_kinds(CENTERS))}


@cache
def generic_model() -> GenericModel:
    """Forecasts of photographs of a near heliostat, whose light lies within its target."""
    images = flux_images(generate("clean", 0, 7, heliostats=2, setups=2, side=48, fan=4))[:2]
    view = View(48, 48, samples=8, padding=0.125)
    forecaster = Forecaster(images, JUELICH_MODEL, spot_window(images), view)
    return GenericModel(forecaster, [], view)


@pytest.mark.parametrize("name", KINDS)
def test_derivatives_are_those_of_exact_changes(name):
    model = generic_model()
    kind = next(kind for kind in model.kinds if kind.name == name)
    rows = np.arange(len(model.cuts))
    none = np.zeros((len(rows), len(kind.components)))
    derivatives = model.derivatives(kind, rows, model.cuts, none)
    unchanged = model.apply(kind, rows, model.cuts, none)
    for component in {0, len(kind.components) - 1}:
        derivative = derivatives[:, component]
        step = 0.001 / np.abs(derivative).sum(axis=(1, 2)).max()
        amounts = none.copy()
        amounts[:, component] = step
        change = (model.apply(kind, rows, model.cuts, amounts) - unchanged) / step
        coarse = change.reshape(-1, 32, 2, 32, 2).sum(axis=(2, 4))
        error = np.abs(coarse - derivative).sum() / np.abs(derivative).sum()
        assert error < 0.25, kind.components[component]


@pytest.mark.parametrize("name", KINDS)
def test_changed_cuts_are_centred_and_of_sum_one(name):
    model = generic_model()
    kind = next(kind for kind in model.kinds if kind.name == name)
    rows = np.arange(len(model.cuts))
    amounts = np.full((len(rows), len(kind.components)), 0.02)
    cuts = model.apply(kind, rows, model.cuts, amounts)
    np.testing.assert_allclose(cuts.sum(axis=(1, 2)), 1)
    planes = [model.planes[0]] * len(cuts)
    pixel = planes[0].width / cuts.shape[2]
    assert np.abs(centers(cuts, planes)).max() < pixel


def test_a_regression_finds_what_belongs_to_an_owner_and_scales_with_a_covariate():
    rng = np.random.default_rng(0)
    fields = Fields(rng.standard_normal((12, 2, 30)).astype(np.float32), np.ones(2))
    owners = np.arange(12) % 2
    factors = np.stack([np.ones(12), rng.standard_normal(12)], axis=1)
    truth = rng.standard_normal((2, 4))
    design = Design(factors, owners, 2)
    empty = Regression(fields, np.zeros((12, 30)), design)
    regression = Regression(fields, -empty.left(truth), design)
    everything = np.full(12, True)
    found = regression.solve(everything, 1e-9)
    np.testing.assert_allclose(found, truth, atol=1e-5)
    assert np.abs(regression.left_without(np.arange(12) // 2 % 3, 1e-9)).max() < 1e-4
    assert (regression.deviations(found, everything, 1e-9) < 1e-4).all()


def test_a_strength_is_one_where_nothing_is_left():
    derivatives = np.random.default_rng(1).standard_normal((6, 20))
    assert strength(derivatives, np.zeros((6, 20))).value == 1
    assert strength(derivatives, 0.3 * derivatives).value == pytest.approx(0.7)


def test_strengths_differ_by_more_than_their_deviations():
    alike = Strength(1.1, 0.05, 8), Strength(0.9, 0.2, 8)
    apart = Strength(1.4, 0.05, 8), Strength(0.6, 0.05, 8)
    tiny = Strength(1.01, 0.001, 8), Strength(0.99, 0.001, 8)
    assert p_equal(*alike) > LEVEL > p_equal(*apart)
    assert p_equal(*tiny) == 1
    near_and_far = Strength(0.86, 0.04, 8), Strength(1.18, 0.04, 8)  # by estimated surfaces
    assert p_equal(*near_and_far) < LEVEL
    assert p_equal(*near_and_far, MIN_DRIFT_ESTIMATED) == 1


def term(kind: str, scaling: str | None) -> GenericTerm:
    known = {covariate.name: covariate for covariate in SCALINGS}
    return GenericTerm(KINDS[kind], known[scaling] if scaling else None, KINDS[kind].owners[0])


@pytest.mark.parametrize(
    ("first", "second", "related", "photographs"),
    [
        (("mirror", None), ("blur", None), 0.0, "several heliostats under the same sun, and by"),
        (("mirror", "incidence"), ("mirror", None), 0.0, "beyond the range of incidence"),
        (("mirror", "incidence"), ("mirror", "slant range"), 0.9, "incidence with a low slant"),
        (("mirror", "incidence"), ("mirror", "slant range"), -0.9, "incidence with a high slant"),
    ],
)
def test_photographs_that_would_distinguish_terms_vary_what_differs(
    first, second, related, photographs
):
    terms = term(*first), term(*second)
    assert terms[0].competes_with(terms[1])
    assert photographs in photographs_to_compare(*terms, related)
