"""Two hands at once: two services on one database change the same thing, and nothing is lost."""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import URL

import service
from service.base.settings import Settings
from service.store import audit
from service.web.app import create_app
from tests.page import Page
from tests.service.conftest import QUIET, FakeOperations, Post, client_of, png, poster, sun_at
from tests.service.web.at_once import at_once
from tests.service.web.pages import HTML, make_key, press, text_of

ROOT = Path(service.__file__).parents[1]
PARALLEL = {
    "heliotwin/cli/demo.py": "a new study",
    "service/twin/forecasts/heliostat_forecast.py": "new forecasts",
    "service/twin/photographs/stored_photograph.py": "files of deleted photographs",
    "service/twin/photographs/ingest.py": "new photographs, which lock their heliostat",
    "service/twin/photographs/repeats.py": "the entry of a forced photograph",
    "service/twin/surfaces/prediction.py": "new surfaces, which lock their heliostat",
    "service/web/root/session.py": "sessions",
    "heliotwin/folder_store.py": "a temporary store",
}
"""Modules with transactions beside changes of state, and what they write."""

BASE = "/v1/heliostats/AA39/measurements"
TAKEN = "2024-05-01T10:00:00Z"


@pytest.fixture
def services(
    store_url: URL, tmp_path: Path, tower: dict[str, Any], properties: dict[str, Any]
) -> Iterator[list[TestClient]]:
    """Two services on one database and one folder, with two heliostats."""
    address = store_url.render_as_string(hide_password=False)
    settings = Settings(data_dir=tmp_path, database_url=address, **QUIET)
    with (
        client_of(create_app(settings, FakeOperations())) as one,
        client_of(create_app(settings, FakeOperations())) as other,
    ):
        assert one.put("/v1/plant", json=tower).status_code == 200
        for name in ("AA39", "AB01"):
            assert one.put(f"/v1/heliostats/{name}", json=properties).status_code == 201
        yield [one, other]


def test_every_change_of_state_is_a_transaction_of_its_kind():
    parts = ("service/twin", "service/web", "heliotwin")
    files = [file for part in parts for file in (ROOT / part).rglob("*.py")]
    found = {str(one.relative_to(ROOT)) for one in files if ".writing()" in one.read_text()}
    assert found == set(PARALLEL)


def _patch(client: TestClient, identifier: str, reason: str, **changes: Any) -> Any:
    return client.patch(f"{BASE}/{identifier}", json={"reason": reason, **changes})


def test_corrections_of_two_fields_at_once_both_survive(services: list[TestClient]):
    one, other = services
    for seed in range(1, 9):
        assert poster(one)(png(seed), id=f"{seed}", taken_at=TAKEN).status_code == 201
        answers = at_once(
            partial(_patch, one, f"{seed}", "the clock", taken_at="2024-05-01T11:00:00Z"),
            partial(_patch, other, f"{seed}", "the drives", motor_position=[1000, seed]),
        )
        assert [answer.status_code for answer in answers] == [200, 200]
        row = one.get(f"{BASE}/{seed}").json()
        assert (row["taken_at"], row["motor_position"]) == ("2024-05-01T11:00:00Z", [1000, seed])
        history = one.get(f"{BASE}/{seed}/corrections").json()["items"]
        assert {item["reason"]: [*item["after"]] for item in history} == {
            "the clock": ["taken_at"],
            "the drives": ["motor_position"],
        }


def test_exclusion_and_new_image_at_once_leave_no_image_in_use(services: list[TestClient]):
    one, other = services
    for seed in range(1, 9):
        assert poster(one)(png(seed), id=f"{seed}").status_code == 201
        send = partial(poster(other), png(100 + seed), id=f"{seed}", kind="cropped")
        answers = at_once(partial(_patch, one, f"{seed}", "a bird", excluded=True), send)
        assert [answer.status_code for answer in answers] == [200, 201]
        for identifier in (f"{seed}", f"{seed}-cropped"):
            assert one.get(f"{BASE}/{identifier}").json()["reason"] == "excluded"


