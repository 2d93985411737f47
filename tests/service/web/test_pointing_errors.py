"""The pointing error of the newest photographs on pages, REST and metrics: size, trend, and moves
with their dates.
"""

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.twin.pointing_errors import DriveStep
from tests.page import Page
from tests.service.conftest import QUIET, Post, png, until
from tests.service.spots import calibrate, photographs

HTML = {"Accept": "text/html"}
PATH = "/v1/heliostats/AA39/pointing"


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", **QUIET | {"job_workers": 1, "job_poll_s": 0.05})


def of_field(client: TestClient) -> Any:
    """The pointing errors of the field, after all of them are computed."""
    until(lambda: client.get("/v1/pointing").json()["pending"] == 0)
    return client.get("/v1/pointing").json()


def test_without_a_calibration_there_is_none(client: TestClient):
    assert client.get(PATH).status_code == 404
    assert of_field(client) == {"items": [], "next": None, "pending": 0}


@pytest.mark.full
def test_newest_photographs_are_held_against_the_mount(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    receiver = {
        "center": [0.0, -3.0, 55.0],
        "normal": [0.0, 1.0, 0.0],
        "radius": 4.14,
        "height": 6.0,
    }
    assert client.put("/v1/receivers/cavity", json=receiver).status_code == 201
    taken = photographs(tower, properties)
    for number, one in enumerate(taken[:14]):
        assert post(png(number), **one).status_code == 201
    calibrate(client)
    before = client.get(PATH).json()
    assert before["since_calibration"] == 0
    assert before["error_mrad"] < 1
    assert (before["moved"], before["drifted"], before["trend_mrad"]) == (None, None, None)
    post(png(90), **taken[14])
    after = client.get(PATH).json()
    assert (after["since_calibration"], after["photographs"]) == (1, 8)
    assert after["error_m"] == pytest.approx(1e-3 * after["error_mrad"] * 61, rel=0.2)
    best = after.pop("most_informative")
    assert of_field(client)["items"] == [after]
    assert (best["heliostat"], best["sun"]["elevation_deg"] >= 10) == ("AA39", True)
    page, field = (
        client.get("/heliostats/AA39", headers=HTML).text,
        client.get("/?metric=pointing_error_mrad", headers=HTML).text,
    )
    for answer in (page, field):
        assert "m on the receiver" in answer.replace("\N{NO-BREAK SPACE}", " ")
        assert 'href="/calibration-plan"' in answer
    assert "A photograph is most informative <time" in page
    assert re.fullmatch(r"var\(--s[0-8]\)", Page(field).one("path", class_="mirrors")["fill"])
    metrics = client.get("/metrics").text
    assert 'heliotwin_heliostat_pointing_error_mrad{heliostat="AA39"} ' in metrics
    assert 'heliotwin_heliostat_pointing_error_metres{heliostat="AA39"} ' in metrics


def test_move_since_the_calibration_is_reported_with_its_dates(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    taken = photographs(tower, properties, step_mrad=25.0)
    for number, one in enumerate(taken[:8]):
        post(png(number), **one)
    calibrate(client)
    post(png(50), **taken[8])
    assert client.get(PATH).json()["moved"] is None  # one alone may be another's spot
    for number, one in enumerate(taken[9:]):
        post(png(60 + number), **one)
    answer = client.get(PATH).json()
    assert (answer["moved"]["when"], answer["moved"]["is_calibrated"]) == (
        "between 2024-05-08 12:00 UTC and 2024-05-09 12:00 UTC",
        False,
    )
    assert answer["moved"]["size_mrad"] > 20
    assert answer["error_mrad"] == pytest.approx(answer["moved"]["size_mrad"])
    assert (
        "AA39 moved between 2024-05-08 12:00 UTC and 2024-05-09 12:00 UTC"
        in client.get("/heliostats/AA39", headers=HTML).text
    )
    moment = datetime(2024, 5, 9, 12, tzinfo=UTC).timestamp()
    of_field(client)
    (line,) = [
        one
        for one in client.get("/metrics").text.splitlines()
        if one.startswith("heliotwin_heliostat_moved")
    ]
    assert float(line.split()[1]) == moment
    calibrate(client)
    known = client.get(PATH).json()
    assert (known["moved"]["when"], known["moved"]["is_calibrated"]) == (
        "between 2024-05-08 12:00 UTC and 2024-05-09 12:00 UTC",
        True,
    )
    assert known["error_mrad"] < 2
    of_field(client)
    assert (
        "moved between 2024-05-08 12:00 UTC and 2024-05-09 12:00 UTC"
        in client.get("/", headers=HTML).text
    )


def test_spots_that_came_back_are_no_move(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    """As those of photographs that show another heliostat."""
    as_ever, moved = photographs(tower, properties), photographs(tower, properties, 25.0)
    taken = [*as_ever[:8], *moved[8:12], *as_ever[12:]]
    for number, one in enumerate(taken):
        if number == 8:
            calibrate(client)
        assert post(png(number), **one).status_code == 201
        is_away = number in (10, 11)
        if number >= 8:
            assert (client.get(PATH).json()["moved"] is not None) >= is_away, number
    answer = client.get(PATH).json()
    assert (answer["moved"], answer["error_mrad"] < 2) == (None, True)


@pytest.mark.full
def test_photographs_without_a_time_say_of_no_move(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    for number, one in enumerate(photographs(tower, properties, step_mrad=25.0)):
        if number in (8, 12):
            calibrate(client)
        post(png(number), **{name: value for name, value in one.items() if name != "taken_at"})
        post(
            png(100 + number), **{**one, "kind": "flux", "taken_at": None}
        )  # another image of the same photograph
    calibrate(client)
    known = client.get(PATH).json()
    assert (known["since_calibration"], known["moved"], known["error_mrad"]) == (0, None, None)
    assert client.get("/v1/heliostats/AA39/mounts/current").json()["steps"] == []
    assert client.get("/v1/alarms", params={"reason": "moved"}).json()["items"] == []


@pytest.mark.full
def test_a_growing_error_has_a_trend(client: TestClient, post: Post, tower: Any, properties: Any):
    taken = photographs(tower, properties)
    for number, one in enumerate(taken[:7]):
        post(png(number), **one)
    calibrate(client)
    for number, one in enumerate(taken[7:]):
        east, north, up = one["focal_spot_m"]
        aside = [east + 0.07 * max(0, number - 2), north, up]
        post(png(50 + number), **one | {"focal_spot_m": aside})
    assert client.get(PATH).json()["trend_mrad"] > 1


@pytest.mark.full
def test_a_mount_that_fits_no_more_has_no_pointing_error(
    client: TestClient, post: Post, tower: Any, properties: Any
):
    for number, one in enumerate(photographs(tower, properties)):
        post(png(number), **one)
    calibrate(client)
    assert client.get(PATH).status_code == 200
    properties["kinematics_properties"]["actuators"][0]["initial_angle"] += 0.01
    client.put("/v1/heliostats/AA39?reason=surveyed", json=properties)
    assert client.get(PATH).status_code == 404
    assert client.get("/heliostats/AA39", headers=HTML).status_code == 200


def test_the_times_of_a_step_are_iso_in_utc():
    first, last = datetime(2024, 7, 30, 9, tzinfo=UTC), datetime(2024, 8, 2, 9, 5, tzinfo=UTC)
    assert (
        DriveStep(first, last, 1.0, True).when
        == "between 2024-07-30 09:00 UTC and 2024-08-02 09:05 UTC"
    )
