"""``heliotwin calibrate`` and ``heliotwin spot`` on a made folder with faults, and on real
heliostats.
"""

import json
import shutil
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.folders import read_readings
from benchmarks.pointing import Plant, with_clock
from heliotwin.cli.main import app
from heliotwin.folder_pointing import calibrate_folder, spot_folder
from heliotwin.folder_store import open_folder
from model.effects import Since
from model.effects.encoder_offset import EncoderOffset
from model.errors import InvalidInputError
from model.forecast import align
from model.imaging import center_of_mass
from model.plant_model import PlantModel
from model.pointing import Weather, calibrate_field
from model.pointing.report import day_of, mount_to_json
from model.setup import Setup
from model.study import FluxImage
from model.surface import control_points
from service.base.errors import ConflictError
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.twin.calibration import calibrate_store, make_plan
from service.twin.importing import import_folder
from service.twin.runtime import Runtime
from service.twin.stored_mount import load_mount
from tests.heliotwin.cli.motor_folder import write, write_measurement
from tests.service.conftest import QUIET, properties_document, tower_document
from tests.service.spots import photographs


@pytest.mark.full
def test_the_demonstrations_motors_tell_where_its_mirrors_point(pair_plant: Path, tmp_path: Path):
    runtime = Runtime.from_settings(Settings(data_dir=tmp_path, **QUIET))
    runtime.database.upgrade()
    source = read_folder(pair_plant)
    import_folder(runtime, source)
    plan = make_plan(runtime, datetime(2026, 6, 21, 10, tzinfo=UTC), minutes=60, photographs=12)
    assert {slot.proposal.heliostat for slot in plan} == set(source.plant.heliostats)
    calibrated = calibrate_store(runtime, list(source.plant.heliostats))
    runtime.close()
    assert calibrated.skipped == {}
    for name, mount in calibrated.done.mounts.items():
        document = mount_to_json(
            mount, calibrated.done.readings[name], calibrated.done.contradictions[name]
        )
        assert document["predicted_error_mrad"]["median"] < 3, name


def test_what_cannot_be_used_is_listed_and_costs_nothing_else(folder: Path, tmp_path: Path):
    report = calibrate_folder(read_folder(folder), tmp_path / "mounts.json")
    assert report == json.loads((tmp_path / "mounts.json").read_text())
    assert report["heliostats"]["AA39"]["measurements"] == 16
    assert report["heliostats"]["AA39"]["predicted_error_mrad"]["median"] < 1
    said = {
        "AA39/200": "no motor_position",
        "AA39/201": "no place of its spot",
        "AA39/202": "sun_azimuth: is missing",
        "AA39/203": "off every target",
        "AA39/204": "beyond the travel",
        "AB01": "no actuators",
        "AB02": "no measurement",
        "AB09": "no 'AB09-heliostat-properties.json'",
    }
    assert set(report["skipped"]) == set(said)
    assert all(words in report["skipped"][key] for key, words in said.items())
    days = report["heliostats"]["AA39"]["history"]["at"]
    assert days[:5] == [None] * 5
    assert days[5:] == sorted(days[5:])
    assert report["heliostats"]["AA39"]["undated"] == 5
    assert report["undated"] == {"used": 5, "left_out": 0}
    assert set(report["parameters"]) == set(report["heliostats"]["AA39"]["parameters"])
    assert {entry["unit"] for entry in report["parameters"].values()} == {"m", "rad"}


