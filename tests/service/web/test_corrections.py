"""Photographs that were known wrongly: refused when they differ, corrected or excluded with a
reason, history kept.
"""

from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.store.columns import now
from service.store.image_files import digest
from service.store.tables import ImageRow
from tests.service.conftest import FakeOperations, Post, png, sun_at

BASE = "/v1/heliostats/AA39/measurements"
HTML = {"Accept": "text/html"}


@pytest.fixture
def known(client: TestClient, post: Post) -> TestClient:
    """A photograph under a wrong sun, and a surface that was made from it."""
    assert post(id="1", sun=sun_at(160.0), taken_at="2024-05-01T10:00:00Z").status_code == 201
    assert post(png(2), id="2", sun=sun_at(200.0)).status_code == 201
    assert (
        client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["1"]}).status_code == 201
    )
    return client


def patch(client: TestClient, **changes: Any) -> Any:
    return client.patch(f"{BASE}/1", json={"reason": "the clock was wrong", **changes})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sun": sun_at(150.0)}, "sun.azimuth_deg: 160.0 is stored, 150.0 was sent"),
        ({"target": "upper"}, "target: lower is stored, upper was sent"),
        ({"taken_at": "2024-05-01T11:00:00Z"}, "taken_at: 2024-05-01T10:00:00Z is stored"),
    ],
)
def test_same_image_with_other_values_is_a_conflict(
    known: TestClient, post: Post, changes: dict[str, Any], said: str
):
    answer = post(**{"id": "1", "sun": sun_at(160.0), **changes})
    assert answer.status_code == 409
    assert said in answer.json()["detail"]
    assert f"PATCH {BASE}/1" in answer.json()["detail"]
    assert known.get(f"{BASE}/1").json()["sun"] == sun_at(160.0)


def test_weather_is_corrected_and_outdates_nothing(known: TestClient, operations: FakeOperations):
    measured = operations.measured
    body = patch(known, wind_speed_m_s=4.5, wind_from_deg=210.0).json()
    now_known = {
        name: body["measurement"][name]
        for name in ("wind_speed_m_s", "wind_from_deg", "temperature_c")
    }
    assert now_known == {"wind_speed_m_s": 4.5, "wind_from_deg": 210.0, "temperature_c": None}
    assert (
        patch(known, temperature_c=-3.0, wind_from_deg=30).json()["measurement"]["wind_speed_m_s"]
        == 4.5
    )
    first, second = known.get(f"{BASE}/1/corrections").json()["items"]
    assert first["before"] == {"wind_speed_m_s": None, "wind_from_deg": None}
    assert (second["before"]["wind_from_deg"], second["after"]["wind_from_deg"]) == (210.0, 30.0)
    assert patch(known, temperature_c=-3.0).status_code == 409
    assert patch(known, temperature_c=90.0).json()["detail"] == "temperature_c: must be 60 or less"
    assert operations.measured == measured
    assert known.get("/v1/heliostats/AA39/surfaces/1").json()["outdated"] == []


def test_photograph_is_corrected_and_its_history_kept(
    known: TestClient, post: Post, operations: FakeOperations
):
    measured = operations.measured
    answer = patch(known, sun=sun_at(150.0))
    assert answer.status_code == 200
    body = answer.json()
    assert (body["measurement"]["sun"], body["surface_versions"], body["job"]) == (
        sun_at(150.0),
        [1],
        None,
    )
    assert body["measurement"]["corrected_at"] is not None
    assert operations.measured == measured  # its light is the same
    (kept,) = known.get(f"{BASE}/1/corrections").json()["items"]
    assert (kept["before"], kept["after"]) == (
        {"sun.azimuth_deg": 160.0},
        {"sun.azimuth_deg": 150.0},
    )
    assert (kept["created_by"], kept["reason"]) == ("local", "the clock was wrong")
    assert known.get("/v1/audit").json()["items"][0]["action"] == "measurement.corrected"
    assert known.get("/v1/heliostats/AA39/surfaces/1").json()["outdated"] == ["1"]
    # The measurement is known, with the values that were sent first and with the corrected ones.
    for azimuth in (160.0, 150.0):
        assert post(id="1", sun=sun_at(azimuth), taken_at="2024-05-01T10:00:00Z").status_code == 200
    assert patch(known, sun=sun_at(150.0)).status_code == 409


def test_another_target_is_measured_again(known: TestClient, operations: FakeOperations):
    measured = operations.measured
    assert patch(known, target="upper").json()["measurement"]["target"] == "upper"
    assert operations.measured == measured + 1
    assert patch(known, target="nowhere").status_code == 404


