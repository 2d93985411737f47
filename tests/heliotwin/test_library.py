"""``import heliotwin``: what it returns is what the command line writes, and wrong arguments are
refused by name with a remedy.
"""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import heliotwin
from model.plant import Heliostat
from model.surface import control_points
from service.sources.folder import read_folder
from tests.service.command import heliotwin as command

NOON = datetime(2026, 6, 21, 11, 36, tzinfo=UTC)


@pytest.fixture(scope="module")
def plant(made_plant: Path) -> Iterator[heliotwin.PlantFolder]:
    with heliotwin.open_plant(made_plant) as opened:
        yield opened


def written(folder: Path, *arguments: object) -> Path:
    """Where the command wrote its files."""
    done = command(*arguments, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_the_import_loads_nothing_heavy():
    code = "import sys, heliotwin; sys.exit(any(m in sys.modules for m in sys.argv[1:]))"
    heavy = ["torch", "onnxruntime", "sqlalchemy", "numpy"]
    assert subprocess.run([sys.executable, "-c", code, *heavy], check=False).returncode == 0


def test_every_public_name_is_there():
    for name in heliotwin.__all__:
        assert getattr(heliotwin, name).__doc__
    assert dir(heliotwin) == heliotwin.__all__
    with pytest.raises(AttributeError, match="no attribute 'open_plants'"):
        _ = heliotwin.open_plants


def test_results_have_short_words_plots_and_tables():
    """Arrays are neither printed nor tabled; a map is drawn in metres."""
    mirror = Heliostat.juelich("AB12", (0.0, 50.0, 2.0), 50.0)
    z = np.zeros((4, 8, 8))
    z[0] += 1e-3
    surface = heliotwin.Surface("AB12", "given", z, control_points(mirror, z))
    light = np.ones((4, 6), np.float32) * 2e3
    flux = heliotwin.Flux(light, (6.0, 4.0), 2e3, 48e3, None, None, (200.0, 45.0))
    photograph = heliotwin.Photograph("101", "main", (200.0, 45.0), NOON, None, light)
    compared = heliotwin.Comparison(photograph, light, 0.9, 4.0, True)
    assert repr(surface) == "Surface(AB12, given, 4 facets)"
    assert repr(flux) == "Flux(6 x 4 m, peak 2 kW/m2, power 48 kW, sun 200.0, 45.0 deg)"
    for one in (photograph, compared):
        assert len(repr(one)) < 240
        assert "array" not in repr(one)
    table = heliotwin.to_frame([compared, compared])
    assert list(table.accuracy) == [0.9, 0.9]
    assert list(table.identifier) == ["101", "101"]
    assert heliotwin.to_frame([surface]).heliostat[0] == "AB12"
    effect = {"name": "slope_error", "parameters": {"x_mrad": {"value": 1.0, "ci95": (0.5, 1.5)}}}
    study = heliotwin.StudyResult("effect", "", [effect], 0.8, 0.9, {})
    assert study.parameters.iloc[0].tolist() == ["slope_error", "x_mrad", 1.0, 0.5, 1.5]
    axes = Figure().subplots(1, 3)
    assert surface.plot(ax=axes[0]) is axes[0]
    heights = axes[0].images[0].get_array()
    assert heights[:20, :20].max() == pytest.approx(1.0)  # the first facet is the upper left
    assert np.nanmax(np.abs(heights[-20:])) == pytest.approx(0.0)
    assert flux.plot(ax=axes[1]).images[0].get_extent() == [-3, 3, -2, 2]
    assert axes[1].images[0].get_array().max() == pytest.approx(2.0)
    photograph.plot(ax=axes[2])
    assert "101" in axes[2].get_title()


def test_the_field_is_drawn_from_above(plant):
    assert "4 heliostats" in repr(plant)
    axes = Figure().subplots()
    assert plant.plot({"AB12": 0.9}, "accuracy", axes) is axes
    hollow, coloured = axes.collections[:2]
    assert (len(hollow.get_offsets()), len(coloured.get_offsets())) == (3, 1)
    with pytest.raises(heliotwin.InvalidInputError, match="ZZ99"):
        plant.plot({"ZZ99": 1.0})


@pytest.mark.full
def test_a_plant_has_its_names(plant):
    assert plant.heliostats == ("AB12", "AC31", "AF27", "AK08")
    assert plant.targets == ("calibration_target",)
    assert plant.skipped == {}
    photographs = plant.photographs("AB12")
    assert [one.identifier for one in photographs] == ["101", "102", "103", "104"]
    assert photographs[0].flux.sum() == pytest.approx(100, rel=1e-4)
    assert photographs[0].centered.shape == (64, 64)


@pytest.mark.full
def test_surfaces_are_measured_ideal_or_given(plant, made_plant):
    measured, ideal = plant.surface("AB12"), plant.surface("AB12", "ideal")
    heights = np.full((4, 8, 8), 1e-3)
    given = plant.surface("AB12", heights)
    assert [one.source for one in (measured, ideal, given)] == ["measured", "ideal", "given"]
    known = read_folder(made_plant).measured_surface("AB12")
    np.testing.assert_array_equal(measured.control_points, known[0])
    np.testing.assert_allclose(plant.surface("AB12", measured.z).z, measured.z)
    assert not ideal.z.any()
    mirror = read_folder(made_plant).plant.heliostats["AB12"]
    np.testing.assert_array_equal(given.control_points, control_points(mirror, heights))


def test_a_forecast_is_the_commands(plant, made_plant, tmp_path):
    options = ["--sun", 200, 45, "--target", "calibration_target", "--surfaces", "measured"]
    out = written(tmp_path, "forecast", made_plant, "--heliostat", "AB12", *options)
    found = plant.forecast(plant.surface("AB12"), on="calibration_target", sun=(200, 45))
    maps = np.load(out / "AB12" / "forecast.npz")
    np.testing.assert_array_equal(found.flux, maps["flux"])
    np.testing.assert_array_equal(found.camera_view, maps["camera_view"])
    entry = json.loads((out / "forecast.json").read_text())["heliostats"]["AB12"]
    assert found.peak_w_m2 == entry["peak_w_m2"]
    assert found.power_w == entry["power_w"]
    assert found.center_of_mass_m.tolist() == entry["center_of_mass_m"]


def test_a_forecast_at_a_time_on_any_plane_is_the_commands(plant, made_plant, tmp_path):
    board = {"center": [0, 5, 30], "normal": [0, 1, 0], "width": 6, "height": 4}
    (tmp_path / "plane.json").write_text(json.dumps(board))
    options = ["--at", NOON.isoformat(), "--plane", tmp_path / "plane.json"]
    out = written(tmp_path / "out", "forecast", made_plant, *options, "--surfaces", "ideal")
    plane = heliotwin.plane((0, 5, 30), normal=(0, 1, 0), width_m=6, height_m=4)
    found = plant.forecast(plant.surface("AC31", "ideal"), on=plane, sun=NOON)
    np.testing.assert_array_equal(found.flux, np.load(out / "AC31" / "forecast.npz")["flux"])
    assert found.size_m == (6, 4)
    report = json.loads((out / "forecast.json").read_text())
    assert found.sun_deg == tuple(report["sun"].values())


def test_power_scales_with_irradiance_and_the_spot_follows_the_aim(plant):
    surface, size = plant.surface("AB12"), (64, 48)
    options = {"on": "calibration_target", "sun": (200, 45), "resolution": size}
    full = plant.forecast(surface, **options)
    half = plant.forecast(surface, **options, dni_w_m2=500, aim_m=(1, 0, 40))
    assert half.flux.shape == size
    assert half.power_w == pytest.approx(full.power_w / 2, rel=0.02)
    # A target that faces north has west on its right.
    assert half.center_of_mass_m[0] - full.center_of_mass_m[0] == pytest.approx(-1, abs=0.02)


@pytest.mark.full
def test_a_prediction_is_the_commands(plant, single_plant, tmp_path):
    out = written(tmp_path, "predict", single_plant)
    entry = json.loads((out / "predictions.json").read_text())["heliostats"]["AB12"]
    found = plant.predict("AB12")
    stored = np.load(out / "AB12" / "Deflectometry" / "AB12-nurbs-surface.npz")
    for name in ("z", "z_std", "control_points"):
        np.testing.assert_array_equal(getattr(found, name), stored[name])
    assert list(found.images) == entry["images"]
    assert found.misfit == pytest.approx(entry["misfit"], abs=1e-4)


@pytest.mark.full
def test_named_photographs_are_held_out_or_not(plant):
    found = plant.predict("AB12", images=["101", "103"])
    assert found.images == ("101", "103")
    compared = plant.compare(found)
    assert [one.is_held_out for one in compared] == [False, True, False, True]


@pytest.mark.full
def test_a_comparison_is_the_commands(plant, single_plant, tmp_path):
    out = written(tmp_path, "forecast", single_plant, "--surfaces", "measured")
    entries = json.loads((out / "forecast.json").read_text())["measurements"]
    for one in plant.compare(plant.surface("AB12")):
        entry = entries[f"AB12/{one.photograph.identifier}"]
        assert (one.accuracy, one.window_m) == (entry["accuracy"], entry["window"])
        assert one.forecast.shape == one.photograph.flux.shape


@pytest.mark.full
def test_a_study_is_the_commands_and_its_effects_act(made_plant, tmp_path):
    root = tmp_path / "plant"
    root.mkdir()
    for path in made_plant.iterdir():
        (root / path.name).symlink_to(path)
    declared = {"declared": {"sun": {"shape": "buie", "circumsolar_ratio": 0.3}}}
    (root / "twin.json").write_text(json.dumps(declared))
    plant = heliotwin.open_plant(root)
    found = plant.study()
    done = command("study", root, "--out", tmp_path / "report.json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert found.effects == report["effects"]
    assert (found.verdict, found.conclusion) == (report["verdict"], report["conclusion"])
    assert found.accuracy_after == report["after"]["accuracy_mean"]
    better = plant.with_effects(found)
    assert accuracy_of(better) > accuracy_of(plant) + 0.005


def accuracy_of(plant: heliotwin.PlantFolder) -> float:
    """Mean accuracy of forecasts by measured surfaces."""
    surfaces = map(plant.surface, plant.heliostats)
    return float(np.mean([one.accuracy for s in surfaces for one in plant.compare(s)]))


def test_a_closed_plant_says_so(made_plant):
    with heliotwin.open_plant(made_plant, ["AB12"]) as plant:
        assert plant.heliostats == ("AB12",)
    with pytest.raises(heliotwin.InvalidInputError, match="closed; open it again"):
        plant.photographs("AB12")


def test_a_demonstration_that_is_there_is_opened(made_plant):
    assert heliotwin.make_demo(made_plant).heliostats == ("AB12", "AC31", "AF27", "AK08")


SUNS = {
    (0.1, -0.7, 0.7): "sun: give azimuth from north over east and elevation, two numbers",
    (200.0, -5.0): "sun: the elevation -5 must be above the horizon",
    (200.0, 0.0): "sun: the elevation 0 must be above the horizon",
    (45.0, 200.0): "give azimuth first, then elevation",
    (-20.0, 45.0): "sun: the azimuth -20 must lie in 0 to 360 degrees, from north",
    (float("nan"), 45.0): "sun: give azimuth",
    "noon": "sun: give azimuth",
    45.0: "sun: give azimuth",
    datetime(2026, 6, 21, 11): "sun: the time 2026-06-21T11:00:00 has no zone; give one",
    datetime(2026, 6, 21, 23, tzinfo=UTC): "below the horizon; give a time by day",
    datetime(1920, 6, 21, 11, tzinfo=UTC): "sun: give a year from 1970 on",
}


@pytest.mark.parametrize("sun", SUNS, ids=str)
def test_a_wrong_sun_is_refused(plant, sun):
    with pytest.raises(heliotwin.InvalidInputError, match=re.escape(SUNS[sun])):
        plant.forecast(plant.surface("AB12"), on="calibration_target", sun=sun)


def refusals(plant: heliotwin.PlantFolder) -> dict[str, object]:
    """Calls that must be refused, by what the error says."""
    surface, square = plant.surface("AB12"), {"width_m": 6, "height_m": 6}
    there = {"on": "calibration_target", "sun": (200, 45)}

    def forecast(**changes: object) -> None:
        plant.forecast(surface, **(there | changes))

    def plane(center: object = (0, 5, 30), normal: object = (0, 1, 0), **changes: object) -> None:
        heliotwin.plane(center, normal, **(square | changes))

    return {
        "folder: there is no folder nowhere; give": lambda: heliotwin.open_plant("nowhere"),
        "heliostat: there is no 'ZZ99'; give one of AB12, AC31": lambda: plant.surface("ZZ99"),
        "heliostat: there is no 'ZZ98'": lambda: plant.photographs("ZZ98"),
        "heliostat: there is no 'ZZ97'": lambda: plant.predict("ZZ97"),
        "z: there is no 'best'; give one of measured, ideal": lambda: plant.surface("AB12", "best"),
        "z: give finite control heights of the shape (4, 8, 8); got (8, 8)": lambda: plant.surface(
            "AB12", np.zeros((8, 8))
        ),
        "z: heights are in metres and at most 0.1; got up to 1": lambda: plant.surface(
            "AB12", np.ones((4, 8, 8))
        ),
        "on: there is no 'board'; give one of calibration_target": lambda: forecast(on="board"),
        "on: there is no 7": lambda: forecast(on=7),
        "aim_m: give three numbers, east, north and up": lambda: forecast(aim_m=(1, 2)),
        "dni_w_m2: give a number above 0 [W/m2]; got -1": lambda: forecast(dni_w_m2=-1),
        "resolution: give rows and columns, two integers from 8 to 1024; got 64": lambda: forecast(
            resolution=64
        ),
        "got (4, 64)": lambda: forecast(resolution=(4, 64)),
        "center_m: give three numbers": lambda: plane(center="middle"),
        "normal: give three numbers": lambda: plane(normal=(0, 1)),
        "normal must not vanish and up must not be parallel": lambda: plane(up=(0, 2, 0)),
        "width_m: give a number above 0 [m]; got 0": lambda: plane(width_m=0),
        "one must be no more than 20 times the other": lambda: plane(height_m=600),
        "method must be 'network' or 'refined', got 'magic'": lambda: plant.predict(
            "AB12", "magic"
        ),
        "images must lie in 1 to 8 for the method network, got 9": lambda: plant.predict(
            "AB12", images=9
        ),
        "images must lie in 1 to 8 for the method network, got 0": lambda: plant.predict(
            "AB12", images=[]
        ),
        "images: there is no '999'; give one of 101, 102": lambda: plant.predict(
            "AB12", images=["999"]
        ),
        "candidates: there is no 'magic'; give one of": lambda: plant.study(candidates=["magic"]),
    }


@pytest.mark.full
def test_wrong_arguments_are_refused_by_name(plant):
    for says, call in refusals(plant).items():
        with pytest.raises(heliotwin.InvalidInputError, match=re.escape(says)):
            call()


def test_what_cannot_be_reached_is_an_error_of_the_library(plant):
    behind = heliotwin.plane((0, 200, 2), normal=(0, 1, 0), width_m=6, height_m=6)
    with pytest.raises(heliotwin.HeliotwinError):
        plant.forecast(plant.surface("AB12"), on=behind, sun=(20, 10), aim_m=(0, 62, -50))
