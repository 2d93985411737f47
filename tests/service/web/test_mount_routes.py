"""Calibrated mounts over HTTP: the job, motors for an aim, forecasts from motors, the plan."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from service.base.settings import Settings
from tests.service.conftest import QUIET, FakeOperations, Post, png, until
from tests.service.spots import photographs

SUN = {"azimuth_deg": 10.0, "elevation_deg": 40.0}
NOON = "2024-06-03T11:30:00Z"


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", **QUIET | {"job_workers": 1, "job_poll_s": 0.05})


def calibrate(client: TestClient, **body: Any) -> dict[str, Any]:
    answer = client.post("/v1/jobs/calibrations", json=body)
    path = answer.headers["Location"]
    until(lambda: client.get(path).json()["state"] in ("done", "failed"))
    job: dict[str, Any] = client.get(path).json()
    return job


def test_a_calibration_finds_mount_and_step(client: TestClient, post: Post, tower: Any, properties: Any):
    for number, taken in enumerate(photographs(tower, properties, step_mrad=6.0)):
        assert post(png(number), **taken).status_code == 201
    client.put("/v1/heliostats/AB01", json=properties)
    job = calibrate(client)
    assert job["state"] == "done", job
    assert job["result"]["mounts"] == {"AA39": 1}
    assert job["result"]["skipped"] == {"AB01": "no measurement with motor positions and a spot"}
    (step,) = job["result"]["steps"]["AA39"]
    assert (step["after"], step["before"]) == ("7", "8")
    assert step["zeros_mrad"][0] == pytest.approx(6, abs=1.5)
    mount = client.get("/v1/heliostats/AA39/mounts/current").json()
    assert mount["valid_from"].startswith("2024-05-09")
    assert mount["parameters"]["foundation_up"]["determined"]
    assert client.get("/v1/heliostats/AA39/mounts").json()["items"] == [mount]
    shown = client.get("/heliostats/AA39").text
    assert "Steps of its drives" in shown
    assert "the first drive alone: it likely lost steps" in shown
    assert "Pointing error" in shown
    early = client.get("/v1/heliostats/AA39/mounts/current", params={"at": "2024-05-01T00:00:00Z"})
    assert early.status_code == 404


def test_photographs_without_a_time_are_placed_by_their_numbers(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    """Those of an archive came last, and are not the newest for that."""
    taken = photographs(tower, properties, step_mrad=6.0)
    undated = [one | {"taken_at": None} for one in taken[2:5]]
    for number, one in enumerate([*taken[:2], *taken[5:], *undated]):
        assert post(png(number), **one).status_code == 201
    (step,) = calibrate(client)["result"]["steps"]["AA39"]
    assert (step["after"], step["before"]) == ("7", "8")
    assert client.get("/v1/heliostats/AA39/pointing").json()["since_calibration"] == 0


def test_motors_send_the_light_to_the_aim(
    client: TestClient, post: Post, operations: FakeOperations, tower: Any, properties: Any
):
    path = "/v1/heliostats/AA39/motors"
    before = client.post(path, json={"sun": SUN, "target": "lower"}).json()
    for number, taken in enumerate(photographs(tower, properties)):
        post(png(number), **taken)
    calibrate(client, heliostats=["AA39"])
    after = client.post(path, json={"sun": SUN, "target": "lower"}).json()
    assert (before["mount_version"], after["mount_version"]) == (None, 1)
    assert after["std_mrad"] < 3 < before["std_mrad"]
    assert np.abs(np.subtract(before["motor_position"], after["motor_position"])).max() > 20

    asked = {"heliostat": "AA39", "sun": SUN, "surface": "ideal", "target": "lower"}
    answer = client.post("/v1/forecasts", json={**asked, "motor_position": after["motor_position"]})
    assert answer.status_code == 201, answer.text
    assert answer.json()["motor_position"] == after["motor_position"]
    turned = operations.forecasts[-1]
    assert turned["aim"] is None
    assert turned["angles"] is not None
    aimed = client.post(path, json={"time": NOON, "aim_point": [0.0, -3.0, 36.0]}).json()
    assert aimed["sun"]["elevation_deg"] > 55


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"sun": SUN}, "aim_point or target"),
        ({"target": "lower"}, "sun or time"),
        ({"target": "lower", "time": "2024-06-03T00:00:00Z"}, "below the horizon"),
        ({"aim_point": [0.0, 300.0, 1.0], "sun": {"azimuth_deg": 180.0, "elevation_deg": 2.0}}, "travel|far|reach"),
    ],
)
def test_aims_that_cannot_be_are_refused(client: TestClient, body: Any, said: str):
    answer = client.post("/v1/heliostats/AA39/motors", json=body)
    assert answer.status_code == 422
    assert any(word in answer.text for word in said.split("|"))


def test_motor_positions_beyond_the_travel_are_refused(client: TestClient):
    asked = {"heliostat": "AA39", "sun": SUN, "surface": "ideal", "target": "lower"}
    answer = client.post("/v1/forecasts", json={**asked, "motor_position": [82519, 30000]})
    assert answer.status_code == 422
    assert "beyond the travel" in answer.text
    both = client.post("/v1/forecasts", json={**asked, "motor_position": [1, 1], "aim_point": [0, 0, 0]})
    assert both.status_code == 422


def test_nothing_to_calibrate_is_said(client: TestClient, post: Post):
    post(png(1))
    job = calibrate(client)
    assert job["state"] == "failed"
    assert "no heliostat can be calibrated" in job["reason"]


def test_the_plan_asks_for_what_is_known_least(client: TestClient, post: Post, tower: Any, properties: Any):
    for number, taken in enumerate(photographs(tower, properties)):
        post(png(number), **taken)
    client.put("/v1/heliostats/AB01", json=properties)
    calibrate(client)
    plan = client.get("/v1/calibration-plan", params={"at": NOON, "photographs": 3, "minutes": 30}).json()["items"]
    assert [one["heliostat"] for one in plan] == ["AB01", "AA39"]
    assert plan[0]["information_bits"] > 2 * plan[1]["information_bits"] > 0
    assert plan[0]["at"] == "2024-06-03T11:35:00Z"
    night = client.get("/v1/calibration-plan", params={"at": "2024-06-03T00:00:00Z"})
    assert night.status_code == 422
    asked = {"at": NOON, "photographs": 3, "minutes": 30}
    page = client.get("/calibration-plan", params=asked, headers={"Accept": "text/html"}).text
    assert re.findall(r'<th scope="row"><a href="/heliostats/(\w+)"', page) == ["AB01", "AA39"]
    dark = client.get("/calibration-plan", params={"at": "2024-06-03T00:00"}, headers={"Accept": "text/html"}).text
    assert "The sun is below the horizon then" in dark.replace("At: the", "The")


def test_changed_properties_ask_for_another_calibration(client: TestClient, post: Post, tower: Any, properties: Any):
    for number, taken in enumerate(photographs(tower, properties)):
        post(png(number), **taken)
    calibrate(client)
    properties["kinematics_properties"]["actuators"][0]["initial_angle"] += 0.01
    client.put("/v1/heliostats/AA39", json=properties)
    answer = client.post("/v1/heliostats/AA39/motors", json={"sun": SUN, "target": "lower"})
    assert answer.status_code == 409
    assert "changed since it was calibrated" in answer.text
    assert client.delete("/v1/heliostats/AA39").status_code == 409
