"""What alarms and causes offer: requests that REST and the buttons of pages do as they are."""

import json
from datetime import UTC, datetime, timedelta
from html import unescape
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from model.ephemeris import sun_positions
from service.twin.alarms import offers
from service.twin.alarms.alarms import Alarm
from service.twin.alarms.causes import HeliostatFacts, LikelyCause, PhotographFacts, rank_causes
from service.twin.alarms.common_causes import find_bursts
from service.twin.alarms.field_overview import HeliostatOverview
from service.twin.alarms.reasons import Reason
from service.twin.pointing_errors import DriveStep, PointingState
from tests.service.conftest import ORIGIN, Post, properties_document
from tests.service.conftest import png as image
from tests.service.twin.test_open_causes import PHOTOGRAPHS, SURFACE
from tests.service.web.pages import HTML

NOON = datetime(2026, 6, 1, 11, tzinfo=UTC)


def send(client: TestClient, offer: dict[str, Any]) -> Any:
    """Send what is offered, which must be accepted."""
    answer = client.request(offer["method"], offer["path"], json=offer["body"])
    assert answer.status_code < 300, (offer, answer.text)
    return answer.json()


def causes_of(client: TestClient, name: str) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = client.get(f"/v1/heliostats/{name}/causes").json()["items"]
    return items


def send_by_wrong_clock(post: Post, name: str, number: int) -> None:
    """Post a photograph by a clock that is an hour ahead."""
    azimuth, elevation = sun_positions([NOON], ORIGIN)[0].tolist()
    sun = {"azimuth_deg": azimuth, "elevation_deg": elevation}
    at = (NOON + timedelta(hours=1)).isoformat()
    assert post(image(number), name, id=f"{number}", taken_at=at, sun=sun).status_code == 201


def time_of(client: TestClient, name: str, number: int) -> str:
    found: str = client.get(f"/v1/heliostats/{name}/measurements/{number}").json()["taken_at"]
    return found


def test_a_clock_is_corrected_by_one_request_for_a_heliostat(client: TestClient, post: Post):
    send_by_wrong_clock(post, "AA39", 1)
    (offer,) = (one["offer"] for one in causes_of(client, "AA39") if one["kind"] == "clock")
    assert offer["label"] == "Set the times of its photograph 1 h earlier"
    assert send(client, offer) == {"given": 1, "changed": 1}
    assert time_of(client, "AA39", 1) == NOON.strftime("%Y-%m-%dT%H:%M:%SZ")
    assert client.get("/v1/alarms", params={"reason": "sun_contradicts_time"}).json()["items"] == []
    assert "clock" not in [one["kind"] for one in causes_of(client, "AA39")]


def test_a_clock_is_corrected_by_one_button_for_all(client: TestClient, post: Post):
    for number, name in enumerate(("AB01", "AB02", "AB03"), 1):
        client.put(f"/v1/heliostats/{name}", json=properties_document())
        send_by_wrong_clock(post, name, number)
    (cause,) = client.get("/v1/alarms/causes").json()["items"]
    assert cause["offer"]["label"] == "Set the times of 3 photographs 1 h earlier"
    page = client.get("/alarms", headers=HTML).text
    chosen = unescape(page.split('name="offer" value="')[1].split('"')[0])
    done = client.post("/offers", data={"offer": chosen}, follow_redirects=False)
    assert (done.status_code, done.headers["Location"]) == (303, "/alarms")
    assert {time_of(client, f"AB0{n}", n) for n in (1, 2, 3)} == {"2026-06-01T11:00:00Z"}
    assert client.get("/v1/alarms/causes").json()["items"] == []


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/v1/keys", {}, 422),
        ("/v1/jobs/predictions", {"images": "many"}, 422),
        ("/v1/jobs/predictions", {"heliostats": ["AA39"]}, 303),
        ("/v1/heliostats/AA39/measurements/1", {"excluded": True, "reason": "clouds"}, 303),
        ("/v1/studies/7/adopt", {}, 404),
        ("/v1/heliostats/AA39/surfaces/current", {"version": 7, "reason": "as offered"}, 404),
    ],
)
def test_buttons_do_what_rest_does(
    client: TestClient, post: Post, path: str, body: dict[str, Any], status: int
):
    assert post(image(1), id="1").status_code == 201
    asked = {"path": path, "body": body, "back": "/heliostats/AA39"}
    done = client.post("/offers", data={"offer": json.dumps(asked)}, follow_redirects=False)
    assert done.status_code == status, done.text


