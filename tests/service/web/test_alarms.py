"""Alarms: each reason, its acknowledgement and when that ends, on the page, over REST and
as metrics.
"""

import itertools
import json
import re
from collections.abc import Iterator
from datetime import UTC, date, datetime, timedelta
from functools import partial
from html import unescape
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import URL, select, update

from model.ephemeris import sun_angles_at
from model.times import format_minute
from service import store
from service.base.settings import Settings
from service.store import keys, queue
from service.store.columns import now
from service.store.job_tables import AuditRow, JobRow
from service.store.tables import DriftRow, HeliostatRow, MeasurementRow
from service.twin.alarms.reasons import REASONS, AlarmCount, Reason
from service.twin.surfaces.present_shape import find_accuracy_fall
from service.web.app import create_app
from tests.service.conftest import (
    ORIGIN,
    QUIET,
    FakeOperations,
    Post,
    client_of,
    png,
    poster,
    properties_document,
    sun_at,
    tower_document,
    until,
)
from tests.service.spots import calibrate, photographs
from tests.service.studies import SLOPE, study_row
from tests.service.web.operations import Doubter

HTML = {"Accept": "text/html"}
PATH = "/v1/alarms"


class Blind(FakeOperations):
    """Forecasts all light elsewhere while ``is_blind``."""

    is_blind = True

    def render(self, *arguments: Any, **options: Any) -> Any:
        shown = super().render(*arguments, **options)
        if self.is_blind:
            shown[:, 32:] = 0
        return shown


def items(client: TestClient, **query: Any) -> list[dict[str, Any]]:
    until(lambda: client.get(PATH).json()["pending"] == 0)
    found: list[dict[str, Any]] = client.get(PATH, params={"limit": 500, **query}).json()["items"]
    return found


def of(client: TestClient, reason: str) -> list[dict[str, Any]]:
    return items(client, reason=reason)


def acknowledge(client: TestClient, *found: dict[str, Any]) -> Any:
    body = {"ids": [item["id"] for item in found], "reason": "seen"}
    return client.post(f"{PATH}/acknowledgements", json=body)


def recent(days: int = 1) -> dict[str, Any]:
    """A time some days ago, and the sun's position at that time."""
    moment = (now() - timedelta(days=days)).replace(hour=11, minute=0, second=0, microsecond=0)
    azimuth, elevation = sun_angles_at(moment, ORIGIN)
    return {"taken_at": moment.isoformat(), "sun": sun_at(azimuth, elevation)}


def test_every_reason_has_its_words():
    assert set(REASONS) == set(get_args(Reason))


def test_no_alarm_where_all_is_well(client: TestClient, post: Post):
    post(png(1), **recent())
    assert items(client) == []
    assert "Nothing." in client.get("/alarms", headers=HTML).text
    assert client.get("/alarms/count", headers=HTML).text == ""


def test_month_without_a_photograph(app: FastAPI, client: TestClient, post: Post):
    post(png(1), id="1", **recent())
    long_ago = now() - timedelta(days=40)
    with app.state.runtime.database.writing() as session:
        session.execute(update(MeasurementRow).values(taken_at=long_ago))
    (item,) = items(client)
    assert (item["heliostat"], item["reason"]) == ("AA39", "no_photograph")
    assert item["message"] == f"the last accepted one is of {format_minute(long_ago)}"
    assert datetime.fromisoformat(item["since"]) == pytest.approx(
        long_ago + timedelta(days=30), abs=timedelta(0.01)
    )
    assert acknowledge(client, item).json()["items"][0]["acknowledged_by"] == "local"
    assert [one["acknowledged_by"] for one in items(client)] == ["local"]
    assert items(client, acknowledged=False) == []
    post(png(2), id="2", **recent())
    assert items(client) == []
    with app.state.runtime.database.writing() as session:
        session.execute(update(MeasurementRow).values(taken_at=long_ago + timedelta(days=1)))
    (again,) = items(client, acknowledged=False)  # it returned: that nobody has seen
    assert again["id"] != item["id"]