# --- many photographs
# --------------------------------------------------------------------------------------------------


def _give_times(client: TestClient, names: list[str], minute: int, reason: str) -> int:
    times = [
        {"heliostat": name, "id": f"{seed}", "taken_at": f"2024-05-01T10:{minute:02}:00Z"}
        for name in names
        for seed in range(1, 13)
    ]
    document = {"reason": reason, "times": times}
    return client.patch("/v1/measurements/times", json=document).status_code


@pytest.fixture
def filled(services: list[TestClient]) -> list[TestClient]:
    """Both heliostats have twelve photographs."""
    for name, seed in product(("AA39", "AB01"), range(1, 13)):
        image = png(seed + 100 * (name == "AB01"))
        answer = poster(services[0])(image, name, id=f"{seed}", taken_at=TAKEN)
        assert answer.status_code == 201
    return services


@pytest.mark.full
def test_crossing_changes_of_many_photographs_all_succeed(filled: list[TestClient]):
    calls = [
        partial(_give_times, filled[turn % 2], ["AA39", "AB01"][:: (-1) ** turn], turn, f"{turn}")
        for turn in range(1, 9)
    ]
    assert at_once(*calls) == [200] * len(calls)
    times = [item["taken_at"] for item in filled[0].get(BASE).json()["items"]]
    assert len(set(times)) == 1  # all of one change


def _batches(client: TestClient) -> list[dict[str, Any]]:
    items = client.get("/v1/audit?limit=500").json()["items"]
    return [item for item in items if item["action"].startswith("times.")]


def _undo(client: TestClient, number: int) -> int:
    answer = client.post(f"/photographs/times/{number}/undo", follow_redirects=False)
    return int(answer.status_code)


def test_one_of_simultaneous_undos_succeeds(filled: list[TestClient]):
    assert _give_times(filled[0], ["AA39"], 30, "the log") == 200
    number = _batches(filled[0])[0]["id"]
    answers = at_once(*(partial(_undo, filled[turn % 2], number) for turn in range(8)))
    assert Counter(answers) == {303: 1, 409: 7}
    assert Counter(item["action"] for item in _batches(filled[0])) == {
        "times.corrected": 1,
        "times.undone": 1,
    }


def test_undo_keeps_a_correction_that_came_since(filled: list[TestClient]):
    one, other = filled
    for turn in range(5):
        assert _give_times(one, ["AA39"], 30 + turn, f"the log {turn}") == 200
        number = _batches(one)[0]["id"]
        newer = f"2024-05-01T09:0{turn}:00Z"
        answers = at_once(
            partial(_undo, one, number), partial(_patch, other, "3", "newer", taken_at=newer)
        )
        assert (answers[0], answers[1].status_code) == (303, 200)
        assert one.get(f"{BASE}/3").json()["taken_at"] == newer


def test_undone_change_is_not_undone_again(filled: list[TestClient]):
    one, _ = filled
    assert _give_times(one, ["AA39"], 30, "the log") == 200
    first = _batches(one)[0]["id"]
    assert _undo(one, first) == 303
    assert _give_times(one, ["AA39"], 30, "the log again") == 200  # the same values
    assert _undo(one, first) == 409
    assert one.get(f"{BASE}/1").json()["taken_at"] == "2024-05-01T10:30:00Z"


def test_undo_of_an_older_change_leaves_a_newer_one_of_the_same_value(filled: list[TestClient]):
    one, _ = filled
    assert _give_times(one, ["AA39"], 30, "the log") == 200
    first = _batches(one)[0]["id"]
    assert _patch(one, "1", "no", taken_at=TAKEN).status_code == 200
    assert _patch(one, "1", "yes", taken_at="2024-05-01T10:30:00Z").status_code == 200
    assert _undo(one, first) == 303
    assert one.get(f"{BASE}/1").json()["taken_at"] == "2024-05-01T10:30:00Z"
    assert one.get(f"{BASE}/2").json()["taken_at"] == TAKEN


