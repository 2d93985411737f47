"""Raw photographs of targets without marks, from plant.yaml through folders, store and REST."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from heliotwin.demo.camera import CameraOptions, photograph, target_corners
from model.locating import locator_to_json
from service.sources.folder import read_folder
from service.sources.plant_file import read_plant
from tests.heliotwin.cli.test_plant_folder import LAYOUT
from tests.service.command import heliotwin, heliotwin_on
from tests.service.sources.plant_files import PLANT, write_plant

OPTIONS = CameraOptions(border=0.0, marks=False, daylight=0.45, peak=0.5, size=(540, 720))
KNOWN = replace(OPTIONS, daylight=0.25)  # no brighter than the sky: no edges to find


def spot(plane):
    """A spot (128, 128) off the middle."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 128), np.linspace(-0.5, 0.5, 128))
    return np.exp(-0.5 * (((x - 0.1) / 0.12) ** 2 + ((y + 0.05) / 0.1) ** 2))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a target that has nothing, and one whose camera is known."""
    root = tmp_path_factory.mktemp("unmarked")
    plane = read_plant(write_plant(root)).plant.targets["cal"]
    corners = target_corners(plane, KNOWN).round(2).tolist()
    known = f"camera: {{corners_px: {corners}, image_size_px: [720, 540]}}"
    other = PLANT.replace(
        "  cal: {",
        f"  seen: {{kind: plane, center_m: [0, 5, 60], normal: [0, 1, 0], width_m: 12,"
        f" height_m: 12, {known}}}\n  cal: {{",
    )
    write_plant(root, other, layout=LAYOUT)
    own = root / "A1" / "Calibration"
    own.mkdir(parents=True)
    for number, (target, options) in enumerate((("cal", OPTIONS), ("seen", KNOWN)), start=1):
        frame = photograph(spot(plane), plane, np.random.default_rng(number), options)
        cv2.imwrite(str(own / f"{number}-raw.png"), frame[..., ::-1])
        properties = {"target_name": target, "sun_azimuth_deg": 170.0, "sun_elevation_deg": 50.0}
        (own / f"{number}-calibration-properties.json").write_text(json.dumps(properties))
    return root


def test_each_target_is_found_as_it_declares(folder: Path, tmp_path: Path):
    done = heliotwin("flux", folder, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    for entry in json.loads((tmp_path / "quality.json").read_text())["images"].values():
        assert entry["accepted"], entry
        np.testing.assert_allclose(entry["center_of_mass_m"], [1.2, 0.6], atol=0.05)


def test_the_declaration_is_stored_and_exported(folder: Path, tmp_path: Path):
    done = heliotwin_on(tmp_path / "data", "import", folder, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["counts"]["images new"] == 2
    done = heliotwin_on(tmp_path / "data", "export", tmp_path / "exported")
    assert done.returncode == 0, done.stderr
    before, after = (read_folder(path).plant.targets for path in (folder, tmp_path / "exported"))
    for name, target in before.items():
        assert locator_to_json(after[name].locator) == locator_to_json(target.locator)
    written = read_plant(tmp_path / "exported" / "plant.yaml").plant.targets
    for name, target in before.items():
        assert locator_to_json(written[name].locator) == locator_to_json(target.locator)


def test_check_says_how_targets_are_located(folder: Path):
    done = heliotwin("plant", "check", folder / "plant.yaml", "--json")
    targets = json.loads(done.stdout)["targets"]
    assert {name: one["located_by"] for name, one in targets.items()} == {
        "cal": "edges",
        "seen": "camera",
    }