def test_new_heliostat_has_a_month_too_and_can_be_deleted_when_seen(
    app: FastAPI, client: TestClient
):
    assert items(client) == []
    with app.state.runtime.database.writing() as session:
        session.execute(update(HeliostatRow).values(created_at=now() - timedelta(days=31)))
    (item,) = items(client)
    assert item["message"] == "none was ever accepted"
    acknowledge(client, item)
    assert client.delete("/v1/heliostats/AA39?reason=mistake").status_code == 204
    assert items(client) == []


@pytest.fixture
def blind(tmp_path: Path) -> Iterator[TestClient]:
    with client_of(create_app(Settings(data_dir=tmp_path, **QUIET), Blind())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        poster(client)(png(1), id="1")
        client.post("/v1/heliostats/AA39/surfaces", json={"method": "network"})
        yield client


def test_poor_forecasts_until_one_is_good_again(blind: TestClient):
    runtime = blind.app.state.runtime  # type: ignore[attr-defined]

    def post(image: bytes, number: str) -> None:
        poster(blind)(image, id=number, taken_at=f"2024-06-0{number}T11:30:00Z")

    post(png(2), "2")
    (item,) = of(blind, "accuracy")
    assert "with an accuracy of 0%, and 75% is the least" in item["message"]
    acknowledge(blind, item)
    post(png(3), "3")
    (still,) = of(blind, "accuracy")
    assert (still["id"], still["acknowledged_by"]) == (item["id"], "local")
    runtime.operations.is_blind = False
    post(png(4), "4")
    assert of(blind, "accuracy") == []
    runtime.operations.is_blind = True
    post(png(5), "5")
    (returned,) = of(blind, "accuracy")
    assert returned["acknowledged_by"] is None
    with runtime.database.reading() as session:
        assert session.scalars(select(DriftRow.poor_since)).one() == datetime.fromisoformat(
            returned["since"]
        )


class Worn(FakeOperations):
    """Forecasts whose accuracy is 95 to 97 % until 6 days ago, and then 80 to 82 %."""

    def render(self, heliostat: Any, observations: Any, *others: Any, **options: Any) -> Any:
        shown = super().render(heliostat, observations, *others, **options)
        elsewhere = np.zeros_like(shown)
        elsewhere[..., 0, 0] = shown.sum(axis=(-2, -1))
        days = [(now() - one.taken_at).days for one in observations]
        accuracies = [(0.95 if ago > 5 else 0.80) + 0.01 * (ago % 3) for ago in days]
        # It is missed where it is, and too much where it is not.
        share = (1 - np.array(accuracies)[:, None, None]) / 2
        return (1 - share) * shown + share * elsewhere


def test_accuracy_that_fell_above_the_least(tmp_path: Path):
    """From 95 to 80 %: no photograph is poor, and yet the mirror changed."""
    with client_of(create_app(Settings(data_dir=tmp_path, **QUIET), Worn())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        post = poster(client)
        post(png(1), id="1", **recent(19))
        client.post("/v1/heliostats/AA39/surfaces", json={"method": "network"})
        for number in range(2, 20):
            post(png(number), id=str(number), **recent(20 - number))
        (item,) = items(client)
        assert item["reason"] == "fell"
        said = r"fell between (\S+) .* and (\S+) .* are forecast with 81%, those before with 96%"
        first, last = re.search(said, item["message"]).groups()
        days = (date.fromisoformat(last) - date.fromisoformat(first)).days
        assert days == 1
        taken_at = datetime.fromisoformat(recent(5)["taken_at"])
        assert abs(datetime.fromisoformat(item["since"]) - taken_at) <= timedelta(days=1)
        assert "Accuracy fell" in client.get("/alarms", headers=HTML).text
        # The heliostat's page ranks it first, with a prediction from photographs since then.
        page = client.get("/heliostats/AA39", headers=HTML).text
        (first, *_) = re.findall(r"<strong>(.*?)</strong>.*?: (.*)", page[page.index("causes") :])
        assert first[0] == "The mirror changed"
        assert re.search(r"from 9\d\.\d% to 81\.\d%.*; \d photographs since show it", first[1])
        (offer, *_) = re.findall(r'name="offer" value="(.*?)"', page)
        since = json.loads(unescape(offer))["body"]["since"]
        assert datetime.fromisoformat(since) == datetime.fromisoformat(item["since"])
        form = {"offer": unescape(offer)}
        job = client.post("/offers", data=form, headers=HTML, follow_redirects=False)
        payload = client.get(f"/v1{job.headers['location']}").json()["payload"]
        assert datetime.fromisoformat(payload["since"]) == datetime.fromisoformat(since)
        # A photograph that was excluded says nothing of the mirror.
        for number in range(14, 20):
            path = f"/v1/heliostats/AA39/measurements/{number}"
            assert (
                client.patch(path, json={"reason": "a cloud", "excluded": True}).status_code == 200
            )
        assert items(client) == []


@pytest.mark.parametrize(
    ("accuracies", "first"),
    [
        ([0.95, 0.94, 0.96] * 4 + [0.80, 0.81, 0.79, 0.80, 0.82], 12),
        ([0.95, 0.94, 0.96] * 4 + [0.80, 0.81], 12),
        ([0.95, 0.94] + [0.80, 0.81], None),  # too few
        ([0.95, 0.94, 0.96] * 4 + [0.80], None),  # one alone
        ([0.95, 0.94, 0.96] * 4 + [0.80, 0.94, 0.95, 0.96], None),
        ([0.95, 0.70, 0.85, 0.80, 0.90] * 4 + [0.80, 0.95, 0.70, 0.85], None),  # they scatter so
        ([0.80, 0.81, 0.79] * 4 + [0.95, 0.94] * 3, None),  # it rose
        ([0.95, 0.94, 0.96] * 3 + [0.80, 0.81] * 3 + [0.95, 0.96, 0.94] * 2, None),  # haze ended
        ([0.95, 0.94, 0.96] * 3 + [0.80, 0.81] * 3 + [0.95, 0.96] * 3 + [0.85] * 4, 21),
    ],
)
def test_a_fall_is_more_than_chance(accuracies: list[float], first: int | None):
    times = [now() + timedelta(days=number) for number in range(len(accuracies))]
    fall = find_accuracy_fall(times, accuracies)
    assert (None if fall is None else times.index(fall.until)) == first
    assert fall is None or fall.min_drop > 0.05


def test_warnings_are_acknowledged_once_on_either_page(tmp_path: Path):
    with client_of(create_app(Settings(data_dir=tmp_path, **QUIET), Doubter())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        poster(client)(png(2), id="2", sun=sun_at(90.0))
        client.post("/v1/heliostats/AA39/surfaces", json={"method": "network"})
        (item,) = of(client, "untrusted")
        assert item["message"].startswith("photograph 2 is not explained")
        assert acknowledge(client, item).json()["items"][0]["acknowledged_by"] == "local"
        assert client.get("/v1/heliostats/AA39/surfaces/1").json()["acknowledged_by"] == "local"
        assert {one["reason"] for one in items(client, acknowledged=False)} == {"times_unknown"}


@pytest.fixture
def calibrating(tmp_path: Path) -> Iterator[TestClient]:
    """With a worker, and a bound that a mount calibrated by three photographs exceeds."""
    options = QUIET | {"job_workers": 1, "job_poll_s": 0.05, "alarm_pointing_mrad": 0.2}
    settings = Settings(data_dir=tmp_path, **options)
    with client_of(create_app(settings, FakeOperations())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        yield client


@pytest.mark.full
def test_moves_and_pointing_errors(calibrating: TestClient):
    client, post = calibrating, poster(calibrating)
    taken = photographs(tower_document(), properties_document(), step_mrad=25.0)
    for number, one in enumerate(taken[:10]):
        post(png(number), **one)
        if number == 7:
            calibrate(client)
    (moved,) = of(client, "moved")
    assert moved["message"].startswith(
        "it moved between 2024-05-08 12:00 UTC and 2024-05-09 12:00 UTC: its spot is "
    )
    assert datetime.fromisoformat(moved["since"]) == datetime(2024, 5, 9, 12, tzinfo=UTC)
    assert of(client, "pointing") == []  # one cause is reported once
    acknowledge(client, moved)
    calibrate(client)
    assert of(client, "moved") == []  # calibrated, and more than 90 days ago


@pytest.mark.full
def test_pointing_error_beyond_the_bound(calibrating: TestClient):
    client, post = calibrating, poster(calibrating)
    taken = photographs(tower_document(), properties_document())
    for number, one in enumerate(taken):
        if number == 3:
            calibrate(client)
        post(png(number), **one)
    (item,) = of(client, "pointing")
    pointing_error = client.get("/v1/heliostats/AA39/pointing").json()
    assert item["message"].startswith(f"its spot is {pointing_error['error_mrad']:.1f} mrad off")
    assert pointing_error["error_mrad"] > 0.2
    assert pointing_error["moved"] is None  # it knows how little it knows


def test_camera_that_a_study_found_changed_until_that_is_adopted(app: FastAPI, client: TestClient):
    since = {"kind": "since", "since": "2024-06-02", "heliostats": None}
    blur = {
        "name": "camera_blur",
        "parameters": {"sigma_m": {"value": 0.1, "ci95": [0.08, 0.12], "unit": "m"}},
    }
    of_both = partial(study_row, heliostats=["AA39", "AB01"])
    with app.state.runtime.database.writing() as session:
        ended = {"name": "camera_ghost", "parameters": {}, "scope": since | {"until": "2024-06-09"}}
        not_loaded = {"name": "focus_by_hour", "parameters": {}, "scope": since}
        number = store.add_study(
            session, of_both(SLOPE | {"scope": since}, ended, not_loaded, blur | {"scope": since})
        ).id
        other = blur | {"parameters": {}, "scope": since | {"since": "2024-06-09"}}
        store.add_study(session, study_row(other))  # of one heliostat: nothing about the camera
    (item,) = items(client)
    assert item["message"] == f"study {number} found camera blur in photographs from 2024-06-02 on"
    assert (item["heliostat"], item["since"]) == (None, "2024-06-02T00:00:00Z")
    acknowledge(client, item)
    with app.state.runtime.database.writing() as session:
        number = store.add_study(session, of_both(blur | {"scope": since})).id
    assert [one["acknowledged_by"] for one in items(client)] == [
        "local"
    ]  # found again: the same reason
    assert client.post(f"/v1/studies/{number}/adopt", json={}).status_code < 300
    assert items(client) == []


@pytest.mark.full
def test_clock_that_went_wrong_until_it_is_calibrated_without(calibrating: TestClient):
    client, post, names = calibrating, poster(calibrating), ("AA39", "AB01", "AB02")
    wrong = photographs(tower_document(), properties_document(), fast_minutes=2.0)
    right = photographs(tower_document(), properties_document())
    seeds = itertools.count()
    for name in names:
        client.put(f"/v1/heliostats/{name}", json=properties_document())
        for one in wrong:
            assert post(png(next(seeds)), name, **one).status_code == 201
    result = calibrate(client)["result"]
    assert result["clock"]["since"] == "2024-05-09"
    assert result["clock"]["minutes"] == pytest.approx(-2, abs=0.3)
    (item,) = of(client, "clock")
    assert item["message"].startswith("from 2024-05-09 on the clock was 2.")
    assert (item["heliostat"], item["since"]) == (None, "2024-05-09T00:00:00Z")
    for page in ("/alarms", "/alarms/history"):
        assert "rom 2024-05-09 on the clock was 2." in client.get(page, headers=HTML).text
    for name in names:
        for one in right[8:]:
            sun = {"sun": one["sun"]}
            path = f"/v1/heliostats/{name}/measurements/{one['id']}"
            assert client.patch(path, json=sun | {"reason": "clock"}).status_code == 200
    assert calibrate(client)["result"]["clock"] is None
    assert of(client, "clock") == []


def test_camera_that_was_declared_again(client: TestClient):
    declared = {"cameras": [{"transfer": {"gamma": 2.0}, "since": "2024-03-01T00:00:00Z"}]}
    assert (
        client.put(
            "/v1/plant?reason=surveyed", json={**tower_document(), "declared": declared}
        ).status_code
        == 200
    )
    (item,) = items(client)
    assert item["message"].startswith("version 2 of the model declared another camera")


def test_queue_that_is_stuck(app: FastAPI, client: TestClient):
    with app.state.runtime.database.writing() as session:
        job, _ = queue.add_job(session, "imports", {"folder": "x"}, "tester")
    assert items(client) == []
    with app.state.runtime.database.writing() as session:
        session.execute(update(JobRow).values(created_at=now() - timedelta(minutes=31)))
    (item,) = items(client)
    assert item["message"] == f"job {job.id} has waited since then"
    assert (
        'heliotwin_alarms{acknowledged="no",reason="queue",severity="1"} 1.0'
        in client.get("/metrics").text
    )
    acknowledge(client, item)
    metrics = client.get("/metrics").text
    assert 'heliotwin_alarms{acknowledged="no",reason="queue",severity="1"} 0.0' in metrics
    assert 'heliotwin_alarms{acknowledged="yes",reason="queue",severity="1"} 1.0' in metrics


def test_severities_in_lists_tables_and_counts(stale: TestClient):
    assert {item["severity"] for item in items(stale, severity=3)} == {3}
    assert items(stale, severity=1) == []
    assert stale.get(PATH, params={"severity": 4}).status_code == 422
    with stale.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        assert AlarmCount().read(session) == {1: 0, 2: 0, 3: 3}
    assert stale.get("/alarms.csv").text.splitlines()[1].split(",")[1] == "3"


@pytest.fixture
def stale(store_url: URL, tmp_path: Path) -> Iterator[TestClient]:
    """Three heliostats that nobody photographed for a year, on either engine."""
    url = store_url.render_as_string(hide_password=False)
    settings = Settings(data_dir=tmp_path, database_url=url, **QUIET)
    app = create_app(settings, FakeOperations())
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        for name in ("AA39", "AB01", "a-1"):
            client.put(f"/v1/heliostats/{name}", json=properties_document())
        with app.state.runtime.database.writing() as session:
            session.execute(update(HeliostatRow).values(created_at=now() - timedelta(days=365)))
        yield client


def test_list_in_parts_and_acknowledgement_of_all_or_none(stale: TestClient):
    first = stale.get(PATH, params={"limit": 2}).json()
    rest = stale.get(PATH, params={"limit": 2, "after": first["next"]}).json()
    assert [item["heliostat"] for item in (*first["items"], *rest["items"])] == [
        "AA39",
        "AB01",
        "a-1",
    ]
    assert rest["next"] is None
    gone = first["items"][0] | {"id": "AA39:no_photograph:00000000"}
    answer = acknowledge(stale, first["items"][1], gone)
    assert answer.status_code == 404
    assert "is not an alarm" in answer.text
    assert items(stale, acknowledged=True) == []
    assert acknowledge(stale, *first["items"]).status_code == 200
    before = items(stale, acknowledged=True)
    assert acknowledge(stale, *first["items"]).json()["items"] == before  # the first who did stays
    assert len(before) == 2


def test_page_and_menu_show_alarms_and_forms_acknowledge_them(stale: TestClient):
    page = stale.get("/alarms", headers=HTML).text
    assert "None was ever accepted." in page
    assert "HELIOTWIN_ALARM_" in page
    assert stale.get("/alarms/count").text.startswith('<span class="count">3<')
    assert 'hx-get="/alarms/count"' in page
    one, two, three = (item["id"] for item in items(stale))
    path = "/alarms/acknowledgements?reason=no_photograph"
    form: dict[str, Any] = {"ids": [one], "why": "Maintenance", "words": "row A"}
    answer = stale.post(path, data=form, headers=HTML, follow_redirects=False)
    assert answer.status_code == 303
    assert re.fullmatch(r"/alarms\?reason=no_photograph&done=\d+", answer.headers["Location"])
    page = stale.get(answer.headers["Location"], headers=HTML).text
    assert "1 acknowledged by local: Maintenance: row A" in page
    assert stale.get("/alarms/count").text.startswith('<span class="count">2<')
    form = {"ids": [two, three], "why": "Other", "words": "cloudy month"}
    stale.post("/alarms/acknowledgements", data=form, headers=HTML)
    assert "Nothing." in stale.get("/alarms", headers=HTML).text
    assert "local, " in stale.get("/alarms?acknowledged=true", headers=HTML).text


@pytest.mark.parametrize(
    ("form", "message"),
    [
        ({"why": "Maintenance"}, "tick at least one alarm"),
        ({"groups": "no_photograph:0123456789ab", "why": "Maintenance"}, "changed since"),
        ({"groups": "no_photograph:0123456789ab", "why": "Other"}, "write the reason"),
        ({"groups": "no_photograph:0123456789ab", "why": ""}, "why"),
    ],
)
def test_acknowledging_needs_alarms_and_a_reason(
    refusing: TestClient, form: dict[str, str], message: str
):
    answer = refusing.post("/alarms/acknowledgements", data=form, headers=HTML)
    assert answer.status_code in (409, 422)
    assert message in answer.text


def test_group_is_acknowledged_with_a_reason_and_undone(stale: TestClient):
    page = stale.get("/alarms", headers=HTML).text
    (token,) = re.findall(r'name="groups" value="(\S+)"', page)
    form = {"groups": token, "why": "Follows from another alarm"}
    stale.post("/alarms/acknowledgements", data=form, headers=HTML)
    seen = items(stale)
    assert {item["acknowledged_reason"] for item in seen} == {"Follows from another alarm"}
    (batch,) = stale.get(f"{PATH}/acknowledgements").json()["items"]
    assert (batch["created_by"], batch["alarms"]) == ("local", {"no_photograph": 3})
    assert {item["acknowledgement"] for item in seen} == {batch["id"]}
    undo = f"{PATH}/acknowledgements/{batch['id']}/undo"
    assert stale.post(undo).json()["undone_by"] == "local"
    assert len(items(stale, acknowledged=False)) == 3
    assert "was undone by local" in stale.post(undo).text
    assert stale.post(f"{PATH}/acknowledgements/99/undo").status_code == 404
    # Again, and undone on the page.
    acknowledge(stale, *items(stale))
    assert items(stale, acknowledged=False) == []
    newest = stale.get(f"{PATH}/acknowledgements", params={"limit": 1}).json()["items"][0]
    answer = stale.post(f"/alarms/acknowledgements/{newest['id']}/undo?page=history")
    assert "Follows from another alarm" in answer.text
    assert len(items(stale, acknowledged=False, heliostat="a-1")) == 1


def test_history_of_alarms(app: FastAPI, client: TestClient, post: Post):
    with app.state.runtime.database.writing() as session:
        session.execute(update(HeliostatRow).values(created_at=now() - timedelta(days=365)))
    (item,) = items(client)
    acknowledge(client, item)
    post(png(1), **recent())
    (entry,) = client.get(f"{PATH}/history", params={"heliostat": "AA39"}).json()["items"]
    assert (entry["reason"], entry["severity"], entry["since"]) == (
        "no_photograph",
        3,
        item["since"],
    )
    taken_at = client.get("/v1/heliostats/AA39/measurements").json()["items"][0]["taken_at"]
    assert entry["ended_at"] == taken_at  # the photograph's time, not when it came
    assert entry["ended_at"] < entry["recorded_at"]
    assert [(one["created_by"], one["reason"]) for one in entry["acknowledgements"]] == [
        ("local", "seen")
    ]
    page = client.get("/alarms/history", headers=HTML).text
    assert 'href="/alarms/history"' in client.get("/alarms", headers=HTML).text
    assert "None was ever accepted" in page
    with app.state.runtime.database.writing() as session:
        session.execute(update(MeasurementRow).values(taken_at=now() - timedelta(days=50)))
    assert client.get("/alarms/count").text.startswith('<span class="count">1<')
    present = client.get(f"{PATH}/history", params={"limit": 1}).json()
    assert present["items"][0]["ended_at"] is None
    assert present["next"] is not None


def test_undo_of_acknowledged_warnings_of_a_surface(tmp_path: Path):
    with client_of(create_app(Settings(data_dir=tmp_path, **QUIET), Doubter())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        poster(client)(png(2), id="2", sun=sun_at(90.0))
        client.post("/v1/heliostats/AA39/surfaces", json={"method": "network"})
        (seen,) = acknowledge(client, *of(client, "untrusted")).json()["items"]
        client.post(f"{PATH}/acknowledgements/{seen['acknowledgement']}/undo")
        assert client.get("/v1/heliostats/AA39/surfaces/1").json()["acknowledged_by"] is None
        assert of(client, "untrusted")[0]["acknowledged_by"] is None


def test_filters_and_orders_of_the_page(stale: TestClient):
    def shown(**query: Any) -> list[str]:
        page = stale.get("/alarms", params=query, headers=HTML).text
        return re.findall(r'<th scope="row"><a href="/heliostats/([^"]+)"', page)

    assert shown() == shown(severity=3, reason="no_photograph") == ["AA39", "AB01", "a-1"]
    assert shown(severity=1) == shown(heliostat="ZZ99") == shown(acknowledged=True) == []
    assert shown(sort="heliostat", heliostat="") == ["AA39", "AB01", "a-1"]
    assert shown(heliostat="AB01", sort="newest") == ["AB01"]
    page = stale.get("/alarms?sort=newest&severity=3", headers=HTML).text
    assert 'href="/alarms?severity=3&amp;sort=oldest">Since' in page
    assert 'aria-sort="descending"' in page


def test_who_acknowledged_is_the_key_and_audited(app: FastAPI, client: TestClient):
    database = app.state.runtime.database
    with database.writing() as session:
        session.execute(update(HeliostatRow).values(created_at=now() - timedelta(days=31)))
        reader = keys.create(session, "looker", "read", "test")
        operator = keys.create(session, "shift-2", "operate", "test")
    client.headers["Authorization"] = f"Bearer {reader}"
    (item,) = items(client)
    assert acknowledge(client, item).status_code == 403
    assert '<h2 id="acknowledging-title' not in client.get("/alarms", headers=HTML).text
    client.headers["Authorization"] = f"Bearer {operator}"
    assert acknowledge(client, item).json()["items"][0]["acknowledged_by"] == "shift-2"
    with database.reading() as session:
        (entry,) = session.scalars(select(AuditRow).where(AuditRow.action == "alarm.acknowledged"))
    assert (entry.actor, entry.subject, entry.detail["reason"]) == (
        "shift-2",
        "heliostat AA39",
        "no_photograph",
    )


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"ids": [], "reason": "seen"},
        {"ids": ["AA39"], "reason": "seen"},
        {"ids": [1], "reason": "seen"},
        {"ids": ["x:y:0"] * 501, "reason": "seen"},
        {"ids": ["AA39:moved:01234567"]},
        {"ids": ["AA39:moved:01234567"], "reason": ""},
    ],
)
def test_acknowledgement_of_nothing_is_refused(refusing: TestClient, body: dict[str, Any]):
    assert refusing.post(f"{PATH}/acknowledgements", json=body).status_code == 422