# --- since a form was shown, and since If-Match
# --------------------------------------------------------------------------------------------------


def test_patch_with_if_match_names_what_changed(client: TestClient, post: Post):
    assert post(png(1), id="1", taken_at=TAKEN).status_code == 201
    tag = client.get(f"{BASE}/1").headers["ETag"]
    assert _patch(client, "1", "the log", taken_at="2024-05-01T11:00:00Z").status_code == 200
    headers = {"If-Match": tag}
    stale = {"reason": "mine", "taken_at": "2024-05-01T12:00:00Z"}
    answer = client.patch(f"{BASE}/1", json=stale, headers=headers)
    assert answer.status_code == 409
    assert "heliostat AA39 1: taken_at was changed by local on" in answer.json()["detail"]
    assert "from 2024-05-01T10:00:00Z to 2024-05-01T11:00:00Z (the log)" in answer.json()["detail"]
    # Another field was not changed since.
    other = {"reason": "mine", "motor_position": [1, 2]}
    answer = client.patch(f"{BASE}/1", json=other, headers=headers)
    assert answer.status_code == 200
    assert answer.headers["ETag"] == client.get(f"{BASE}/1").headers["ETag"] != tag
    stale["taken_at"] = "2024-05-01T12:00:00Z"
    headers = {"If-Match": answer.headers["ETag"]}
    assert client.patch(f"{BASE}/1", json=stale, headers=headers).status_code == 200
    assert client.patch(f"{BASE}/1", json=stale, headers={"If-Match": "x"}).status_code == 422


def _shown(client: TestClient, path: str = "/heliostats/AA39/photographs/1") -> Callable[..., Any]:
    """The correction form of a page as it is shown now; its call submits it with changes."""
    return partial(press, client, text_of(client, path), "Correct", reason="by hand")


def test_form_writes_only_what_its_user_changed(client: TestClient, post: Post):
    assert post(png(1), id="1", taken_at=TAKEN, sun=sun_at(160.123456)).status_code == 201
    submit = _shown(client)
    assert _patch(client, "1", "the log", taken_at="2024-05-01T11:00:00Z").status_code == 200
    assert submit(azimuth_deg="150").status_code == 200
    row = client.get(f"{BASE}/1").json()
    assert (row["taken_at"], row["sun"]) == ("2024-05-01T11:00:00Z", sun_at(150.0))
    history = client.get(f"{BASE}/1/corrections").json()["items"]
    assert [*history[-1]["after"]] == ["sun.azimuth_deg"]


def test_form_is_refused_if_its_field_changed_since(client: TestClient, post: Post):
    assert post(png(1), id="1", taken_at=TAKEN).status_code == 201
    submit = _shown(client)
    assert _patch(client, "1", "the log", excluded=True).status_code == 200
    assert _patch(client, "1", "the log", taken_at="2024-05-01T11:00:00Z").status_code == 200
    answer = submit(taken_at="2024-05-01T12:00:00")
    assert answer.status_code == 409
    said = Page(answer.text).words
    assert "heliostat AA39 1: taken_at was changed by local on" in said
    assert "from 2024-05-01T10:00:00Z to 2024-05-01T11:00:00Z (the log)" in said
    assert client.get(f"{BASE}/1").json()["reason"] == "excluded"  # a box that was not ticked


