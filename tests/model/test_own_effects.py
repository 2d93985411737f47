"""Effects that a plant writes: found like those of the catalogue, and one error for each fault."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from heliotwin.effects import blur_effect, image_effect, load_effects, mirror_effect, mount_effect
from model.effects import CATALOGUE, Always, effect_from_json, effect_to_json
from model.errors import InvalidInputError
from model.forecast import View, align
from model.plant_model import JUELICH_MODEL
from model.study import StudyOptions, study, study_to_json
from tests.model.scenes import photographs, setups

FOCUS = """
import torch
from heliotwin.effects import mirror_effect

mirror_effect(
    "focus_by_hour",
    "Focus by hour: facets bend as the sun warms one side of them.",
    lambda x, y, X, Y, seen: 1e-3 / 2 * (x**2 + y**2) * torch.sin(seen.hour_angle),
    -4, 4, "mrad/m",
)
"""
ABOUT = "An effect: of a test."
VIEW = View(48, 48, samples=12)


@pytest.fixture(autouse=True)
def catalogue() -> Iterator[None]:
    """The catalogue as it was, after each test."""
    before = dict(CATALOGUE)
    yield
    CATALOGUE.clear()
    CATALOGUE.update(before)


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "own.py"
    path.write_text(FOCUS, encoding="utf-8")
    return path


def images(*effects):
    return align(setups(), JUELICH_MODEL.with_effects(effects)).images(VIEW).numpy()


def test_the_amplitude_of_a_hidden_effect_of_the_plant_is_found(own):
    load_effects([own])
    truth = CATALOGUE["focus_by_hour"](amplitude=2.0)
    taken = photographs([truth], days=4)
    options = StudyOptions(candidates=("focus_by_hour", "gravity_bending", "sun_shape"), most=2)
    report = study_to_json(study(taken, JUELICH_MODEL, options))
    assert report["verdict"] == "effect"
    (found,) = report["effects"]
    assert found["name"] == "focus_by_hour"
    amplitude = found["parameters"]["amplitude"]
    assert amplitude["value"] == pytest.approx(2.0, rel=0.05)
    assert amplitude["unit"] == "mrad/m"
    assert report["after"]["accuracy_mean"] > report["before"]["accuracy_mean"] + 0.02
    again = effect_from_json(found)
    assert again.amplitude == amplitude["value"]
    assert effect_from_json(effect_to_json(again)).scope == Always()


def test_mirrors_bend_as_their_function_says_and_keep_it_in_splines():
    mirror_effect("bowl", ABOUT, lambda x, y, X, Y, seen: 1e-3 * X**2, -1, 1, "mm/m2")
    np.testing.assert_allclose(images(CATALOGUE["bowl"]()), images(), rtol=1e-5, atol=0.1)
    scene = align(setups(), JUELICH_MODEL).groups[0].scene
    bent = CATALOGUE["bowl"](0.5).on_setups(scene, setups(), JUELICH_MODEL.site)
    changed = (bent.control_points - scene.control_points)[:, :, 2]
    edge = float(scene.control_points[:, :, 0].abs().max())
    assert changed.max() == pytest.approx(0.5e-3 * edge**2, rel=0.05)
    assert changed.min() >= -1e-5


def test_a_blur_by_slant_range_is_the_same_in_metres():
    blur_effect("haze", ABOUT, lambda seen: 1000 / seen.slant_range, 0, 1, "m")
    scene = align(setups(), JUELICH_MODEL).groups[0].scene
    blurred = CATALOGUE["haze"](0.1).on_setups(scene, setups(), JUELICH_MODEL.site)
    distance = torch.linalg.norm(scene.plane_center - scene.center, dim=-1)
    np.testing.assert_allclose(blurred.pointing_error * distance, 0.1, rtol=1e-5)
    assert images(CATALOGUE["haze"](0.1)).max() < images().max()


def test_mounts_turn_and_cameras_change_what_they_see():
    mount_effect("settled", ABOUT, (0, 0, 2), -3, 3)
    turned, known = images(CATALOGUE["settled"](1.0)), images(CATALOGUE["axis_tilt"](up_deg=1.0))
    np.testing.assert_allclose(turned, known, atol=1e-4 * known.max())
    image_effect("vignette", ABOUT, lambda i, x, y, a: i * (1 - a * (x**2 + y**2)), 0, 0.1, "1/m2")
    assert images(CATALOGUE["vignette"](0.05)).sum() < images().sum()


def test_time_and_temperature_are_known_or_missing_by_name():
    def by_temperature(x, y, X, Y, seen):
        return 1e-4 * x * seen.temperature + 1e-4 * y * torch.tensor([t.hour for t in seen.time])[0]

    mirror_effect("by_temperature", ABOUT, by_temperature, -1, 1, "1")
    options = StudyOptions(candidates=("by_temperature",))
    taken = photographs(days=2)
    with pytest.raises(InvalidInputError, match="by_temperature: near/0 has no temperature"):
        study(taken, JUELICH_MODEL, options)
    known = [replace(p.setup, temperature_c=20.0) for p in taken]
    assert align(known, JUELICH_MODEL.with_effects([CATALOGUE["by_temperature"](0.1)])).groups
    timeless = [replace(setup, taken_at=None) for setup in known]
    with pytest.raises(InvalidInputError, match="has no time"):
        align(timeless, JUELICH_MODEL.with_effects([CATALOGUE["by_temperature"](0.1)]))


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (None, "no such file of effects"),
        ("x = 1", "adds no effect; call mirror_effect"),
        ("import nowhere", "its code fails: ModuleNotFoundError: No module named 'nowhere'"),
        ("def (", "its code fails: SyntaxError"),
        (FOCUS.replace('"focus_by_hour"', '"sun_shape"'), "the catalogue has one of this name"),
        (FOCUS.replace('"focus_by_hour"', '"Focus!"'), "lower-case letters"),
        (FOCUS.replace("-4, 4", "1, 4"), "bounds with zero between"),
    ],
)
def test_a_missing_or_broken_file_is_one_error(own, code, says):
    own.unlink() if code is None else own.write_text(code)
    with pytest.raises(InvalidInputError, match=says) as raised:
        load_effects([own])
    assert str(own) in str(raised.value)


@pytest.mark.parametrize(
    ("function", "says"),
    [
        (lambda x, y, X, Y, seen: torch.ones(7), "must return"),
        (lambda x, y, X, Y, seen: x * seen.wind, "its code fails: AttributeError"),
    ],
)
def test_a_broken_function_ends_a_study_in_words(function, says):
    mirror_effect("broken", ABOUT, function, -1, 1, "1")
    with pytest.raises(InvalidInputError, match=f"effect broken: .*{says}"):
        study(photographs(days=2), JUELICH_MODEL, StudyOptions(candidates=("broken",)))


def test_effects_of_installed_packages_are_added(tmp_path, monkeypatch):
    (tmp_path / "plant_effects.py").write_text(FOCUS)
    about = tmp_path / "plant-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: plant\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[heliotwin.effects]\nplant = plant_effects\n")
    monkeypatch.syspath_prepend(tmp_path)
    load_effects()
    assert "focus_by_hour" in CATALOGUE
    (tmp_path / "plant_effects.py").unlink()
    monkeypatch.delitem(__import__("sys").modules, "plant_effects")
    with pytest.raises(InvalidInputError, match="plant of the entry points"):
        load_effects()


def test_an_unknown_effect_names_the_remedy():
    with pytest.raises(InvalidInputError, match="--effects-from"):
        effect_from_json({"name": "focus_by_hour"})
