"""Corrections: what has no name, applied to mirrors, beams and images of cameras."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from model.effects import Since, effect_from_json, effect_to_json, effects_from_json
from model.effects.correction import correction_from_json
from model.errors import InvalidInputError
from model.fleet import Superposition, Tile
from model.forecast import View, align
from model.plant import Cylinder
from model.plant_model import JUELICH_MODEL, PlantModel
from model.study.flux_images import FluxImage, Forecaster
from model.study.generic_terms import GenericModel
from model.study.parameters import copied, copy_name
from model.sunshape import Pillbox
from tests.model.scenes import photographs, setups

VIEW = View(64, 64, samples=12)

ELEVATION = {"covariate": "sun_elevation", "unit": "deg", "center": 30.0, "limits": [20.0, 40.0]}


def entry(kind: str, name: str, value: float, **about: Any) -> dict[str, Any]:
    return {"kind": kind, "name": name, "value": value, "of": None, "per": None} | about


WIDER = entry("sun_moments", "width sidewards", 4.0)
BENT = entry("each facet", "xx", 0.5, per=ELEVATION)
CAMERA = [
    entry("blur", "right", 0.02),
    entry("response", "slope", 0.3),
    entry("geometry", "barrel", 0.1),
    entry("waver", "wave 9 up", 0.1),
    entry("shading", "right", 0.2),
    entry("stripes", "wave 9 right", 0.2),
    entry("added_light", "halo", 0.1),
]


def correction(*entries: dict[str, Any], **about: Any):
    data = {"name": "correction", "parameters": {"coefficients": list(entries)}, **about}
    return effect_from_json(data)


def model_with(*entries: dict[str, Any]) -> PlantModel:
    return JUELICH_MODEL.with_effects([correction(*entries)])


def test_json_is_read_back_with_its_scope():
    scope = {"kind": "since", "since": "2024-06-01", "until": "2024-07-01"}
    one = correction(WIDER, BENT, *CAMERA, scope=scope)
    assert isinstance(one.scope, Since)
    again = effect_from_json(json.loads(json.dumps(effect_to_json(one))))
    assert effect_to_json(again) == effect_to_json(one)


def test_a_report_is_its_correction_and_not_the_effects_that_explain_a_part():
    report = {
        "effects": [{"name": "soiling", "parameters": {}}],
        "window_m": 5.0,
        "discrepancy": {"coefficients": [WIDER | {"ci95": [3, 5], "unit": "mrad2"}]},
    }
    (found,) = effects_from_json(report)
    assert effect_to_json(found)["parameters"] == {"coefficients": [WIDER], "window_m": 5.0}


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({}, "'coefficients'"),
        ({"coefficients": [], "window_m": -1}, "'window_m'"),
        ({"coefficients": [entry("blur", "sideways", 1.0)]}, "known 'kind' and 'name'"),
        ({"coefficients": [entry("blur", "right", True)]}, "a number"),
        ({"coefficients": [entry("blur", "right", 1.0, per={"covariate": "mood"})]}, "'per'"),
    ],
)
def test_what_is_malformed_is_refused(parameters, said):
    with pytest.raises(InvalidInputError, match=said):
        correction_from_json(parameters)


def test_it_has_no_values_by_day():
    with pytest.raises(InvalidInputError, match="by day"):
        correction(WIDER, scope={"kind": "day"})


def test_covariates_count_within_the_limits_that_photographs_covered():
    sun = np.array([0.0, -np.cos(np.radians(70)), np.sin(np.radians(70))])
    high = replace(setups()[0], sun=sun)
    (bent,) = correction(BENT).coefficients
    assert bent.amount(high, JUELICH_MODEL.site) == pytest.approx(0.5 * 10)


def test_what_belongs_to_a_heliostat_changes_no_other_and_its_copies():
    first = "AA39"
    one = correction(entry("mirror", "xx", 0.3, of=first), entry("mirror", "yy", 0.2))
    assert correction(entry("mirror", "xx", 0.3, of=first)).heliostats == [first]
    assert one.heliostats is None
    names = [c.of for c in copied(one, 2).coefficients]
    assert names == [copy_name(first, 0), copy_name(first, 1), None]


def test_what_lives_in_the_camera_never_changes_the_light_on_a_receiver():
    light, camera = model_with(WIDER, BENT), model_with(*CAMERA)
    receiver = Cylinder("r", [0, 2.0, 40], [0, 1, 0], [0, 0, 1], 2.0, 4.0)
    tile = Tile(
        [
            replace(setup, spot=None, aim=receiver.aim_of(setup.heliostat.position))
            for setup in setups()
        ]
    )
    nothing, by_light, by_camera = (
        Superposition(receiver, model, (48, 96))(tile).irradiance
        for model in (JUELICH_MODEL, light, camera)
    )
    np.testing.assert_array_equal(by_camera, nothing)
    assert np.abs(by_light - nothing).max() > 0.01 * nothing.max()
    assert by_light.sum() == pytest.approx(nothing.sum(), rel=0.02)
    aligned = align(setups(), camera)
    before = align(setups(), JUELICH_MODEL).flux(VIEW)
    torch.testing.assert_close(aligned.flux(VIEW), before)
    assert (aligned.images(VIEW) - before).abs().max() > 0.01 * before.max()


def test_a_sun_of_half_the_size_is_traced_as_such():
    """In both directions, against a pillbox of half the radius."""
    halved = model_with(*(entry("sun_size", way, -0.5) for way in ("sidewards", "upwards")))
    half, whole = (
        replace(JUELICH_MODEL.optics, sun_shape=Pillbox(radius)) for radius in (2.3e-3, 4.6e-3)
    )
    expected, before = (
        align(setups(), replace(JUELICH_MODEL, optics=optics)).flux(VIEW)
        for optics in (half, whole)
    )
    flux = align(setups(), replace(halved, optics=whole)).flux(VIEW)
    assert (flux - expected).abs().sum() < 0.02 * (before - expected).abs().sum()


@pytest.mark.parametrize(
    "entries",
    [
        [entry("sun_moments", "width upwards", 3.0)],
        [entry("sun_moments", "skew suu", 1.0)],
        [entry("axis_blur", "about the second axis", 2.0)],
        [entry("sun_size", "sidewards", 0.3)],
        [entry("mirror", "xy", 0.2)],
        [entry("light", "light along x of facet 1", 0.5)],
        *([one] for one in CAMERA),
    ],
)
def test_forecasts_change_as_studies_fit_it(entries):
    """Traced on whole targets, against the change of cuts about the spots."""
    taken: list[FluxImage] = photographs([], days=1)[:2]
    (one,) = entries
    forecaster = Forecaster(taken, JUELICH_MODEL, 5.0, View(192, 192, samples=24))
    fitted = GenericModel(forecaster, [], VIEW)
    kind = next(kind for kind in fitted.kinds if kind.name == one["kind"])
    amounts = np.zeros((len(taken), len(kind.components)))
    amounts[:, [c.name for c in kind.components].index(one["name"])] = one["value"]
    expected = fitted.apply(kind, np.arange(len(taken)), fitted.cuts, amounts)
    data = {"coefficients": [one], "window_m": 5.0}
    cuts = forecaster.cuts([correction_from_json(data)])
    change = np.abs(expected - fitted.cuts).sum()
    assert np.abs(cuts - expected).sum() < 0.25 * change
