"""``heliotwin camera``: a law is measured, judged by other days, and declared only where it is
better.
"""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from heliotwin.folder_camera import measure_camera
from model.errors import InvalidInputError
from model.imaging.light import Measured, Power, Srgb, Transfer
from service.sources.folder import read_folder
from tests.service.command import heliotwin


def taken_through(law: Transfer, source: Path, root: Path) -> Path:
    """A folder whose photographs another camera than sRGB's took."""
    shutil.copytree(source, root)
    table = np.round(255 * law.counts(Srgb().light(np.arange(256) / 255))).astype(np.uint8)
    for path in root.glob("*/Calibration/*-raw.png"):
        cv2.imwrite(str(path), table[cv2.imread(str(path))])
    return root


@pytest.mark.full
def test_srgb_stays_where_it_is_no_worse(pair_plant, tmp_path):
    out = tmp_path / "new" / "camera.json"
    done = heliotwin("camera", pair_plant, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "sRGB is no worse than the measured curve" in done.stdout
    report = json.loads(out.read_text())
    assert (report["verdict"], report["declared"]) == ("srgb", {"cameras": [{"transfer": "srgb"}]})
    assert abs(report["gain"]["mean"]) < 0.001
    assert report["from_srgb"]["light"] < 0.02
    assert len(report["per_image"]) == report["photographs"] == report["days"] == 8


@pytest.mark.full
def test_another_camera_s_curve_is_found_and_makes_forecasts_agree(pair_plant, tmp_path):
    root = taken_through(Power(1.4), pair_plant, tmp_path / "plant")
    report = measure_camera(
        read_folder(root), tmp_path / "camera.json", targets=["calibration_target"]
    )
    assert report["verdict"] == "measured"
    assert report["gain"]["ci95"][0] > 0.01
    assert "Declare it" in report["conclusion"]
    (tmp_path / "plant" / "twin.json").write_text((tmp_path / "camera.json").read_text())
    (camera,) = read_folder(root).model.cameras
    assert camera.targets == ("calibration_target",)
    assert isinstance(camera.transfer, Measured)
    seen = np.linspace(0.5, 1, 50)
    found, truth, usual = (
        law.light(seen) - law.light(0.5) for law in (camera.transfer, Power(1.4), Srgb())
    )
    found, truth, usual = (light / light[-1] for light in (found, truth, usual))
    assert np.abs(found - truth).max() < 0.02 < 0.06 < np.abs(usual - truth).max()


@pytest.mark.full
def test_photographs_that_tell_nothing_of_a_law_are_left_out_with_the_reason(made_plant, tmp_path):
    root = tmp_path / "plant"
    shutil.copytree(made_plant, root)
    path = next(root.glob("AB12/Calibration/*-raw.png"))
    cv2.imwrite(str(path), cv2.imread(str(path)).astype(np.uint16) * 257)
    shutil.rmtree(root / "AC31" / "Deflectometry")
    report = measure_camera(read_folder(root, ["AB12", "AC31", "AF27"]), tmp_path / "camera.json")
    assert "16 bits" in report["skipped"][f"AB12/{path.name.split('-')[0]}"]
    assert "no surface" in report["skipped"]["AC31"]
    assert len(report["per_image"]) == 7


def test_what_cannot_be_measured_is_one_clear_error(pair_plant, tmp_path):
    with pytest.raises(
        InvalidInputError, match=r"--target must be one of calibration_target.*'roof'"
    ):
        measure_camera(read_folder(pair_plant), tmp_path / "c.json", targets=["roof"])
    with pytest.raises(
        InvalidInputError, match=r"needs photographs of 4 days.*0 are left.*no surface"
    ):
        measure_camera(read_folder(pair_plant), tmp_path / "c.json", surfaces=str(tmp_path))
    root = tmp_path / "plant"
    shutil.copytree(pair_plant, root)
    effects = [{"name": "camera_shoulder", "parameters": {"compression": 1.0}}]
    (root / "twin.json").write_text(json.dumps({"declared": {"effects": effects}}))
    with pytest.raises(
        InvalidInputError,
        match="declares camera_shoulder, which replaces the camera response curve",
    ):
        measure_camera(read_folder(root), tmp_path / "c.json")
    assert heliotwin("camera", pair_plant, "--out", tmp_path).returncode == 2