def test_photographs_that_a_mount_has_not_seen_say_where_motors_sent_the_light(tmp_path: Path):
    """The first drive stepped by 4 mrad on the ninth day: mounts that were calibrated before do not
    know it.
    """
    root = tmp_path / "plant"
    write(root / "P-tower-measurements.json", tower_document())
    write(root / "AA39" / "Properties" / "AA39-heliostat-properties.json", properties_document())
    for number, one in enumerate(
        photographs(tower_document(), properties_document(), step_mrad=4.0)
    ):
        write_measurement(root, "AA39", 100 + number, one)
        item = {"properties": {"datetime": one["taken_at"]}}
        write(root / "AA39" / "Calibration" / f"{100 + number}-calibration-item-stac.json", item)
    source, file = read_folder(root), tmp_path / "mounts.json"
    report = calibrate_folder(source, file, until=datetime(2024, 5, 9, tzinfo=UTC))
    assert report["heliostats"]["AA39"]["measurements"] == 8
    with open_folder(source, mounts_file=file) as opened:
        stored = load_mount(opened.session, "AA39")
        standing = stored.turned()
        assert standing.mount.calibrated_until == date(2024, 5, 8)
        taken = []
        for one in source.measurements("AA39", with_images=False):
            given = (one.to_sun, source.plant.targets[one.target], one.spot)
            setup = Setup(standing, control_points(standing), *given, taken_at=one.taken_at)
            image, day = FluxImage(setup, np.ones((8, 8))), day_of(one.taken_at)
            motors = np.array(one.motor_position)
            taken.append(image.sent(stored.heliostat, stored.mount, motors, day))
    assert [one.setup.angles is not None for one in taken] == [False] * 8 + [True] * 8
    setups, surveyed = [one.setup for one in taken[8:]], PlantModel(source.plant.site)
    before = align(setups, surveyed).displacements
    assert np.linalg.norm(before, axis=-1).min() > 6e-3
    stepped = EncoderOffset(
        first_deg={"AA39": float(np.degrees(4e-3))}, scope=Since(date(2024, 5, 9))
    )
    after = align(setups, surveyed.with_effects([stepped])).displacements
    deviations = np.array(
        [
            np.hypot(one.spot_std_rad, np.linalg.norm(one.spot_shifts_rad, axis=1))
            for one in taken[8:]
        ]
    )
    assert (np.abs(after) < 3 * deviations).all()


def test_spots_need_no_focal_spot(folder: Path, tmp_path: Path):
    mounts = tmp_path / "mounts.json"
    calibrate_folder(read_folder(folder), mounts)
    source, measured = read_folder(folder), {}
    for measurement in source.measurements("AA39", with_images=False):
        measured[measurement.key] = measurement.spot
    for path in (folder / "AA39" / "Calibration").glob("*-properties.json"):
        document = json.loads(path.read_text())
        document.pop("focal_spot", None)
        write(path, document)
    report = spot_folder(read_folder(folder), mounts, tmp_path / "spots.json")
    assert len(report["spots"]) == 18
    assert set(report["skipped"]) == {"AA39/200", "AA39/202", "AA39/204", "AB01", "AB02", "AB09"}
    entry = report["spots"]["AA39/105"]
    assert np.linalg.norm(np.array(entry["spot"]) - measured["AA39/105"]) < 0.2
    assert 0 < entry["std_m"] < 0.5
    assert entry["target"] == "lower"


@pytest.mark.full
def test_verbs_stand_on_the_mounts_of_a_file(folder: Path, tmp_path: Path):
    """Without a spot the light of the motors lands where it was seen, and not 29 mrad away; with
    one it is rolled.
    """
    mounts, measured = tmp_path / "mounts.json", {}
    calibrate_folder(read_folder(folder), mounts)
    for measurement in read_folder(folder).measurements("AA39", with_images=False):
        measured[measurement.key] = measurement.spot
    options = ["--surfaces", "ideal", "--json"]

    def forecasts(out: str, *more: str) -> dict[str, Any]:
        made = CliRunner().invoke(
            app, ["forecast", str(folder), "--out", str(tmp_path / out), *options, *more]
        )
        assert made.exit_code == 0, made.output
        keys = json.loads(made.stdout)["measurements"]
        return {key: np.load(tmp_path / out / f"{key}-forecast.npz")["flux"] for key in keys}

    plain, standing = forecasts("plain"), forecasts("standing", "--mounts", str(mounts))
    changes = [np.abs(standing[key] - plain[key]).sum() / plain[key].sum() for key in plain]
    assert 0.003 < np.median(changes) < 0.2
    for path in (folder / "AA39" / "Calibration").glob("*-properties.json"):
        document = json.loads(path.read_text())
        document.pop("focal_spot", None)
        write(path, document)
    by_motors = forecasts("motors", "--mounts", str(mounts))
    assert "AA39/204" not in by_motors  # beyond the travel
    plant = read_folder(folder).plant
    plane, heliostat = plant.targets["lower"], plant.heliostats["AA39"]
    off = []
    for key, flux in by_motors.items():
        if key[-3:] < "116":  # those that were measured well
            spot = plane.to_enu(center_of_mass(flux, (plane.width, plane.height)))
            off.append(
                np.linalg.norm(spot - measured[key]) / np.linalg.norm(heliostat.position - spot)
            )
    assert len(off) == 16
    assert np.median(off) < 1e-3


