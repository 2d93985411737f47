"""On photographs of the Solar Tower Juelich; ``python -m benchmarks.imaging`` prints the full
figures.
"""

import cv2
import numpy as np
import pytest

from benchmarks.imaging import correlation, data_folder, figures, main, read_case
from model.errors import ImageRefusedError
from model.imaging import Camera, measure
from model.imaging.edges import find_sheet
from model.locating import corner_places, homography_through, project
from service.sources.decode import decode_image


@pytest.fixture(scope="module")
def cases(stj, plant):
    paths = sorted((stj / "AA23/Calibration").glob("*-properties.json"))
    return [read_case(path, plant) for path in paths]


@pytest.mark.full
def test_every_frame_is_measured(cases):
    assert sum(case.raw is not None for case in cases) >= 6
    for case in cases:
        assert case.from_crop.quality.accepted
        assert case.from_raw is None or case.from_raw.quality.accepted


def test_the_goals_hold(cases):
    crops = [correlation(case.from_raw.crop, case.paint_crop) for case in cases if case.from_raw]
    assert min(crops) >= 0.95
    assert np.median(crops) >= 0.97
    rows = [figures(case) for case in cases]
    assert np.nanmedian([row["flux raw"] for row in rows]) >= 0.90
    assert min(row["flux crop"] for row in rows) >= 0.85
    assert np.nanmedian([row["CoM raw"] for row in rows]) <= 0.10


@pytest.mark.full
def test_edges_of_a_sheet_agree_with_the_marks_on_it(cases, plant):
    """One target is a white sheet before the sky, of 6.05 x 6.89 m around its brackets.

    By its edges it is a rectangle to 2 cm in the frame of the brackets. The other targets are on
    concrete of the same brightness: they are refused.
    """
    found = {}
    for case in cases:
        if case.raw is not None:
            gray = cv2.cvtColor(case.raw, cv2.COLOR_RGB2GRAY)
            light = (255 * Camera().light_of(gray)).astype(np.float32)
            try:
                found[case.name] = find_sheet(gray, plant.targets[case.target], light)
            except ImageRefusedError:
                continue
    assert list(found) == ["203718"]
    (case,) = (case for case in cases if case.name == "203718")
    marks, edges = case.from_raw.corners, found["203718"]
    on_target = homography_through(marks, corner_places(plant.targets[case.target]))
    places = project(on_target, edges)
    middle = places.mean(axis=0)
    size = 2 * np.abs(places - middle).mean(axis=0)
    rectangle = middle + size / 2 * [[-1, 1], [1, 1], [-1, -1], [1, -1]]
    apart = np.abs(places - rectangle).max()
    apart_px = np.abs(project(np.linalg.inv(on_target), rectangle) - edges).max()
    print(f"sheet {size.round(3)} m; from a rectangle {apart:.3f} m, {apart_px:.1f} pixels")
    np.testing.assert_allclose(size, [6.05, 6.89], atol=0.03)
    assert apart < 0.02
    assert apart_px < 3


@pytest.mark.full
def test_empty_targets_hold_no_spot(stj, plant):
    plane = plant.targets["solar_tower_juelich_lower"]
    paths = sorted((stj / "empty-targets").glob("*.png"))[::15]
    assert {
        measure(decode_image(path.read_bytes()), "cropped", plane).quality.reason for path in paths
    } == {"no_spot"}


def test_without_data_the_command_says_so(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("HELIOTWIN_STJ", str(tmp_path / "nothing"))
    assert main([]) == 0
    assert "HELIOTWIN_STJ" in capsys.readouterr().out
    assert not data_folder().exists()