def test_excluded_photograph_is_not_used(known: TestClient):
    body = patch(known, excluded=True, reason="a bird").json()["measurement"]
    assert (body["accepted"], body["reason"]) == (False, "excluded")
    made = known.post("/v1/heliostats/AA39/surfaces", json={}).json()
    assert made["measurements"] == ["2"]
    refused = known.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["1"]})
    assert (refused.status_code, "excluded" in refused.json()["detail"]) == (409, True)
    back = patch(known, excluded=False, reason="it was no bird").json()["measurement"]
    assert (back["accepted"], back["reason"]) == (True, None)
    assert known.get(f"{BASE}/1/flux").status_code == 200


def test_correction_is_of_the_photograph_in_all_its_images(known: TestClient, post: Post):
    """Else the next prediction would use the same photograph as another kind of image shows it."""
    for seed, kind in ((3, "flux-centered"), (4, "cropped")):
        assert (
            post(
                png(seed, refused=kind == "cropped"), id="1", kind=kind, sun=sun_at(160.0)
            ).status_code
            == 201
        )
    siblings = ("1", "1-flux-centered", "1-cropped")
    # Asked of an image that nothing was made from.
    body = known.patch(
        f"{BASE}/1-flux-centered", json={"reason": "clock", "sun": sun_at(150.0), "excluded": True}
    ).json()
    assert (body["measurement"]["id"], body["surface_versions"]) == ("1-flux-centered", [1])
    for identifier in siblings:
        row = known.get(f"{BASE}/{identifier}").json()
        assert (row["sun"], row["accepted"], row["reason"]) == (sun_at(150.0), False, "excluded")
        (kept,) = known.get(f"{BASE}/{identifier}/corrections").json()["items"]
        assert kept["before"] == {"sun.azimuth_deg": 160.0, "excluded": False}
    assert known.post("/v1/heliostats/AA39/surfaces", json={}).json()["measurements"] == ["2"]
    excluded = known.get("/heliostats/AA39?photographs=excluded", headers=HTML).text
    assert '/heliostats/AA39/photographs/1">1</a>' in excluded
    assert '/heliostats/AA39/photographs/2">2</a>' not in excluded
    # An image of it that comes later is excluded too.
    late = post(png(5), id="1", kind="raw", sun=sun_at(150.0)).json()
    assert (late["accepted"], late["reason"]) == (False, "excluded")
    assert patch(known, excluded=False).status_code == 200
    accepted = {
        name: known.get(f"{BASE}/{name}").json()["accepted"] for name in (*siblings, "1-raw")
    }
    assert accepted == {"1": True, "1-flux-centered": True, "1-cropped": False, "1-raw": True}
    assert known.get(f"{BASE}/1-cropped").json()["reason"] == "no_spot"


def test_surfaces_made_from_it_are_predicted_again_on_request(known: TestClient):
    job = patch(known, sun=sun_at(150.0), predict_again=True).json()["job"]
    asked = known.get(f"/v1/jobs/{job}").json()
    assert (asked["kind"], asked["payload"]["heliostats"], asked["payload"]["method"]) == (
        "predictions",
        ["AA39"],
        "network",
    )


@pytest.mark.parametrize(
    "body", [{}, {"reason": "x"}, {"sun": sun_at(179.0)}, {"reason": "x", "sun": "1"}]
)
def test_correction_says_what_and_why(known: TestClient, body: dict[str, Any]):
    assert known.patch(f"{BASE}/1", json=body).status_code == 422


def test_photograph_without_its_image_keeps_its_target(known: TestClient):
    app: Any = known.app
    with app.state.runtime.database.writing() as session:
        image = session.get_one(ImageRow, digest(png()))
        image.pruned_at, image.pruned_for = now(), "age"
    answer = patch(known, target="upper")
    assert (answer.status_code, "exclude it instead" in answer.json()["detail"]) == (410, True)
    assert patch(known, sun=sun_at(179.0)).status_code == 200


def test_page_corrects_and_excludes(known: TestClient):
    path = "/heliostats/AA39/photographs/1"
    form = {
        "target": "lower",
        "azimuth_deg": "150.0",
        "elevation_deg": "45.0",
        "reason": "<b>clock</b>",
    }
    answer = known.post(path, data=form, headers=HTML, follow_redirects=False)
    assert (answer.status_code, answer.headers["Location"]) == (303, path)
    page = known.get(path, headers=HTML).text
    assert "sun azimuth: 160.0 → 150.0" in page
    assert "&lt;b&gt;clock&lt;/b&gt;" in page
    assert "corrected since" in known.get("/heliostats/AA39", headers=HTML).text
    form |= {"excluded": "true", "predict_again": "true"}
    answer = known.post(path, data=form, headers=HTML, follow_redirects=False)
    assert answer.headers["Location"] == "/jobs/1"
    assert "excluded" in known.get("/heliostats/AA39", headers=HTML).text
    history = known.get(path, headers=HTML).text
    assert ">excluded</td>" in history
    assert "True" not in history
