"""A measurement folder with motors and spots."""

from copy import deepcopy
from pathlib import Path

import pytest

from tests.heliotwin.cli.motor_folder import write, write_measurement
from tests.service.conftest import postgres_url, properties_document, tower_document
from tests.service.spots import photographs

__all__ = ["folder", "postgres_url"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """AA39 with 16 good measurements and others; AB01 has no drives, AB02 no measurement, AB09 no
    properties.
    """
    root = tmp_path / "plant"
    write(root / "P-tower-measurements.json", tower_document())
    for name in ("AA39", "AB01", "AB02"):
        properties = deepcopy(properties_document())
        if name == "AB01":
            properties["kinematics_properties"]["actuators"] = []
        write(root / name / "Properties" / f"{name}-heliostat-properties.json", properties)
    taken = photographs(tower_document(), properties_document())
    for number, one in enumerate(taken):
        write_measurement(root, "AA39", 100 + number, one)
        item = {"properties": {"datetime": one["taken_at"]}}
        if number % 3 != 1:  # the time of the others is not known
            write(
                root / "AA39" / "Calibration" / f"{100 + number}-calibration-item-stac.json", item
            )
    far = [50.92, 6.39, 100.0]
    write_measurement(root, "AA39", 200, taken[0], motor_position=None)
    write_measurement(root, "AA39", 201, taken[0], focal_spot=None)
    write_measurement(root, "AA39", 202, taken[0], sun_azimuth=None)
    write_measurement(root, "AA39", 203, taken[0], focal_spot={"UTIS": far})
    write_measurement(root, "AA39", 204, {**taken[0], "motor_position": [82519.0, 100.0]})
    write_measurement(root, "AB01", 300, taken[0])
    write_measurement(root, "AB09", 400, taken[0])
    return root
