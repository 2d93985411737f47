"""On photographs of the Solar Tower Juelich; ``python -m tests.benchmarks.imaging`` prints the full
figures.
"""

import numpy as np
import pytest

from model.imaging import measure
from service.sources.decode import decode_image
from tests.benchmarks.imaging import correlation, data_folder, figures, main, read_case


@pytest.fixture(scope="module")
def cases(stj, plant):
    paths = sorted((stj / "AA23/Calibration").glob("*-properties.json"))
    return [read_case(path, plant) for path in paths]


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