def test_mounts_of_another_sun_are_refused(folder: Path, tmp_path: Path):
    mounts = str(tmp_path / "mounts.json")
    calibrate_folder(read_folder(folder), tmp_path / "mounts.json")
    late = {"effects": [{"name": "sun_position", "parameters": {"minutes": 12.0}}]}
    write(tmp_path / "late.json", late)
    for verb in ("forecast", "study"):
        asked = [verb, str(folder), "--out", str(tmp_path / "o"), "--mounts", mounts]
        done = CliRunner().invoke(app, [*asked, "--effects", str(tmp_path / "late.json")])
        assert isinstance(done.exception, InvalidInputError)
        assert "another sun" in str(done.exception)
    write(folder / "twin.json", {"declared": late})
    report = calibrate_folder(read_folder(folder), tmp_path / "mounts.json")
    assert report["heliostats"]["AA39"]["sun"] == late["effects"]
    off = spot_folder(read_folder(folder), tmp_path / "mounts.json", tmp_path / "spots.json")[
        "spots"
    ]["AA39/105"]
    (measured,) = [
        m.spot for m in read_folder(folder).measurements("AA39", False) if m.key == "AA39/105"
    ]
    assert np.linalg.norm(np.array(off["spot"]) - measured) < 0.3


def test_files_that_are_no_mounts_are_refused(folder: Path, tmp_path: Path):
    wrong = tmp_path / "wrong.json"
    for document in ({}, {"heliostats": []}, {"heliostats": {"AA39": {}}}):
        write(wrong, document)
        with pytest.raises(InvalidInputError, match=r"wrong\.json"):
            spot_folder(read_folder(folder), wrong, tmp_path / "spots.json")
    shutil.rmtree(folder / "AA39")
    with pytest.raises(ConflictError, match="no heliostat can be calibrated"):
        calibrate_folder(read_folder(folder), tmp_path / "mounts.json")


def test_the_verbs_print_tables_and_name_bad_files(folder: Path, tmp_path: Path):
    mounts, spots = tmp_path / "mounts.json", tmp_path / "spots.json"
    done = CliRunner().invoke(app, ["calibrate", str(folder), "--out", str(mounts)])
    assert done.exit_code == 0, done.output
    assert "AA39" in done.stdout
    report = CliRunner().invoke(
        app, ["spot", str(folder), "--mounts", str(mounts), "--out", str(spots), "--json"]
    )
    assert json.loads(report.stdout)["spots"] == json.loads(spots.read_text())["spots"]
    missing = CliRunner().invoke(
        app, ["spot", str(folder), "--mounts", str(tmp_path / "none"), "--out", str(spots)]
    )
    assert isinstance(missing.exception, InvalidInputError)
    assert "no such file" in str(missing.exception)
    onto = CliRunner().invoke(app, ["calibrate", str(folder), "--out", str(tmp_path)])
    assert "is a folder" in str(onto.exception)


def test_what_the_weather_explains_is_asked_where_it_is_stored(folder: Path, tmp_path: Path):
    taken = photographs(tower_document(), properties_document())
    for name in ("AB02", "AB03", "AB04"):
        write(
            folder / name / "Properties" / f"{name}-heliostat-properties.json",
            properties_document(),
        )
        for number, one in enumerate(taken):
            write_measurement(folder, name, 100 + number, one, temperature_c=10.0 + number)
            item = {
                "properties": {
                    "datetime": one["taken_at"],
                    "wind_speed_m_s": 4.0 + number,
                    "wind_from_deg": 90.0,
                }
            }
            if name == "AB03":  # if the measurement has the weather, that of its item is not used
                write(
                    folder / name / "Calibration" / f"{100 + number}-calibration-item-stac.json",
                    item,
                )
    write_measurement(folder, "AB02", 300, taken[0], temperature_c="cold")
    write_measurement(folder, "AB02", 301, taken[0], wind_from_deg=400.0)
    weathers = [one.weather for one in read_readings(read_folder(folder))["AB03"]]
    assert weathers[2] == Weather(temperature_c=12.0)
    report = calibrate_folder(read_folder(folder), tmp_path / "mounts.json")
    assert "temperature_c: must be a number" in report["skipped"]["AB02/300"]
    assert "wind_from_deg: must be 360 or less" in report["skipped"]["AB02/301"]
    covariates = report["covariates"]
    assert covariates["temperature"]["measurements"] == 48
    assert set(covariates["temperature"]["share"]) == {"sidewards", "upwards"}
    assert covariates["wind"] == {"measurements": 0, "share": None}
    assert covariates["time_of_day"]["measurements"] == 64


