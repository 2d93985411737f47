"""JSON files that verbs read: every error in them is reported in plain words."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model.effects import effects_from_json
from model.errors import InvalidInputError
from model.plant import Plant
from model.pointing.kinematics import NAMES
from model.pointing.report import mount_from_json
from model.site import JUELICH
from service.sources.documents import (
    parse_declared,
    read_heliostat,
    read_item,
    read_json,
    read_measurement,
    read_receivers,
    read_targets,
)
from service.twin.model_versions import ModelVersion
from service.twin.studies.study import row_of_report
from tests.service.conftest import ORIGIN, properties_document, tower_document
from tests.service.wrong import RAW, wrong_somewhere

PLANT = Plant("", np.array(ORIGIN), read_targets(tower_document()))
MEASUREMENT = {
    "target_name": "lower",
    "sun_azimuth": 20.0,
    "sun_elevation": 45.0,
    "motor_position": {"axis_1_motor_position": 1, "axis_2_motor_position": 2},
    "focal_spot": {"UTIS": [50.9, 6.4, 120.0]},
    "wind_speed_m_s": 3.0,
}
DECLARED = {
    "sun": {"shape": "buie", "circumsolar_ratio": 0.02},
    "optics": {"reflectivity": 0.9, "attenuation": [0.0067, 0.1]},
    "cameras": [
        {
            "transfer": {"gamma": 2.0},
            "since": "2024-03-01T00:00:00Z",
            "targets": ["lower"],
            "bits": 14,
        }
    ],
    "effects": [{"name": "slope_error", "parameters": {"sigma_mrad": {"value": 1.0}}}],
}
TIMES = ["2024-06-01T09:00:00+00:00", "2024-06-02T09:00:00+00:00"]
NUMBER = {"value": 0.0, "std": 1.0, "prior_std": 1.0}
MOUNT = {
    "history": {
        "at": TIMES,
        **{name: [[0.0, 0.0], [0.0, 0.0]] for name in ("drift", "jitter", "stepped", "residuals")},
        "predicted": [None, 1e-3],
        "foreign": [0],
    },
    "predicted_error_mrad": {"median": 1.0, "ci90": [0.5, 2.0], "measurements": 9},
    "parameters": dict.fromkeys(NAMES, NUMBER),
    "covariance": np.eye(len(NAMES)).tolist(),
    "steps": [
        {
            "from": TIMES[0],
            "to": TIMES[1],
            "zeros_mrad": [1.0, 0.0],
            "std_mrad": [0.1, 0.1],
            "motor_steps": [9, 0],
        }
    ],
    "drift": {"std_mrad": [0.1, 0.1]},
}
ACCURACY = {"accuracy_mean": 0.9, "accuracy_median": 0.9, "per_image": {"AA39/1": 0.9}}
REPORT = {
    "verdict": "effect",
    "images": {"fit": 1, "held_out": 1},
    "before": ACCURACY,
    "after": ACCURACY,
    "noise_floor": 0.01,
    "unexplained_share": 0.0,
    "effects": DECLARED["effects"],
    "candidates": [],
    "skipped": {"AA40": "no images"},
}
MODEL = ModelVersion(site=JUELICH, number=1, version="1")
READERS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "properties": (
        properties_document(),
        lambda json_value: read_heliostat("AA39", json_value, np.array(ORIGIN)),
    ),
    "targets": (tower_document(), read_targets),
    "receivers": (tower_document(), read_receivers),
    "measurement": (
        MEASUREMENT,
        lambda json_value: read_measurement("1", "AA39", json_value, PLANT),
    ),
    "item": (
        {"properties": {"datetime": "2024-06-01T09:00:00Z"}},
        lambda json_value: read_item(json_value, "item"),
    ),
    "declared": (DECLARED, lambda json_value: parse_declared(json_value, "twin.json")),
    "mount": (MOUNT, lambda json_value: mount_from_json(json_value, "MOUNTS.json, AA39")),
    "report": (
        REPORT,
        lambda json_value: row_of_report(json_value, "report.json", MODEL, "tester"),
    ),
    "effects": ({"effects": DECLARED["effects"]}, effects_from_json),
}


def refusal(read: Callable[[Any], Any], document: Any) -> str:
    """What is said of a document; nothing where it is taken."""
    try:
        read(document)
    except InvalidInputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("name", READERS)
def test_whatever_is_wrong_is_told(name: str):
    document, read = READERS[name]
    read(document)
    said = [message for wrong in wrong_somewhere(document) if (message := refusal(read, wrong))]
    assert len(said) > 15
    assert [text for text in said if RAW.search(text) or "\n" in text] == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"", "is no JSON, wrong at line 1, column 1; make it one JSON document"),
        (b'{"a": 1,\n "b" 2}', "is no JSON, wrong at line 2, column 6; make it one JSON document"),
        (b"\xff\xfe", "is no JSON, wrong at a byte that is no UTF-8"),
    ],
)
def test_what_is_no_json_names_the_place(tmp_path: Path, text: bytes, says: str):
    file = tmp_path / "twin.json"
    file.write_bytes(text)
    with pytest.raises(InvalidInputError) as refused:
        read_json(file)
    assert str(refused.value).startswith(f"{file}: {says}")
