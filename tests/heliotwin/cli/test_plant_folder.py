"""A measurement folder of a plant that ``plant.yaml`` describes, from photographs to exports."""

import json
from pathlib import Path

import numpy as np
import pytest

from model.locating import locator_to_json
from model.surface import control_points
from service.base.plant import receiver_to_json
from service.sources.folder import read_folder
from service.sources.heliostat_document import heliostat_to_json
from service.sources.plant_file import read_plant
from tests.service.command import ends, heliotwin, heliotwin_on
from tests.service.sources.plant_files import RICH, write_plant
from tests.service.sources.plant_folder import LAYOUT, write_plant_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_plant_folder(tmp_path_factory.mktemp("plant"))


def test_folder_is_read_as_its_file_describes_it(folder: Path):
    read = read_folder(folder)
    assert list(read.plant.heliostats) == ["A1", "B1"]  # C1 has no photographs
    assert [one.external_id for one in read.measurements("A1")] == ["1", "2", "3", "4", "5"]
    first = read.measurements("A1")[0]
    assert (first.sun.azimuth_deg, first.sun.elevation_deg, first.taken_at) == (140.0, 40.0, None)
    assert read.skipped == {}
    assert list(read.plant.receivers) == ["main", "board"]


@pytest.mark.full
def test_flux_and_forecast_work_on_it(folder: Path, tmp_path: Path):
    done = heliotwin("flux", folder, "--out", tmp_path / "flux")
    assert done.returncode == 0, done.stderr
    quality = json.loads((tmp_path / "flux" / "quality.json").read_text())["images"]
    assert [one["accepted"] for one in quality.values()] == [True] * 7
    done = heliotwin("forecast", folder, "--surfaces", "ideal", "--out", tmp_path / "forecast")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "forecast" / "forecast.json").read_text())
    assert all(one["accuracy"] > 0.85 for one in report["measurements"].values())
    flux = np.load(tmp_path / "forecast" / "A1" / "1-forecast.npz")["flux"]
    # 28 facets of 1.8 x 1.35 m and a reflectance of 0.95, in light of 1000 W/m2.
    power = flux.sum() * 12 * 12 / 256**2
    assert 0.75 < power / (28 * 1.8 * 1.35 * 1000 * 0.95) < 0.98


def test_mounts_of_other_kinds_are_calibrated(folder: Path, tmp_path: Path):
    """A1's azimuth-elevation mount has rotary drives whose zeros are 7 and 6 mrad off."""
    mounts, spots = tmp_path / "mounts.json", tmp_path / "spots.json"
    done = heliotwin("calibrate", folder, "--out", mounts)
    assert done.returncode == 0, done.stderr
    done = heliotwin("spot", folder, "--mounts", mounts, "--out", spots)
    assert done.returncode == 0, done.stderr
    found = json.loads(spots.read_text())["spots"]
    for one in read_folder(folder).measurements("A1"):
        assert one.spot is not None
        apart = np.linalg.norm(np.array(found[one.key]["spot"]) - one.spot)
        assert apart < 0.15  # 1 mrad of 190 m; before, 2.6 m


def test_store_gives_back_what_was_imported(folder: Path, tmp_path: Path):
    done = heliotwin_on(tmp_path / "data", "import", folder)
    assert done.returncode == 0, done.stderr
    again = heliotwin_on(tmp_path / "data", "import", folder, "--json")
    counts = json.loads(again.stdout)["counts"]
    assert not any(what.endswith("new") for what in counts)
    done = heliotwin_on(tmp_path / "data", "export", tmp_path / "exported")
    assert done.returncode == 0, done.stderr
    before, after = read_folder(folder, whole_field=True), read_folder(tmp_path / "exported")
    assert list(after.plant.heliostats) == ["A1", "B1", "C1"]  # C1 has no photographs
    for name, heliostat in before.plant.heliostats.items():
        exported = after.plant.heliostats[name]
        np.testing.assert_allclose(exported.position, heliostat.position, atol=1e-9)
        np.testing.assert_allclose(control_points(exported), control_points(heliostat), atol=1e-12)
        assert exported.optics == heliostat.optics
        assert [f.outline for f in exported.facets] == [f.outline for f in heliostat.facets]
        spots = [[one.spot for one in read.measurements(name)] for read in (before, after)]
        np.testing.assert_allclose(spots[0], spots[1], atol=1e-3)