@pytest.mark.parametrize("by_page", [False, True])
def test_a_surface_is_made_active_as_offered(client: TestClient, post: Post, by_page: bool):
    for number in (1, 2):
        assert post(image(number), id=f"{number}").status_code == 201
        body = {"measurements": [f"{number}"]}
        assert client.post("/v1/heliostats/AA39/surfaces", json=body).status_code == 201
    active = client.get("/v1/heliostats/AA39/surfaces/current").json()["version"]
    offer = offers.activate("AA39", 3 - active, "the mirror changed")
    if by_page:
        asked = {**offer, "back": "/heliostats/AA39"}
        done = client.post("/offers", data={"offer": json.dumps(asked)}, follow_redirects=False)
        assert (done.status_code, done.headers["Location"]) == (303, "/heliostats/AA39")
    else:
        send(client, dict(offer))
    chosen = client.get("/v1/heliostats/AA39/surfaces/current").json()["version"]
    assert chosen == 3 - active
    (last, *_) = client.get("/v1/heliostats/AA39/surfaces/decisions").json()["items"]
    assert last["reason"] == "the mirror changed"


def test_a_page_never_leads_elsewhere(client: TestClient):
    asked = {"path": "/v1/jobs/predictions", "body": {}, "back": "//example.org"}
    assert client.post("/offers", data={"offer": json.dumps(asked)}).status_code == 422


def test_a_photograph_of_a_neighbour_is_excluded_and_its_surface_made_again():
    warning = {"type": "unlike_heliostat", "like": "R02", "detail": "unlike it"}
    foreign = PhotographFacts("7", None, (0.0, -0.8, 0.6), 0.5, (warning,), was_used=True)
    line = HeliostatOverview("R01", 0, 0, surface=SURFACE)
    ranked = rank_causes(HeliostatFacts(0.75, [*PHOTOGRAPHS, foreign], line, {}))
    (offer,) = (one.offer for one in ranked if one.kind == "foreign_light")
    assert offer is not None
    assert offer["path"] == "/v1/heliostats/R01/measurements/7"
    assert (offer["body"]["excluded"], offer["body"]["predict_again"]) == (True, True)


def cause_of(reason: Reason, **about: Any) -> LikelyCause:
    """The cause of an open alarm."""
    line = HeliostatOverview("R03-05", 0, 0, surface=SURFACE)
    alarm = Alarm(reason, "R03-05", NOON, "said so", "do", "", **about)
    facts = HeliostatFacts(0.5, PHOTOGRAPHS, line, {}, alarms={reason: alarm})
    return next(one for one in rank_causes(facts) if one.evidence == "said so")


def test_lost_light_is_acknowledged():
    offer = cause_of("dimmed").offer
    assert offer is not None
    assert (offer["path"], offer["label"]) == (
        "/v1/alarms/acknowledgements",
        "Acknowledge, and have it cleaned",
    )


def test_drives_that_stepped_are_calibrated_once():
    again = offers.calibrate(["R03-05"])
    assert cause_of("moved", offer=again).offer == again
    assert cause_of("moved").offer is None  # the mount knows the step


def test_alarms_whose_changes_may_be_one_are_a_burst():
    """Photographs come every few days, and each shows the same change."""
    moments = [NOON + timedelta(days=day) for day in (0, 1.5, 2, 3, 4)]
    alarms = [Alarm("fell", f"R{n}", at, "", "", "") for n, at in enumerate(moments)]
    assert find_bursts(alarms) == []
    begins = {one.key: NOON - timedelta(days=1) for one in alarms}
    (burst,) = find_bursts(alarms, begins)
    assert len(burst) == 5


def test_studies_of_many_heliostats_keep_the_limit(app: FastAPI, client: TestClient):
    offer = offers.study([f"R{n:03d}" for n in range(60)], NOON)
    assert len(offer["body"]["heliostats"]) * offer["body"]["images"] <= 400  # type: ignore[arg-type, operator]
    offer["body"]["heliostats"] = ["AA39"]
    assert "job" in str(send(client, dict(offer)))


def test_photographs_of_a_spot_that_moved_are_not_excluded():
    """They are truncated, and say so; the mount is to be calibrated."""
    taken = [NOON + timedelta(days=day) for day in range(12)]
    shown = [
        PhotographFacts(str(day), at, (0.0, -0.8, 0.6), 0.6 if day > 9 else 0.97)
        for day, at in enumerate(taken)
    ]
    moved = DriveStep(taken[9], taken[10], 9.0, False)
    pointing = PointingState(1, NOON, 9.0, 8, 2, moved=moved)
    for state, kinds in ((None, {"foreign_light"}), (pointing, {"moved"})):
        line = HeliostatOverview("R01", 0, 0, surface=SURFACE, pointing=state)
        ranked = rank_causes(HeliostatFacts(0.75, shown, line, {}))
        assert {one.kind for one in ranked} == kinds
