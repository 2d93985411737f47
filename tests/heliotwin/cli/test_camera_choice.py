"""Folders without a declared camera: PAINT's images are differences of counts, others are light."""

import shutil
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from rich.console import Console

from heliotwin.cli import demo
from heliotwin.folder import flux_folder
from heliotwin.folder_forecast import forecast_folder
from heliotwin.folder_store import open_folder
from model.imaging.window import center_of_mass, flux_window
from model.metrics import flux_accuracy
from service.sources.folder import MeasurementFolder, read_folder
from service.sources.photograph import CENTERED_SIZE_ERROR, CENTERED_WINDOW
from tests.service.real import copy_measurements


@pytest.fixture
def hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MeasurementFolder, "measured_surface", lambda self, heliostat: None)


def with_camera(folder: MeasurementFolder):
    with open_folder(folder) as opened:
        assert opened.camera is not None
        return opened.camera, opened.model.cameras


@pytest.mark.full
def test_paints_images_are_taken_as_differences_of_counts(stj: Path, tmp_path: Path):
    report = forecast_folder(read_folder(stj, ["AA31", "AA39", "AC43"]), tmp_path)
    assert report["camera"]["answer"] == "srgb"
    assert report["camera"]["by"] == "measured"
    assert "differences of sRGB counts" in report["warnings"][0]
    by_mirror: dict[str, list[float]] = {}
    for key, entry in report["measurements"].items():
        assert ("accuracy" in entry) != ("not_compared" in entry), key
        if "accuracy" in entry:
            by_mirror.setdefault(key[:4], []).append(entry["accuracy"])
    assert len(by_mirror["AA31"]) == 8  # five of them are centred only
    means = [np.mean(values) for values in by_mirror.values()]
    assert np.mean(means) > 0.885


@pytest.mark.full
def test_the_demonstration_declares_the_camera_that_its_images_show(stj: Path, tmp_path: Path):
    copy_measurements(stj, tmp_path / "real")
    report = demo.run_demo(tmp_path / "real", tmp_path / "out", Console(quiet=True))
    assert "differences of sRGB counts" in str(report["camera"])
    assert "10 images without background" in (tmp_path / "out" / "report.html").read_text()
    (aa39,) = (one for one in cast(Any, report["heliostats"]) if one["heliostat"] == "AA39")
    assert aa39["accuracy_measured"] > 0.91  # as light 0.88


@pytest.mark.full
@pytest.mark.usefixtures("hidden")
def test_predicted_surfaces_decide_rightly_where_deflectometry_is_hidden(stj: Path):
    for names in (["AA31", "AA39", "AC43"], ["AA31"], ["AA39"]):
        choice, cameras = with_camera(read_folder(stj, names))
        assert (choice.answer, choice.by, len(cameras)) == ("srgb", "predicted", 1), names


@pytest.mark.full
@pytest.mark.parametrize("number", range(1, 7))
def test_linear_sets_stay_linear(undeclared: Path, number: int):
    choice, cameras = with_camera(read_folder(undeclared / f"set-{number}"))
    assert choice.answer != "srgb"
    assert cameras == ()
    if number == 1:  # its counts are another curve
        assert choice.other is not None


@pytest.fixture
def light(single_plant: Path, tmp_path: Path) -> Path:
    """The made plant with the flux that is measured in its photographs in place of them."""
    root, made = tmp_path / "plant", tmp_path / "flux"
    flux_folder(read_folder(single_plant), made)
    shutil.copytree(single_plant, root, ignore=shutil.ignore_patterns("*.png"))
    for image in (made / "AB12").glob("*-flux.png"):
        shutil.copy(image, root / "AB12" / "Calibration")
    return root


@pytest.mark.full
def test_generated_light_stays_linear_and_a_declared_camera_wins(light: Path):
    choice, cameras = with_camera(read_folder(light))
    assert (choice.answer != "srgb", cameras) == (True, ()), choice.in_words
    assert choice.gain.mean < 0, choice.in_words
    (light / "twin.json").write_text('{"declared": {"cameras": [{}]}}')
    with open_folder(read_folder(light)) as opened:
        assert (opened.camera, len(opened.model.cameras)) == (None, 1)


def test_few_images_warn(stj: Path):
    choice, cameras = with_camera(read_folder(stj, ["AC43"]))
    assert (choice.answer, choice.images, cameras) == ("undecided", 2, ())
    assert "6 or more" in choice.in_words


def test_centred_images_show_the_window_that_is_assumed(stj: Path):
    """Of images that also have the whole target: the side, and the same counts."""
    folder, sides = read_folder(stj, ["AA31", "AC43"]), []
    for measurement in (*folder.measurements("AA31"), *folder.measurements("AC43")):
        if not {"flux", "flux-centered"} <= set(measurement.images):
            continue
        whole, square = (
            cv2.imread(str(measurement.images[kind]), cv2.IMREAD_GRAYSCALE).astype(float)
            for kind in ("flux", "flux-centered")
        )
        plane = folder.plant.targets[measurement.target]
        size, tried = (plane.width, plane.height), np.linspace(5.9, 6.3, 41)
        accuracies = [
            flux_accuracy(
                square,
                flux_window(
                    whole, size, center_of_mass(whole, size) - center_of_mass(square, (s, s)), s
                ),
            )
            for s in tried
        ]
        sides.append(tried[np.argmax(accuracies)])
        assert max(accuracies) > 0.99  # one camera
    assert len(sides) == 5
    np.testing.assert_allclose(sides, CENTERED_WINDOW, rtol=CENTERED_SIZE_ERROR)