def test_weather_of_items_is_read(folder: Path):
    for path in (folder / "AA39" / "Calibration").glob("*-item-stac.json"):
        document = json.loads(path.read_text())
        document["properties"] |= {"wind_speed_m_s": 4, "wind_from_deg": 90, "temperature_c": 7.5}
        write(path, document)
    weathers = [one.weather for one in read_readings(read_folder(folder))["AA39"]]
    assert weathers[:2] == [Weather(4.0, 90.0, 7.5), Weather()]


def test_a_wrong_clock_is_said_first(folder: Path, tmp_path: Path):
    taken = photographs(tower_document(), properties_document(), fast_minutes=2.0)
    for name in ("AB02", "AB03", "AB04"):
        write(
            folder / name / "Properties" / f"{name}-heliostat-properties.json",
            properties_document(),
        )
        for number, one in enumerate(taken):
            write_measurement(folder, name, 100 + number, one)
            item = {"properties": {"datetime": one["taken_at"]}}
            write(
                folder / name / "Calibration" / f"{100 + number}-calibration-item-stac.json", item
            )
    mounts = tmp_path / "mounts.json"
    done = CliRunner().invoke(app, ["calibrate", str(folder), "--out", str(mounts)])
    assert done.exit_code == 0, done.output
    clock = json.loads(mounts.read_text())["clock"]
    assert clock["minutes"] == pytest.approx(-2, abs=0.3)
    assert f"clock: from {clock['since']} on the clock was" in " ".join(done.stderr.split())


@pytest.mark.full
def test_the_clock_of_real_photographs_is_right_until_it_is_put_wrong(stj_pointing: Path):
    plant = Plant([stj_pointing])
    wrong = with_clock(plant.readings, 19481.0, 1.0, plant.site)
    right, found = (
        calibrate_field(plant.heliostats, readings, plant.targets, plant.site).clock
        for readings in (plant.readings, wrong)
    )
    assert right is None
    assert found is not None
    assert found.since == 19481.0
    assert found.minutes == pytest.approx(-1.0, abs=0.15)


def test_real_heliostats_are_forecast_to_a_milliradian(stj_pointing: Path, tmp_path: Path):
    """For a third of the measurements of two heliostats only the motor positions are used."""
    root, measured = tmp_path / "plant", {}
    for name in ("BG23", "BH20"):
        shutil.copytree(stj_pointing / name, root / name)
    for path in stj_pointing.glob("*tower-measurements.json"):
        shutil.copy(path, root)
    source = read_folder(root)
    for name in source.plant.heliostats:
        for measurement in source.measurements(name, with_images=False)[::3]:
            measured[measurement.key] = measurement.spot
            path = (
                root
                / name
                / "Calibration"
                / f"{measurement.external_id}-calibration-properties.json"
            )
            document = json.loads(path.read_text())
            del document["focal_spot"]
            write(path, document)
    calibrate_folder(read_folder(root), tmp_path / "mounts.json")
    spots = spot_folder(read_folder(root), tmp_path / "mounts.json", tmp_path / "spots.json")[
        "spots"
    ]
    for name, heliostat in source.plant.heliostats.items():
        off = [
            np.linalg.norm(np.array(spots[key]["spot"]) - spot)
            / np.linalg.norm(spot - heliostat.position)
            for key, spot in measured.items()
            if key.startswith(name)
        ]
        assert np.median(off) < 1.0e-3
