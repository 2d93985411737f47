"""A small part of ``python -m benchmarks.study``: effects that the model does not declare are
found.
"""

from dataclasses import replace
from datetime import timedelta
from functools import cache
from typing import Any

import numpy as np
import pytest

from heliotwin.folder_study import study_folder
from model.effects import CATALOGUE
from model.forecast import View, align
from model.metrics import compare_on_target
from model.plant_model import JUELICH_MODEL
from model.study import StudyOptions, study, study_to_json
from service.base.settings import FIGURE_SCALES
from service.drawing.study_report import study_page
from service.sources.folder import read_folder
from tests.undeclared import world
from tests.undeclared.adapter import effects_of, flux_images, setups_of, write_folder
from tests.undeclared.generator import MeasurementSet, generate, generate_season

STRONG = 2

OPTIONS = StudyOptions(
    candidates=(
        "sun_shape",
        "slope_error",
        "camera_response",
        "camera_blur",
        "background",
        "facet_canting",
    ),
    most=2,
)
"""Some of the catalogue, look-alikes among them: enough to be wrong, and few enough for a test."""


MOVING = StudyOptions(
    candidates=("axis_tilt", "sun_position", "pylon_bending", "encoder_offset"),
    most=1,
    fit_view=View(24, 24, samples=4, padding=0.125),
    view=View(48, 48, samples=8),
)


@cache
def measured(case: str) -> MeasurementSet:
    """A small set with few rays."""
    return generate(case, STRONG, 5, heliostats=3, setups=5, side=128, fan=16)


@cache
def report(case: str) -> dict[str, Any]:
    """The study of a small set."""
    return study_to_json(study(flux_images(measured(case)), JUELICH_MODEL, options=OPTIONS))


def test_the_generator_has_every_effect_of_the_catalogue():
    # Mirrors of that world have no neighbours: tests/model/test_known_neighbours.py has some.
    assert set(world.CATALOGUE) == set(CATALOGUE) - {"known_neighbours"}


@pytest.mark.parametrize("case", ["clean", *world.CATALOGUE])
def test_the_model_with_the_truth_explains_what_the_generator_throws(case):
    """Generator and model share no code, so that each is a test of the other."""
    made = generate(case, STRONG, 3, heliostats=2, setups=1, side=128, fan=16)
    setups, effects = setups_of(made), effects_of(made)
    forecasts = align(setups, JUELICH_MODEL.with_effects(effects)).images(View(96, 96)).numpy()
    for setup, image, forecast in zip(setups, made.images, forecasts, strict=True):
        size = (setup.plane.width, setup.plane.height)
        assert compare_on_target(image, forecast, size, 4.0, 32).accuracy > 0.97


def test_nothing_is_found_in_clean_images():
    assert report("clean")["verdict"] == "none"
    assert report("clean")["effects"] == []


@pytest.mark.parametrize(
    ("case", "parameter", "error"),
    [("camera_response", "gamma", 0.03), ("sun_shape", "circumsolar_ratio", 0.03)],
)
def test_a_strong_effect_is_found_with_its_parameter(case, parameter, error):
    (truth,) = measured(case).truth
    found = report(case)["effects"]
    assert report(case)["verdict"] == "effect"
    assert [effect["name"] for effect in found] == [case]
    assert found[0]["parameters"][parameter]["value"] == pytest.approx(
        truth["parameters"][parameter], abs=error
    )
    assert report(case)["after"]["accuracy_mean"] > report(case)["before"]["accuracy_mean"] + 0.02


def test_canting_is_found_facet_by_facet():
    (truth,) = measured("facet_canting").truth
    found = report("facet_canting")["effects"]
    assert [effect["name"] for effect in found] == ["facet_canting"]
    for axis in ("x_mrad", "y_mrad"):
        for heliostat, tilts in truth["parameters"][axis].items():
            value = np.array(found[0]["parameters"][axis]["value"][heliostat])
            np.testing.assert_allclose(value - value.mean(), tilts, atol=0.1)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("case", world.MOVING)
def test_what_moves_spots_is_named_by_spot_and_shape_and_not_by_shape_alone(case, seed):
    made = generate(case, STRONG, seed, heliostats=3, setups=10, side=24, fan=4)
    name, _ = world.MOVING[case]
    reports = [
        study_to_json(study(flux_images(made, said), JUELICH_MODEL, options=MOVING))
        for said in (made.encoders(seed), None)
    ]
    by_both, by_shape = reports
    assert [(effect["name"], effect["lookalikes"]) for effect in by_both["effects"]] == [(name, [])]
    assert by_both["verdict"] == "effect"
    assert by_both["before"]["position_error_mrad"] > 5 * by_both["after"]["position_error_mrad"]
    assert by_shape["effects"] == []
    assert "position_error_mrad" not in by_shape["before"]


def test_a_drive_that_lost_steps_since_its_calibration_is_named_with_its_day():
    """Mounts were calibrated before the first photograph: what is found came thereafter, and of one
    heliostat.
    """
    made = generate_season("encoder_since", STRONG, 1, days=(8, 8), side=24, fan=4)
    until, images = made.plans[0].day - timedelta(days=30), []
    for plan, image in zip(made.plans, flux_images(made, made.encoders(1)), strict=True):
        heliostat = image.setup.heliostat
        mount = replace(heliostat.mount, is_calibrated=True, calibrated_until=until)
        setup = replace(
            image.setup, heliostat=replace(heliostat, mount=mount), taken_at=plan.moment
        )
        images.append(replace(image, setup=setup))
    done = study(images, JUELICH_MODEL, options=MOVING)
    found, page = study_to_json(done)["effects"], study_page(done, "season", FIGURE_SCALES)
    assert "Light from where motors sent it" in page
    assert "mrad from where motors sent it" in page
    assert [(effect["name"], effect["scope"]) for effect in found] == [
        (t["name"], t["scope"]) for t in made.truth
    ]
    (heliostat,) = made.truth[0]["scope"]["heliostats"]
    for axis in ("first_deg", "second_deg"):
        value = found[0]["parameters"][axis]["value"][heliostat]
        assert value == pytest.approx(made.truth[0]["parameters"][axis][heliostat], abs=0.05)


def test_what_no_effect_describes_is_a_discrepancy_that_corrects():
    found = report("facet_focus")
    assert found["verdict"] == "unexplained"
    assert found["partly"] == [effect["name"] for effect in found["effects"]]
    discrepancy = found["discrepancy"]
    assert discrepancy["lives_in"] in (None, "mirror")
    assert discrepancy["accuracy_after"] > found["before"]["accuracy_mean"] + 0.02
    assert discrepancy["accuracy_gain"]["ci95"][0] > 0
    assert {"kind", "name", "of", "unit", "value", "ci95", "per"} == set(
        discrepancy["coefficients"][0]
    )
    assert discrepancy["in_words"] in found["conclusion"]


def test_a_change_is_found_with_its_day(tmp_path):
    """A camera with changed settings, in photographs of a sunlit sheet, as a user gives them."""
    made = generate_season("response_since", STRONG, 2, days=(5, 5), side=128, fan=16)
    folder = read_folder(write_folder(made, tmp_path))
    options = StudyOptions(candidates=("camera_response", "sun_shape"), most=1)
    (found,), (truth,) = study_folder(folder, options=options).to_json()["effects"], made.truth
    assert (found["name"], found["scope"]) == (truth["name"], truth["scope"])
    assert found["parameters"]["gamma"]["value"] == pytest.approx(
        truth["parameters"]["gamma"], abs=0.05
    )