def test_confirmed_preview_is_refused_if_a_time_changed_since(client: TestClient, post: Post):
    for seed in (1, 2):
        assert post(png(seed), id=f"{seed}", taken_at=TAKEN).status_code == 201
    lines = "AA39,1,2024-05-01T12:00:00Z\nAA39,2,2024-05-01T12:00:00Z\n"
    preview = client.post(
        "/photographs/times/preview",
        data={"lines": lines, "reason": "the log"},
        files={"file": ("", b"")},
        headers=HTML,
    )
    assert _patch(client, "2", "by hand", taken_at="2024-05-01T11:00:00Z").status_code == 200
    answer = press(client, Page(preview.text), "Store")
    assert answer.status_code == 409
    assert "heliostat AA39 2: taken_at was changed by local on" in Page(answer.text).words
    assert client.get(f"{BASE}/1").json()["taken_at"] == "2024-05-01T10:00:00Z"


# --- decisions, targets and the plant
# --------------------------------------------------------------------------------------------------


def _surfaces(client: TestClient, count: int) -> None:
    """Versions of AA39's surface, from one photograph each."""
    for seed in range(1, count + 1):
        assert poster(client)(png(seed), id=f"{seed}").status_code == 201
        body = {"measurements": [f"{seed}"]}
        assert client.post("/v1/heliostats/AA39/surfaces", json=body).status_code == 201


def _choose(client: TestClient, version: int, tag: str | None = None) -> Any:
    headers = {} if tag is None else {"If-Match": tag}
    body = {"version": version, "reason": f"version {version}"}
    return client.put("/v1/heliostats/AA39/surfaces/current", json=body, headers=headers)


def _active(client: TestClient) -> Any:
    return client.get("/v1/heliostats/AA39/surfaces/current")


def test_of_simultaneous_decisions_on_one_surface_one_is_refused(services: list[TestClient]):
    _surfaces(services[0], 3)
    assert _choose(services[0], 3).status_code == 200
    for _ in range(3):
        tag = _active(services[0]).headers["ETag"]
        answers = at_once(*(partial(_choose, services[turn], turn + 1, tag) for turn in range(2)))
        assert sorted(answer.status_code for answer in answers) == [200, 409]
        refused = next(answer for answer in answers if answer.status_code == 409)
        chosen = _active(services[0]).json()["version"]
        said = f"changed from version 3 to {chosen} by local (version {chosen})"
        assert said in refused.json()["detail"]
        assert _choose(services[0], 3).status_code == 200


def test_of_simultaneous_undos_of_a_decision_one_succeeds(services: list[TestClient]):
    _surfaces(services[0], 2)
    for turn in range(3):
        assert _choose(services[0], 2 - turn % 2).status_code == 200
        assert _choose(services[0], 1 + turn % 2).status_code == 200
        headers = {"If-Match": _active(services[0]).headers["ETag"]}
        undo = "/v1/heliostats/AA39/surfaces/undo"
        answers = at_once(*(partial(one.post, undo, headers=headers) for one in services * 2))
        assert sorted(answer.status_code for answer in answers) == [200, 409, 409, 409]


def test_form_undoes_the_decision_that_it_showed(client: TestClient):
    _surfaces(client, 2)
    assert _choose(client, 1).status_code == 200
    page = text_of(client, "/heliostats/AA39")
    for version in (2, 1):  # the same version is active again, by another decision
        assert _choose(client, version).status_code == 200
    answer = press(client, page, "Undo: back to version")
    assert answer.status_code == 409
    assert "local decided on version 1 since (version 1)" in Page(answer.text).words


def test_form_makes_no_version_active_after_another_did(client: TestClient):
    _surfaces(client, 3)
    page = text_of(client, "/heliostats/AA39")
    assert _choose(client, 1).status_code == 200
    answer = press(client, page, "Make it active")
    assert answer.status_code == 409
    assert "changed from version 3 to 1 by local (version 1)" in Page(answer.text).words


TARGET = {"plane": {"center": [0, -3, 36], "normal": [0, 2, 0], "width": 8.6, "height": 7.2}}


def _set_target(client: TestClient, width: float, tag: str | None = None, **asked: str) -> Any:
    headers = {} if tag is None else {"If-Match": tag}
    document = {"plane": TARGET["plane"] | {"width": width}}
    return client.put("/v1/targets/screen", json=document, headers=headers, params=asked)


