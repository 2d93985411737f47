"""Calibrated mounts over HTTP: the job, motors for an aim, forecasts from motors, the plan."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fastapi.testclient import TestClient

from model.forecast import align
from model.mount import Mount, rotation
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.pointing.kinematics import NAMES, SPREAD
from model.setup import Setup
from model.site import Site
from model.surface import control_points
from model.tracing.convolution import central_rays
from service.base.settings import Settings
from service.sources.documents import read_heliostat
from service.twin.studies.study import StudyIn, load_study_inputs
from tests.page import Page
from tests.service.conftest import ORIGIN, QUIET, FakeOperations, Post, png, until
from tests.service.spots import calibrate, photographs

NORTH, UP = np.eye(3)[1:]
SUN = {"azimuth_deg": 170.0, "elevation_deg": 40.0}
NOON = "2024-06-03T11:30:00Z"


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", **QUIET | {"job_workers": 1, "job_poll_s": 0.05})


def test_a_calibration_finds_mount_and_step(
    client: TestClient, post: Post, tower: Any, properties: Any
):
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


@pytest.mark.full
def test_photographs_without_a_time_hide_no_step(
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


@pytest.mark.full
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
    aimed = client.post(path, json={"sun": {"at": NOON}, "aim_point_m": [0.0, -3.0, 36.0]}).json()
    assert aimed["sun"]["elevation_deg"] > 55


@pytest.mark.full
def test_the_past_is_turned_by_the_drives_of_then(
    client: TestClient, post: Post, operations: FakeOperations, tower: Any, properties: Any
):
    """The first drive stepped by 6 mrad between the 8th and the 9th of May."""
    for number, taken in enumerate(photographs(tower, properties, step_mrad=6.0)):
        post(png(number), **taken)
    calibrate(client)
    asked = {
        "heliostat": "AA39",
        "surface": "ideal",
        "target": "lower",
        "motor_position": [40000, 40000],
    }

    def angles(sun: dict[str, Any]) -> np.ndarray:
        assert client.post("/v1/forecasts", json={**asked, "sun": sun}).status_code == 201
        return np.asarray(operations.forecasts[-1]["angles"])

    early, late = (angles({"at": f"2024-05-{day:02d}T11:30:00Z"}) for day in (4, 14))
    assert (late - early)[0] == pytest.approx(6e-3, abs=1.5e-3)
    np.testing.assert_allclose(angles(SUN), late, atol=1e-3)
    calibrate(client, since="2024-05-10T00:00:00Z")  # a mount that knows nothing of the days before
    np.testing.assert_allclose(angles({"at": "2024-05-04T11:30:00Z"}), early, atol=1e-9)

    path, place = (
        "/v1/heliostats/AA39/motors",
        read_heliostat("AA39", properties, np.array(ORIGIN)).position,
    )
    for time in ("2024-05-04T11:30:00Z", "2024-05-14T11:30:00Z"):
        motors = client.post(path, json={"sun": {"at": time}, "target": "lower"}).json()[
            "motor_position"
        ]
        known = client.post(
            "/v1/forecasts", json={**asked, "sun": {"at": time}, "motor_position": motors}
        )
        assert known.status_code == 201
        turned = operations.forecasts[-1]
        attitude = turned["mount"].attitude(turned["angles"])
        goal = turned["mount"].attitude(
            turned["mount"].align(place, turned["sun"], turned["plane"].center)
        )
        np.testing.assert_allclose(attitude, goal, atol=1e-5)


@pytest.mark.full
def test_some_are_calibrated_by_the_prior_of_all(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    """Five photographs lean on heliostats of their kind, also where the job names one
    of them only.
    """
    taken = photographs(tower, properties)
    for number, one in enumerate(taken[:5]):
        post(png(number), **one)
    seeds = itertools.count(len(taken))
    for name in ("AB01", "AB02", "AB03", "AB04", "AB05", "AB06"):
        client.put(f"/v1/heliostats/{name}", json=properties)
        for one in taken:
            assert post(png(next(seeds)), heliostat=name, **one).status_code == 201
    assert (
        client.post("/v1/jobs/calibrations", json={"heliostats": ["AA39", "nobody"]}).status_code
        == 404
    )
    job = calibrate(client, heliostats=["AA39"])
    assert job["result"]["mounts"] == {"AA39": 1}
    assert client.get("/v1/heliostats/AB01/mounts/current").status_code == 404
    parameters = client.get("/v1/heliostats/AA39/mounts/current").json()["parameters"]
    assert parameters["foundation_up"]["prior_std"] < 0.8 * SPREAD[NAMES.index("foundation_up")]
    assert parameters["second_zero"]["prior_std"] < 0.8 * SPREAD[NAMES.index("second_zero")]


@pytest.mark.full
def test_all_forecasts_use_the_calibrated_mount(
    client: TestClient, post: Post, operations: FakeOperations, tower: Any, properties: Any
):
    client.put("/v1/heliostats/AB01", json=properties)
    for number, taken in enumerate(photographs(tower, properties)):
        post(png(number), **taken)
    aim = {"sun": SUN, "surface": "ideal", "target": "lower"}

    def mounts() -> dict[str, Mount]:
        """Under a forecast with an aim, a surface's prediction, a comparison and a fleet's
        forecast.
        """
        client.post("/v1/forecasts", json={"heliostat": "AA39", **aim})
        assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code in (200, 201)
        post(png(99), taken_at=None)
        job = client.post("/v1/jobs/forecasts", json={**aim, "neighbours": True}).headers[
            "Location"
        ]
        until(lambda: client.get(job).json()["state"] == "done")
        setups = [setup for tile in operations.fleets[-1]["tiles"] for setup in tile.setups]
        assert [setup.heliostat.name for setup in setups] == ["AA39", "AB01"]
        assert not setups[1].heliostat.mount.is_calibrated
        return {
            "forecast": operations.forecasts[-1]["mount"],
            "prediction": operations.mounts["predict"],
            "comparison": operations.mounts["render"],
            "fleet": setups[0].heliostat.mount,
        }

    assert not any(mount.is_calibrated for mount in mounts().values())
    calibrate(client)
    parameters = client.get("/v1/heliostats/AA39/mounts/current").json()["parameters"]
    east = rotation(UP, parameters["foundation_up"]["value"]) @ rotation(
        NORTH, parameters["foundation_north"]["value"]
    )
    for name, mount in mounts().items():
        np.testing.assert_allclose(mount.first_axis, east[:, 0], atol=1e-9, err_msg=name)
    client.put("/v1/heliostats/AA39?reason=surveyed", json=properties | {"height": 2.5})
    assert not any(mount.is_calibrated for mount in mounts().values())


@pytest.mark.full
def test_photographs_newer_than_a_mount_say_to_a_study_where_motors_sent_the_light(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    taken = [one | {"kind": "flux"} for one in photographs(tower, properties)]
    for number, one in enumerate(taken[:14]):
        post(png(number), **one)
    calibrate(client)
    for number, one in enumerate(taken[14:], 14):
        post(png(number), **one)
    client.post("/v1/heliostats/AA39/surfaces", json={})
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        material = load_study_inputs(session, StudyIn(heliostats=["AA39"], images=16))
    known = [p for p in material.photographs if p.setup.angles is not None]
    assert len(material.photographs) == 16
    assert {p.key for p in known} == {"AA39/14", "AA39/15"}
    off = align([p.setup for p in known], PlantModel(Site.from_origin(ORIGIN))).displacements
    assert np.abs(off).max() < 3e-3
    assert all(p.spot_std_rad < 3e-3 and p.spot_shifts_rad is not None for p in known)


@pytest.mark.full
def test_mounts_hold_under_the_sun_they_were_calibrated_under(
    client: TestClient, post: Post, operations: FakeOperations, tower: Any, properties: Any
):
    """Every clock was 12 minutes slow: the mount is calibrated under the suns of then, and none is
    moved twice.
    """
    slow = {"effects": [{"name": "sun_position", "parameters": {"minutes": 12.0}}]}
    heliostat = read_heliostat("AA39", properties, np.array(ORIGIN))
    for number, taken in enumerate(photographs(tower, properties, clock_minutes=12.0)):
        post(png(number), **taken)
    calibrate(client)
    assert client.get("/v1/heliostats/AA39/mounts/current").json()["sun"] == []
    assert (
        client.put("/v1/plant?reason=surveyed", json={**tower, "declared": slow}).status_code == 200
    )
    refused = client.post("/v1/heliostats/AA39/motors", json={"sun": SUN, "target": "lower"})
    assert refused.status_code == 409
    assert "moves the sun otherwise" in refused.json()["detail"]
    calibrate(client)
    mount = client.get("/v1/heliostats/AA39/mounts/current").json()
    assert mount["sun"] == slow["effects"]
    assert mount["predicted_error_mrad"]["median"] < 1

    np.testing.assert_allclose(sent(client, operations, heliostat), [0, 0], atol=0.02)


def test_a_tilt_acts_on_a_mount_that_was_never_calibrated(
    client: TestClient, operations: FakeOperations, tower: Any, properties: Any
):
    """Motors for an aim, and the light of those motors, by one mount."""
    heliostat = read_heliostat("AA39", properties, np.array(ORIGIN))
    tilt = {"effects": [{"name": "axis_tilt", "parameters": {"north_deg": 1.0, "up_deg": -2.0}}]}
    assert (
        client.put("/v1/plant?reason=surveyed", json={**tower, "declared": tilt}).status_code == 200
    )
    np.testing.assert_allclose(sent(client, operations, heliostat), [0, 0], atol=0.02)


def sent(client: TestClient, operations: FakeOperations, heliostat: Heliostat) -> np.ndarray:
    """Where light lands on a target (2,) [m] by the forecast from the motors that shall send it to
    the middle.
    """
    asked = {"sun": SUN, "target": "lower"}
    motors = client.post("/v1/heliostats/AA39/motors", json=asked).json()["motor_position"]
    forecast = {"heliostat": "AA39", "surface": "ideal", "motor_position": motors, **asked}
    assert client.post("/v1/forecasts", json=forecast).status_code == 201
    made = operations.forecasts[-1]
    mirror = replace(heliostat, mount=made["mount"])
    shot = Setup(
        mirror, control_points(heliostat), made["sun"], made["plane"], angles=made["angles"]
    )
    scene = align([shot], made["model"], dtype=torch.float64).groups[0].scene
    spot: np.ndarray = central_rays(scene, 8).spot[0].numpy()
    return spot


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"sun": SUN}, "aim_point_m or target"),
        ({"target": "lower"}, "sun: "),
        ({"target": "lower", "sun": {"at": "2024-06-03T00:00:00Z"}}, "below the horizon"),
        (
            {"aim_point_m": [0.0, 300.0, 1.0], "sun": {"azimuth_deg": 0.0, "elevation_deg": 2.0}},
            "travel|far|reach",
        ),
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
    both = client.post(
        "/v1/forecasts", json={**asked, "motor_position": [1, 1], "aim_point_m": [0, 0, 0]}
    )
    assert both.status_code == 422


def test_nothing_to_calibrate_is_said(client: TestClient, post: Post):
    post(png(1))
    job = calibrate(client)
    assert job["state"] == "failed"
    assert "no heliostat can be calibrated" in job["reason"]


def test_the_plan_asks_for_what_is_known_least(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    for number, taken in enumerate(photographs(tower, properties)):
        post(png(number), **taken)
    client.put("/v1/heliostats/AB01", json=properties)
    calibrate(client)
    plan = client.get(
        "/v1/calibration-plan", params={"at": NOON, "photographs": 3, "minutes": 30}
    ).json()["items"]
    assert [one["heliostat"] for one in plan] == ["AB01", "AA39"]
    assert plan[0]["information_bits"] > 2 * plan[1]["information_bits"] > 0
    assert plan[0]["at"] == "2024-06-03T11:35:00Z"
    assert plan[0]["reason"] == "its mount was never calibrated"
    assert plan[1]["reason"].startswith("its mount is known by ")
    night = client.get("/v1/calibration-plan", params={"at": "2024-06-03T00:00:00Z"})
    assert night.status_code == 422
    asked = {"at": NOON, "photographs": 3, "minutes": 30}
    page = client.get("/calibration-plan", params=asked, headers={"Accept": "text/html"}).text
    rows = Page(page).one("tbody").all("tr")
    assert [row.all("a")[0]["href"] for row in rows] == ["/heliostats/AB01", "/heliostats/AA39"]
    assert "its mount was never calibrated" in page
    dark = client.get(
        "/calibration-plan", params={"at": "2024-06-03T00:00"}, headers={"Accept": "text/html"}
    ).text
    assert "The sun is below the horizon then; choose another time." in dark


def test_the_plans_page_says_what_it_takes(client: TestClient, tower: Any, properties: Any):
    client.put("/v1/plant", json=tower)
    properties["kinematics_properties"]["actuators"] = [{"type_axis": "ideal"}] * 2
    client.put("/v1/heliostats/AA39?reason=surveyed", json=properties)
    page = client.get(
        "/calibration-plan", params={"at": NOON}, headers={"Accept": "text/html"}
    ).text
    assert "No heliostat can be aimed at a target then" in page
    assert "kinematics_properties.actuators" in page


@pytest.mark.full
def test_changed_properties_ask_for_another_calibration(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    for number, taken in enumerate(photographs(tower, properties)):
        post(png(number), **taken)
    calibrate(client)
    properties["kinematics_properties"]["actuators"][0]["initial_angle"] += 0.01
    client.put("/v1/heliostats/AA39?reason=surveyed", json=properties)
    answer = client.post("/v1/heliostats/AA39/motors", json={"sun": SUN, "target": "lower"})
    assert answer.status_code == 409
    assert "changed since it was calibrated" in answer.text
    assert client.delete("/v1/heliostats/AA39?reason=mistake").status_code == 409