@pytest.mark.full
def test_exported_plant_file_equals_the_imported_one(tmp_path: Path):
    """Receivers of every kind, tower, sun, air and types, also after a second store."""
    folder = write_plant_folder(tmp_path / "plant", RICH)
    given, place = read_plant(folder / "plant.yaml"), folder
    for number in ("1", "2"):
        done = heliotwin_on(tmp_path / number, "import", place)
        assert done.returncode == 0, done.stderr
        place = tmp_path / f"exported-{number}"
        done = heliotwin_on(tmp_path / number, "export", place)
        assert done.returncode == 0, done.stderr
        exported = read_plant(place / "plant.yaml")
        assert set(exported.receivers) == set(given.receivers) == {"main", "board", "cave", "walls"}
        for name, receiver in given.receivers.items():
            _is_same(receiver_to_json(exported.receivers[name]), receiver_to_json(receiver))
        for name, target in given.plant.targets.items():
            there = receiver_to_json(exported.plant.targets[name])
            _is_same(there, receiver_to_json(target), 1e-8)
            located, expected = exported.plant.targets[name].locator, target.locator
            assert located is not None
            assert expected is not None
            assert locator_to_json(located) == locator_to_json(expected)
        assert exported.tower == given.tower
        assert exported.optics.attenuation == given.optics.attenuation
        assert vars(exported.optics.sun_shape) == vars(given.optics.sun_shape)
        assert (exported.time_zone, exported.plant.name) == (given.time_zone, given.plant.name)
        assert exported.plant.origin.tolist() == given.plant.origin.tolist()
        assert list(exported.types) == list(given.types)
        assert list(exported.plant.heliostats) == list(given.plant.heliostats)
        for name, heliostat in exported.plant.heliostats.items():
            other = given.plant.heliostats[name]
            np.testing.assert_allclose(control_points(heliostat), control_points(other), atol=1e-9)
            assert heliostat.optics == other.optics
            assert exported.receiver_of[name] == given.receiver_of[name]
            assert heliostat_to_json(heliostat)["mount"] == heliostat_to_json(other)["mount"]


def _is_same(found: object, expected: object, atol: float = 1e-12) -> None:
    """The same JSON, with numbers to ``atol``."""
    if isinstance(expected, dict):
        assert isinstance(found, dict)
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            _is_same(found[key], value, atol)
    elif isinstance(expected, list):
        assert isinstance(found, list)
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            _is_same(one, other, atol)
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, abs=atol)
    else:
        assert found == expected


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"target_name": "north"}, "target_name: 'north' is none of cal"),
        ({"sun_azimuth": 10.0}, "sun_azimuth"),
        ({"sun_elevation_deg": None}, "sun_elevation_deg"),
    ],
)
def test_a_wrong_measurement_is_skipped_by_name(
    folder: Path, tmp_path: Path, change: dict[str, object], said: str
):
    for path in folder.rglob("*.*"):
        if path.suffix in (".yaml", ".csv") or path.parent.parent.name == "A1":
            copy = tmp_path / path.relative_to(folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    path = tmp_path / "A1" / "Calibration" / "1-calibration-properties.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    read = read_folder(tmp_path)
    assert [one.external_id for one in read.measurements("A1")] == ["2", "3", "4", "5"]
    assert said in read.skipped["A1/1"]


def test_a_folder_without_photographs_is_refused(tmp_path: Path):
    write_plant(tmp_path, layout=LAYOUT)
    done = heliotwin("flux", tmp_path, "--out", tmp_path / "out")
    ends(done, 2, "no heliostat of the plant has a folder of its name")
