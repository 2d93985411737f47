"""Drives of aim plans: of a calibrated mount, one that is not, and ideal ones."""

from collections.abc import Iterator
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from fastapi.testclient import TestClient

from model.frames import sun_direction
from service.sources.folder import read_folder
from service.store.columns import now
from service.twin.importing import import_folder
from tests.service import real
from tests.service.sources.plant_folder import write_plant_folder

pytestmark = [pytest.mark.full]

OFFSET = [60.0, -40.0]
"""Steps by which the motors of A1 differ from the nominal ones, in its photographs."""

BODY = {"target": "main", "dni_w_m2": 900, "limit_w_m2": 1e6, "heliostats": ["A1", "B1", "C1"]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_plant_folder(tmp_path_factory.mktemp("drives") / "plant")


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[TestClient]:
    with real.client_on(folder.parent / "store") as made:
        import_folder(real.runtime_of(made), read_folder(folder, whole_field=True))
        yield made


def test_motors_are_those_of_the_calibrated_mount(client: TestClient, folder: Path):
    """A calibration that follows a plan of the same day makes it outdated."""
    noon = now().astimezone(ZoneInfo("America/Los_Angeles")).replace(hour=12, minute=0)
    body = BODY | {"sun": {"at": noon.isoformat()}}
    before = real.run_job(client, "/v1/jobs/aim-plans", **body)
    for name in ("A1", "C1"):
        assert "never calibrated" in before["drives"][name]["reason"]
    assert real.run_job(client, "/v1/jobs/calibrations", heliostats=["A1"])["mounts"] == {"A1": 1}
    (alarm,) = client.get("/v1/alarms", params={"reason": "aims_outdated"}).json()["items"]
    assert "A1" in alarm["message"]
    after = real.run_job(client, "/v1/jobs/aim-plans", **body)
    assert client.get("/v1/alarms", params={"reason": "aims_outdated"}).json()["items"] == []
    assert after["drives"]["B1"]["axis_angles_deg"] is not None
    drive = after["drives"]["A1"]
    assert drive["reason"] is None
    heliostat = read_folder(folder).plant.heliostats["A1"]
    aim = np.array(after["aim_points_m"]["A1"])
    sun = sun_direction(after["sun"]["azimuth_deg"], after["sun"]["elevation_deg"])
    nominal = heliostat.mount.motors_from_angles(
        heliostat.mount.align(heliostat.position, sun, aim)
    )
    np.testing.assert_allclose(drive["motor_position"], nominal + OFFSET, atol=1.0)