def test_target_is_changed_by_one_of_two_who_read_it(services: list[TestClient]):
    assert _set_target(services[0], 8.6).status_code == 201
    for turn in range(3):
        tag = services[1].get("/v1/targets/screen").headers["ETag"]
        calls = [
            partial(_set_target, services[place], 7.0 + turn + place / 10, tag, reason=f"{place}")
            for place in range(2)
        ]
        answers = at_once(*calls)
        assert sorted(answer.status_code for answer in answers) == [200, 409]
        detail = next(one for one in answers if one.status_code == 409).json()["detail"]
        assert "target screen: width_m was changed by local on" in detail
        assert f"to {services[0].get('/v1/targets/screen').json()['width']} (" in detail


@pytest.mark.parametrize("kind", ["targets", "receivers", "heliostats", "plant"])
def test_changes_of_the_plant_carry_a_reason(
    client: TestClient, kind: str, properties: dict[str, Any], tower: dict[str, Any]
):
    drum = {"center": [0, 0, 55], "normal": [0, 1, 0], "radius": 4.1, "height": 5.2}
    path, document, changed = {
        "targets": ("targets/screen", TARGET, {"plane": TARGET["plane"] | {"width": 8.0}}),
        "receivers": ("receivers/drum", drum | {"opening_deg": 60}, drum | {"opening_deg": 70}),
        "heliostats": ("heliostats/AB01", properties, properties | {"renovation": "2022-01-01"}),
        "plant": ("plant", tower, tower | {"lower": tower["upper"]}),
    }[kind]
    assert client.put(f"/v1/{path}", json=document).status_code in (200, 201)
    assert client.put(f"/v1/{path}", json=document).status_code == 200  # nothing changes
    refused = client.put(f"/v1/{path}", json=changed)
    assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, "reason")
    tag = client.get(f"/v1/{path}").headers["ETag"]
    answer = client.put(f"/v1/{path}", json=changed, params={"reason": "surveyed"})
    assert answer.status_code == 200
    entries = client.get("/v1/audit").json()["items"]
    assert entries[0]["detail"]["reason"] == "surveyed"
    assert any(entry["detail"].get("before") for entry in entries)
    stale = client.put(f"/v1/{path}", json=document, headers={"If-Match": tag})
    assert stale.status_code == 409
    assert "(surveyed)" in stale.json()["detail"]
    if kind != "plant":
        assert client.delete(f"/v1/{path}").status_code == 422
        assert client.delete(f"/v1/{path}", params={"reason": "a mistake"}).status_code == 204
        assert client.get("/v1/audit").json()["items"][0]["detail"]["reason"] == "a mistake"


# --- the audit trail
# --------------------------------------------------------------------------------------------------


def test_audit_trail_names_logins_and_refused_ones(app: FastAPI, client: TestClient):
    key = make_key(app, "admin")
    wrong = key[:-4] + "AAAA"
    for path in ("/login", "/session"):
        assert client.post(path, data={"key": wrong}).status_code == 401
        assert client.post(path, data={"key": "x"}).status_code == 401
        answer = client.post(path, data={"key": key}, follow_redirects=False)
        assert answer.status_code in (204, 303)
    entries = client.get("/v1/audit?limit=6").json()["items"]
    found = [(entry["actor"], entry["action"], entry["subject"]) for entry in entries]
    refused = ("without a key", "session.refused", "address testclient")
    assert found == [("admin", "session.begun", "key admin"), refused, refused] * 2
    assert entries[2]["detail"] == {"prefix": key.split("_")[1]}
    assert entries[0]["detail"] == {"address": "testclient"}
    for _ in range(30):
        client.post("/session", data={"key": "x"})
    with app.state.runtime.database.reading() as session:
        actions = [entry.action for entry in audit.entries(session, 100)]
    assert actions.count("session.refused") == 20  # nobody can fill the audit trail
