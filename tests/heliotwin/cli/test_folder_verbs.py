"""The command line on measurement folders: DESIGN.md, section 6, on a made plant and on the real
ones.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliotwin.folder_forecast import forecast_folder
from model.effects.gravity_bending import GravityBending
from model.plant import Cylinder
from service.sources.folder import read_folder
from service.sources.paint_documents import tower_json
from tests.service.command import heliotwin


def succeeds(*arguments: object, returncode: int = 0) -> dict:
    """Run a verb with --json and return its report."""
    done = heliotwin(*arguments, "--json")
    assert done.returncode == returncode, done.stderr
    return json.loads(done.stdout)


def succeeds_but_for(heliostat: str, *arguments: object) -> dict:
    """Run a verb on a folder with one broken heliostat file; return its report."""
    done = heliotwin(*arguments, "--json")
    assert done.returncode == 2
    assert f"all but {heliostat} is done" in " ".join(done.stderr.split())
    return json.loads(done.stdout)


@pytest.mark.full
def test_flux_predict_and_forecast_on_a_made_plant(pair_plant, tmp_path):
    names = sorted(read_folder(pair_plant).plant.heliostats)

    flux = succeeds("flux", pair_plant, "--out", tmp_path / "flux")
    assert len(flux["images"]) == 8
    assert all(entry["accepted"] for entry in flux["images"].values())
    assert json.loads((tmp_path / "flux" / "quality.json").read_text()) == flux
    with np.load(tmp_path / "flux" / "AB12" / "101-flux-centered.npz") as centered:
        assert centered["flux"].shape == (64, 64)
        assert centered["flux"].sum() == pytest.approx(100, rel=1e-4)
    assert (tmp_path / "flux" / "AB12" / "101-flux.png").is_file()

    predictions = succeeds(
        "predict", pair_plant, "--out", tmp_path / "predicted", "--method", "refined", "--images", 3
    )
    assert sorted(predictions["heliostats"]) == names
    assert json.loads((tmp_path / "predicted" / "predictions.json").read_text()) == predictions
    for name in names:
        with np.load(
            tmp_path / "predicted" / name / "Deflectometry" / f"{name}-nurbs-surface.npz"
        ) as surface:
            assert surface["control_points"].shape == (4, 8, 8, 3)
            assert surface["z"].shape == surface["z_std"].shape == (4, 8, 8)
        errors = predictions["heliostats"][name]["against_measured"]
        assert errors["mae_mm"] < errors["mae_ideal_mm"]
        assert len(predictions["heliostats"][name]["images"]) == 3

    done = heliotwin(
        "forecast", pair_plant, "--out", tmp_path / "forecast", "--surfaces", tmp_path / "predicted"
    )
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "forecast" / "forecast.json").read_text())
    assert sorted(report["measurements"]) == sorted(flux["images"])
    with np.load(tmp_path / "forecast" / "AB12" / "101-forecast.npz") as forecast:
        assert forecast["flux"].shape == (256, 256)
        assert forecast["flux"].dtype == np.float32
        assert 300 < forecast["flux"].max() < 20_000
    used = {
        f"{name}/{image}" for name in names for image in predictions["heliostats"][name]["images"]
    }
    entries = report["measurements"]
    assert {key for key, entry in entries.items() if entry["used_for_surface"]} == used
    for part, was_used in (("used_for_surface", True), ("not_used", False)):
        accuracies = [
            entry["accuracy"] for entry in entries.values() if entry["used_for_surface"] is was_used
        ]
        assert report["accuracy_by_use"][part]["accuracy_mean"] == pytest.approx(
            np.mean(accuracies)
        )
    assert (
        f"{len(used)} of {len(entries)} images were used for the surfaces that they judge"
        in " ".join(done.stdout.split())
    )


@pytest.mark.parametrize("verb", ["flux", "predict", "forecast"])
@pytest.mark.parametrize("below", ["", "deeper"])
def test_an_out_that_cannot_be_a_folder_is_refused_first(tmp_path, verb, below):
    """Before anything is read: the measurement folder does not even exist."""
    (tmp_path / "file").write_text("kept")
    done = heliotwin(verb, tmp_path / "absent", "--out", tmp_path / "file" / below)
    assert done.returncode == 2
    assert "is a file; name a folder to write to" in " ".join(done.stderr.split())
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.full
def test_forecast_reaches_the_goal_on_real_images(stj, tmp_path):
    """DESIGN.md, section 8: >= 0.855 in a 6 m window with measured surfaces and no effect; ideal
    ones far below.
    """
    report = succeeds("forecast", stj, "--out", tmp_path, "--window", 6)
    assert report["accuracy_mean"] >= 0.855
    measured = {
        key for key, entry in report["measurements"].items() if entry["surface"] == "measured"
    }
    assert {key.split("/")[0] for key in measured} >= {"AA39", "AC43"}
    assert "AD37" in report["ideal_surfaces"]


@pytest.mark.full
def test_heliostats_without_a_surface_are_forecast_as_ideal_mirrors(pair_plant, tmp_path):
    """They were skipped; the service forecasts them in the same way."""
    root = tmp_path / "plant"
    shutil.copytree(pair_plant, root)
    bare, shaped, *_ = sorted(read_folder(root).plant.heliostats)
    shutil.rmtree(root / bare / "Deflectometry")
    done = heliotwin("forecast", root, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    said, shown = (
        " ".join(done.stdout.split()),
        json.loads((tmp_path / "out" / "forecast.json").read_text()),
    )
    n_heliostats = len({key.partition("/")[0] for key in shown["measurements"]})
    warning = f"1 of {n_heliostats} heliostats have no surface and are forecast as ideal mirrors"
    assert said.index(warning) < said.index("Forecasts")
    assert next(iter(shown)) == "warnings"
    assert shown["ideal_surfaces"] == [bare]
    assert shown["skipped"] == {}
    ideal = forecast_folder(read_folder(root, [bare]), tmp_path / "ideal", "ideal")
    assert ideal["warnings"] == []
    for key, entry in shown["measurements"].items():
        assert entry["surface"] == ("ideal" if key.startswith(bare) else "measured")
        if key.startswith(bare):
            assert entry == ideal["measurements"][key]
    accuracies = [
        entry["accuracy"]
        for entry in shown["measurements"].values()
        if entry["surface"] == "measured"
    ]
    assert (
        shown["accuracy_mean"]
        == shown["accuracy_by_surface"]["measured"]["accuracy_mean"]
        == np.mean(accuracies)
    )
    assert shown["accuracy_by_surface"]["ideal"]["accuracy_mean"] == ideal["accuracy_mean"]
    wanted = (
        "--heliostat",
        bare,
        "--heliostat",
        shaped,
        "--sun",
        "0",
        "45",
        "--target",
        "calibration_target",
    )
    by_sun = succeeds("forecast", root, "--out", tmp_path / "sun", *wanted)
    assert (sorted(by_sun["heliostats"]), by_sun["ideal_surfaces"]) == ([bare, shaped], [bare])
    assert "1 of 2 heliostats have no surface" in by_sun["warnings"][0]


@pytest.mark.full
def test_a_surface_that_cannot_be_read_is_no_missing_one(pair_plant, tmp_path):
    root = tmp_path / "plant"
    shutil.copytree(pair_plant, root)
    bare, *_ = sorted(read_folder(root).plant.heliostats)
    (root / bare / "Deflectometry" / f"{bare}-nurbs-surface.npz").write_bytes(b"broken")
    report = forecast_folder(read_folder(root), tmp_path / "out")
    assert (list(report["skipped"]), report["ideal_surfaces"]) == ([bare], [])


SHOULDER = {"name": "camera_shoulder", "parameters": {"compression": 2.0}}


@pytest.mark.full
@pytest.mark.parametrize(
    "effects", [[], [SHOULDER], [{"name": "sun_shape", "parameters": {"circumsolar_ratio": 0.4}}]]
)
def test_no_effect_of_a_camera_makes_light(single_plant, tmp_path, effects):
    """Whatever the camera: an adopted shoulder made 8.8 kW out of a mirror of 8.2 m2 under 1000
    W/m2.
    """
    (tmp_path / "effects.json").write_text(json.dumps({"effects": effects}))
    report = succeeds(
        "forecast", single_plant, "--out", tmp_path, "--effects", tmp_path / "effects.json"
    )
    folder = read_folder(single_plant)
    for key, entry in report["measurements"].items():
        _, _, half_sizes = folder.plant.heliostats[key.split("/")[0]].facet_frames
        area = 4 * half_sizes.prod(axis=1).sum()
        assert 0.5 * area < entry["power_w"] / 1000 <= area
        with np.load(tmp_path / f"{key}-forecast.npz") as made:
            assert made["flux"].dtype == np.float32
            assert np.array_equal(made["flux"], made["camera_view"]) == (effects != [SHOULDER])


@pytest.mark.full
def test_effects_of_a_studys_report_are_added_to_the_declared_ones(single_plant, tmp_path):
    sigma = {"sigma_mrad": {"value": 2.0, "ci95": [1.9, 2.1], "unit": "mrad"}}
    found = {"verdict": "effect", "effects": [{"name": "slope_error", "parameters": sigma}]}
    (tmp_path / "report.json").write_text(json.dumps(found))
    folder = read_folder(single_plant)
    plain = forecast_folder(folder, tmp_path / "plain")
    known = replace(folder, model=folder.model.with_effects([GravityBending(3.0)]))
    declared = forecast_folder(known, tmp_path / "declared")
    added = succeeds(
        "forecast", single_plant, "--out", tmp_path / "added", "--effects", tmp_path / "report.json"
    )
    assert [effect["name"] for effect in declared["effects"]] == ["gravity_bending"]
    assert added["effects"] == [{"name": "slope_error", "parameters": {"sigma_mrad": 2.0}}]
    for key, entry in plain["measurements"].items():
        assert added["measurements"][key]["peak_w_m2"] < 0.9 * entry["peak_w_m2"]
        assert declared["measurements"][key]["peak_w_m2"] != pytest.approx(
            entry["peak_w_m2"], rel=0.002
        )


@pytest.mark.full
@pytest.mark.parametrize("number", [2, 5])
def test_contract_on_undeclared_sets(undeclared, tmp_path, number):
    folder = undeclared / f"set-{number}"
    predictions = succeeds("predict", folder, "--out", tmp_path / "p")
    assert len(predictions["heliostats"]) == 4
    report = succeeds("forecast", folder, "--out", tmp_path / "f")
    assert len(report["measurements"]) == 36
    assert report["accuracy_mean"] > (0.96 if number == 2 else 0.8)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("predict", "nowhere", "--out", "x"), "no such folder"),
        (("predict", ".", "--out", "x"), "tower-measurements.json"),
        (("predict", "PLANT", "--out", "x", "--method", "magic"), "--method must be"),
        (
            ("predict", "PLANT", "--out", "x", "--method", "magic"),
            "'magic' is not one of 'network', 'refined'",
        ),
        (("predict", "PLANT", "--out", "x", "--images", "many"), "--images must be"),
        (("predict", "PLANT"), "Missing option '--out'"),
        (
            ("predict", "PLANT", "--out", "x", "--images", "9"),
            "images must lie in 1 to 8 for the method network, got 9; refined takes up to 64",
        ),
        (("forecast", "PLANT", "--out", "x", "--surfaces", "nowhere"), "--surfaces must be"),
        (
            ("forecast", "PLANT", "--out", "x", "--effects", "nowhere.json"),
            "nowhere.json: no such file",
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(made_plant, tmp_path, arguments, says):
    done = heliotwin(*(made_plant if a == "PLANT" else a for a in arguments), cwd=Path.cwd())
    assert done.returncode == 2
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not Path("x").exists()


def test_without_a_spot_the_motors_turn_the_heliostat(stj, tmp_path):
    """AA39's kinematics are good to about a degree, so that the light lands within some metres of
    the measured spot.
    """
    import shutil

    for name in ("AA39/Properties", "AA39/Deflectometry"):
        shutil.copytree(stj / name, tmp_path / "plant" / name)
    shutil.copy(stj / "WRI1030197-tower-measurements.json", tmp_path / "plant")
    about = json.loads(
        (stj / "AA39" / "Calibration" / "209075-calibration-properties.json").read_text()
    )
    del about["focal_spot"]
    (tmp_path / "plant" / "AA39" / "Calibration").mkdir()
    (tmp_path / "plant" / "AA39" / "Calibration" / "209075-calibration-properties.json").write_text(
        json.dumps(about)
    )
    by_motor = succeeds("forecast", tmp_path / "plant", "--out", tmp_path / "motor")[
        "measurements"
    ]["AA39/209075"]
    del about["motor_position"]
    (tmp_path / "plant" / "AA39" / "Calibration" / "209075-calibration-properties.json").write_text(
        json.dumps(about)
    )
    by_aim = succeeds("forecast", tmp_path / "plant", "--out", tmp_path / "aim")["measurements"][
        "AA39/209075"
    ]
    assert by_motor["power_w"] > 0.5 * by_aim["power_w"]
    assert by_motor["power_w"] != pytest.approx(by_aim["power_w"], rel=1e-3)


@pytest.mark.full
def test_a_heliostat_without_images_is_skipped_with_its_reason(made_plant, tmp_path):
    import shutil

    root = tmp_path / "plant"
    shutil.copytree(made_plant, root)
    for path in (root / "AC31" / "Calibration").iterdir():
        path.unlink()
    (root / "AB12" / "Properties" / "AB12-heliostat-properties.json").write_text('{"width": 3}')
    (root / "AF27" / "Calibration" / "301-calibration-properties.json").write_text(
        '{"target_name": "moon"}'
    )
    (root / "AF27" / "Calibration" / "302-raw.png").write_bytes(b"not an image")
    report = succeeds_but_for("AB12", "predict", root, "--out", tmp_path / "out", "--images", 1)
    assert sorted(report["heliostats"]) == ["AF27", "AK08"]
    assert report["skipped"]["AC31"] == "no image"
    assert "heliostat_position: is missing" in report["skipped"]["AB12"]
    assert "sun_azimuth: is missing" in report["skipped"]["AF27/301"]
    assert "302-raw.png" in report["heliostats"]["AF27"]["refused"]["302"]
    quality = succeeds_but_for("AB12", "flux", root, "--out", tmp_path / "flux")
    assert "302-raw.png" in quality["skipped"]["AF27/302"]
    assert "AF27/303" in quality["images"]

    for name in ("AF27", "AK08"):
        shutil.rmtree(root / name / "Calibration")
    nothing = heliotwin("predict", root, "--out", tmp_path / "nothing")
    assert nothing.returncode == 1
    assert "AC31: no image" in nothing.stderr
    assert len(nothing.stderr.strip().splitlines()) == 1


@pytest.mark.full
def test_demo_leaves_table_pictures_report_and_store(tmp_path, stj, pair_plant):
    """On one plant and then on another under the same folder, as README has it.

    The real heliostats are one with many photographs, one with few, and one without a surface.
    """
    real = tmp_path / "real"
    for name in ("AA39", "AC43", "AD37"):
        shutil.copytree(stj / name, real / name)
    shutil.copy(stj / "WRI1030197-tower-measurements.json", real)
    made = tmp_path / "made"
    shutil.copytree(pair_plant / "AB12", made / "AB12")
    shutil.copy(pair_plant / "demo-tower-measurements.json", made)
    before = heliotwin("demo", "--data", made, "--out", tmp_path / "demo")
    assert before.returncode == 0, before.stderr
    done = heliotwin("demo", "--data", real, "--out", tmp_path / "demo")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "demo" / "report.json").read_text())
    found = {entry["heliostat"]: entry for entry in report["heliostats"]}
    assert {"AA39", "AC43", "AD37"} <= set(found)
    # On photographs that were kept back the refined surface forecasts no worse than
    # deflectometry's.
    assert found["AA39"]["accuracy_network"] > found["AA39"]["accuracy_ideal"] + 0.1
    assert found["AA39"]["accuracy_refined"] > found["AA39"]["accuracy_measured"] - 0.02
    for entry in found.values():
        for picture in entry["pictures"]:
            assert (tmp_path / "demo" / picture).read_bytes().startswith(b"\x89PNG")
    assert "heliotwin serve" in done.stderr
    assert report["study"]["verdict"] in ("effect", "none", "unexplained")
    assert report["study"]["conclusion"] in " ".join(done.stderr.split())
    page = (tmp_path / "demo" / "report.html").read_text(encoding="utf-8")
    assert '<meta name="viewport"' in page
    assert "forecasts with refined surfaces are" in page
    assert all(
        f'src="{picture}"' in page
        for result in report["heliostats"]
        for picture in result["pictures"]
    )


def test_forecast_for_a_sun_and_a_plane_needs_no_photographs(made_plant, tmp_path):
    name, *_ = sorted(read_folder(made_plant).plant.heliostats)
    wanted = ("--surfaces", "ideal", "--heliostat", name)
    time = ("--at", "2026-06-21T13:36+02:00", "--target", "calibration_target")
    by_time = succeeds("forecast", made_plant, "--out", tmp_path / "a", *wanted, *time)
    assert by_time["sun"]["elevation_deg"] > 60
    flux = np.load(tmp_path / "a" / name / "forecast.npz")["flux"]
    assert flux.max() == pytest.approx(by_time["heliostats"][name]["peak_w_m2"])
    target = read_folder(made_plant).plant.targets["calibration_target"]
    plane = {
        "center": list(target.center),
        "normal": list(target.normal),
        "width": 8.0,
        "height": 8.0,
    }
    (tmp_path / "plane.json").write_text(json.dumps(plane))
    sun = (
        "--sun",
        by_time["sun"]["azimuth_deg"],
        by_time["sun"]["elevation_deg"],
        "--plane",
        tmp_path / "plane.json",
    )
    by_sun = succeeds("forecast", made_plant, "--out", tmp_path / "b", *wanted, *sun)
    assert by_sun["heliostats"][name]["power_w"] == pytest.approx(
        by_time["heliostats"][name]["power_w"], rel=0.02
    )


def test_forecast_on_a_receiver_by_its_name(made_plant, tmp_path):
    """Its map is unrolled, and holds the power that the mirror throws on a plane in its place."""
    root = tmp_path / "plant"
    shutil.copytree(made_plant, root)
    (file,) = root.glob("*tower-measurements.json")
    plant = read_folder(root).plant
    middle = plant.targets["calibration_target"].center + [0.0, 0.0, 12.0]
    drum = Cylinder(
        "drum", middle, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), 8.0, 14.0, 120.0
    )
    tower = tower_json(replace(plant, receivers={"drum": drum}), {})
    file.write_text(json.dumps(json.loads(file.read_text()) | {"drum": tower["drum"]}))
    name, *_ = sorted(plant.heliostats)
    wanted = ("--surfaces", "ideal", "--heliostat", name, "--sun", "0", "45")
    on_drum = succeeds("forecast", root, "--out", tmp_path / "drum", *wanted, "--target", "drum")
    plane = {"center": middle.tolist(), "normal": [0.0, 1.0, 0.0], "width": 14.0, "height": 14.0}
    (tmp_path / "plane.json").write_text(json.dumps(plane))
    beside = succeeds(
        "forecast", root, "--out", tmp_path / "plane", *wanted, "--plane", tmp_path / "plane.json"
    )
    entry = on_drum["heliostats"][name]
    assert on_drum["target"] == "drum"
    assert entry["power_w"] == pytest.approx(beside["heliostats"][name]["power_w"], rel=0.02)
    with np.load(tmp_path / "drum" / name / "forecast.npz") as maps:
        assert set(maps) == {"flux"}
        pixel = drum.width * drum.height / maps["flux"].size
        assert maps["flux"].sum() * pixel == pytest.approx(entry["power_w"], rel=0.01)
        assert maps["flux"].max() == pytest.approx(entry["peak_w_m2"])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--sun", 0, 45), "--target, --plane: give one"),
        (("--target", "calibration_target"), "--sun, --at: give one"),
        (("--sun", 0, 95, "--target", "calibration_target"), "--sun: elevation_deg"),
        (("--at", "2026-06-21T00:00", "--target", "calibration_target"), "--at: the sun is"),
        (
            ("--at", "0001-06-21T11:30", "--target", "calibration_target"),
            "--at: give a year from 1970 on",
        ),
        (
            ("--sun", 0, 45, "--target", "nowhere"),
            "--target: there is no target nowhere; known: calibration_target",
        ),
        (
            ("--sun", 0, 45, "--target", "calibration_target", "--heliostat", "ZZ"),
            "--heliostat: there is no",
        ),
    ],
)
def test_forecast_for_a_sun_says_what_is_wrong(made_plant, tmp_path, options, said):
    done = heliotwin("forecast", made_plant, "--out", tmp_path, *options)
    assert done.returncode == 2
    assert said in done.stderr


def test_help_keeps_its_units():
    assert "Side [m] of the accuracy's window" in " ".join(
        heliotwin("forecast", "--help").stdout.split()
    )
