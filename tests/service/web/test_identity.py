"""What a photograph is: its bytes decide. Sent again it is filled, elsewhere refused; by mistake it
is deleted.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import URL

from service.base.settings import Settings
from service.store.check import inspect_store
from service.store.image_files import digest
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    png,
    poster,
    properties_document,
    spot_of,
    sun_at,
    tower_document,
)
from tests.service.web.at_once import at_once
from tests.service.web.promises import promise

BASE = "/v1/heliostats/AA39/measurements"
HTML = {"Accept": "text/html"}


def field(client: TestClient) -> TestClient:
    """Two heliostats, AA39 and AB38."""
    assert client.put("/v1/plant", json=tower_document()).status_code == 200
    for name in ("AA39", "AB38"):
        assert client.put(f"/v1/heliostats/{name}", json=properties_document()).status_code == 201
    return client


@pytest.fixture
def client(bare: TestClient) -> TestClient:
    return field(bare)


@pytest.fixture
def both(store_url: URL, tmp_path: Path) -> Iterator[TestClient]:
    """The same on each of the two databases."""
    address = store_url.render_as_string(hide_password=False)
    with client_of(
        create_app(Settings(data_dir=tmp_path, database_url=address, **QUIET), FakeOperations())
    ) as client:
        yield field(client)


def actions(client: TestClient) -> list[str]:
    return [entry["action"] for entry in client.get("/v1/audit").json()["items"]]


# --- the same bytes
# --------------------------------------------------------------------------------------------------


def test_the_same_bytes_of_another_kind_are_refused(client: TestClient):
    post = poster(client)
    assert post(id="205363", kind="flux").status_code == 201
    answer = post(id="205363", kind="cropped")
    assert answer.status_code == 409
    detail = answer.json()["detail"]
    assert detail.startswith("kind: flux is stored, cropped was sent")
    assert f"DELETE {BASE}/205363?only_this=true" in detail
    assert len(client.get(BASE).json()["items"]) == 1
    # What the message says helps.
    gone = client.delete(f"{BASE}/205363", params={"only_this": True, "reason": "it is cropped"})
    assert gone.status_code == 200
    assert post(id="205363", kind="cropped").status_code == 201


@promise('If two heliostats do have one image, send it with `"force": true` and a `"reason"`.')
def test_the_same_bytes_at_another_heliostat_are_refused_unless_forced(client: TestClient):
    post = poster(client)
    assert post(id="205363").status_code == 201
    answer = post(heliostat="AB38", id="205363")
    assert answer.status_code == 409
    assert answer.json()["detail"].startswith(
        f"image: heliostat AA39 has it already as {BASE}/205363"
    )
    forced = post(heliostat="AB38", id="205363", force=True, reason="one photograph of both spots")
    assert (forced.status_code, forced.json()["forced"]) == (201, "one photograph of both spots")
    (entry,) = [
        one
        for one in client.get("/v1/audit").json()["items"]
        if one["action"] == "measurement.forced"
    ]
    assert (entry["subject"], entry["detail"]["reason"]) == (
        "heliostat AB38 205363",
        "one photograph of both spots",
    )
    # Forced once, it is known there.
    assert post(heliostat="AB38", id="205363").status_code == 200


@pytest.mark.parametrize(
    "half", [{"force": True}, {"reason": "because"}, {"force": False, "reason": "because"}]
)
def test_force_and_its_reason_come_together(client: TestClient, half: dict[str, Any]):
    answer = poster(client)(**half)
    assert answer.status_code == 422
    assert "force and reason: send both, or neither" in answer.json()["detail"]


def test_of_two_heliostats_at_once_one_has_the_image(both: TestClient):
    post = poster(both)
    for seed in range(6):
        answers = at_once(
            lambda seed=seed: post(png(seed), id=f"a{seed}"),
            lambda seed=seed: post(png(seed), heliostat="AB38", id=f"b{seed}"),
        )
        assert sorted(answer.status_code for answer in answers) == [201, 409]


def test_of_two_kinds_at_once_one_is_stored(both: TestClient):
    post = poster(both)
    for seed in range(6):
        answers = at_once(
            lambda seed=seed: post(png(seed), id=f"a{seed}", kind="flux"),
            lambda seed=seed: post(png(seed), id=f"a{seed}", kind="cropped"),
        )
        assert sorted(answer.status_code for answer in answers) == [201, 409]
    assert len(both.get(BASE).json()["items"]) == 6


# --- sent again
# --------------------------------------------------------------------------------------------------


@promise(
    "`filled` names what was missing and this post brought, `ignored` what differs. It answers to"
    " this `id`, too"
)
def test_sent_again_it_fills_what_was_missing_and_reports_what_it_ignored(client: TestClient):
    post = poster(client)
    first = post(temperature_c=20.0).json()
    assert (first["taken_at"], first["external_id"], first["filled"], first["ignored"]) == (
        None,
        None,
        [],
        [],
    )
    sent = {
        "id": "205363",
        "taken_at": "2024-05-01T10:00:00Z",
        "motor_position": [30076, 37935],
        "focal_spot_m": spot_of(50.9, 6.38, 122.0),
        "wind_speed_m_s": 3.0,
        "temperature_c": 21.0,
    }
    again = post(**sent)
    assert again.status_code == 200
    body = again.json()
    assert set(body["filled"]) == {
        "id",
        "taken_at",
        "motor_position",
        "focal_spot_m",
        "wind_speed_m_s",
    }
    assert body["ignored"] == ["temperature_c"]
    assert (body["id"], body["external_id"], body["temperature_c"]) == (first["id"], "205363", 20.0)
    by_its_id = client.get(f"{BASE}/205363").json()
    assert by_its_id == client.get(f"{BASE}/{first['id']}").json()
    assert client.get(f"{BASE}/205363/flux").status_code == 200
    assert by_its_id["taken_at"] == "2024-05-01T10:00:00Z"
    assert (by_its_id["motor_position"], by_its_id["wind_speed_m_s"]) == ([30076, 37935], 3.0)
    (correction,) = client.get(f"{BASE}/205363/corrections").json()["items"]
    assert correction["before"] == dict.fromkeys(correction["after"])
    assert "measurement.filled" in actions(client)
    # Once more there is nothing to fill, and what is there cannot be filled with something else.
    assert post(**sent).json()["filled"] == []
    assert post(**sent | {"motor_position": [1, 2]}).status_code == 409


def test_two_ids_of_one_image_both_answer(client: TestClient):
    post = poster(client)
    assert post(id="first").status_code == 201
    again = post(id="second")
    assert (again.status_code, again.json()["id"], again.json()["filled"]) == (200, "first", ["id"])
    assert client.get(f"{BASE}/second").json() == client.get(f"{BASE}/first").json()
    assert post(id="second").json()["filled"] == []
    made = client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["first", "second"]})
    assert (made.status_code, made.json()["measurements"]) == (201, ["first"])


def test_filling_makes_a_raw_image_be_measured_again_with_its_corners(
    client: TestClient, operations: FakeOperations
):
    post = poster(client)
    post(kind="raw")
    corners = [[1, 1], [30, 1], [1, 30], [30, 30]]
    assert post(kind="raw", corners=corners).json()["filled"] == ["corners"]
    assert operations.measured == 2
    assert post(kind="raw", corners=[[2, 1], [30, 1], [1, 30], [30, 30]]).json()["ignored"] == [
        "corners"
    ]


def test_sent_again_as_it_was_before_a_correction_it_is_still_known(client: TestClient):
    """Though what it lacked at first was filled, and corrected after that."""
    post, sent = poster(client), {"id": "1", "taken_at": "2024-05-01T10:00:00Z"}
    post(id="1")
    post(**sent)
    corrected = client.patch(
        f"{BASE}/1", json={"taken_at": "2024-05-01T11:00:00Z", "reason": "the clock"}
    )
    assert corrected.status_code == 200
    answer = post(**sent)
    assert (answer.status_code, answer.json()["ignored"]) == (200, ["taken_at"])


def test_filled_at_once_with_two_times_one_is_refused(both: TestClient):
    post, moments = poster(both), ("2024-05-01T10:00:00Z", "2024-05-01T11:00:00Z")
    for seed in range(6):
        post(png(seed), id=f"a{seed}")
        answers = at_once(
            *(
                lambda seed=seed, at=at: post(png(seed), id=f"a{seed}", taken_at=at)
                for at in moments
            )
        )
        assert sorted(answer.status_code for answer in answers) == [200, 409]
        (filled,) = [answer.json()["taken_at"] for answer in answers if answer.status_code == 200]
        assert both.get(f"{BASE}/a{seed}").json()["taken_at"] == filled


def test_posted_at_once_with_two_suns_one_is_refused(both: TestClient):
    post = poster(both)
    for seed in range(6):
        answers = at_once(
            *(
                lambda seed=seed, at=at: post(png(seed), id=f"a{seed}", sun=sun_at(at))
                for at in (1, 2)
            )
        )
        assert sorted(answer.status_code for answer in answers) == [201, 409]


# --- without an image
# -------------------------------------------------------------------------------------------------

POSITION = {
    "kind": "none",
    "target": "lower",
    "sun": sun_at(160.0),
    "motor_position": [30076, 37935],
    "focal_spot_m": spot_of(50.9133, 6.3878, 122.9),
}


def send_position(client: TestClient, **changes: Any) -> Any:
    """Post motors and a spot without an image."""
    return client.post(BASE, files={"metadata": (None, json.dumps(POSITION | changes))})


def test_a_position_sent_again_is_filled(client: TestClient):
    assert send_position(client, id="1").status_code == 201
    later = {"id": "1", "taken_at": "2024-05-01T10:00:00Z", "temperature_c": 20.0}
    again = send_position(client, **later)
    assert (again.status_code, set(again.json()["filled"])) == (200, {"taken_at", "temperature_c"})
    assert again.json()["warnings"][0]["type"] == "sun_contradicts_time"
    other = send_position(client, id="1", temperature_c=30.0)
    assert (other.status_code, other.json()["filled"], other.json()["ignored"]) == (
        200,
        [],
        ["temperature_c"],
    )
    stored = client.get(f"{BASE}/1").json()
    assert (stored["taken_at"], stored["temperature_c"]) == ("2024-05-01T10:00:00Z", 20.0)
    assert "measurement.filled" in actions(client)


@pytest.mark.parametrize(
    "changes",
    [
        {"sun": sun_at(159.0)},
        {"target": "upper"},
        {"taken_at": "2024-05-01T11:00:00Z"},
        {"motor_position": [30076, 37936]},
        {"focal_spot_m": spot_of(50.9133, 6.3878, 123.0)},
    ],
)
@promise("Without an image also another focal spot")
def test_a_position_sent_again_with_other_values_is_refused(
    client: TestClient, changes: dict[str, Any]
):
    first = {"id": "1", "taken_at": "2024-05-01T10:00:00Z"}
    assert send_position(client, **first).status_code == 201
    answer = send_position(client, **first | changes)
    ((name, value),) = changes.items()
    detail = answer.json()["detail"]
    assert (answer.status_code, re.match(rf"{name}(\.\w+)?: ", detail) is None) == (409, False)
    assert " is stored, " in detail
    assert ("DELETE" if name == "focal_spot_m" else "PATCH") + f" {BASE}/1" in detail
    if name == "focal_spot_m":  # and what the message says helps
        assert client.delete(f"{BASE}/1", params={"reason": "another spot"}).status_code == 200
        assert send_position(client, **first | changes).json()["focal_spot_m"] == value


@promise(
    "Without an image the `id` decides. Without an `id` it is the same measurement if target, sun"
    " and motor position are the same and the times do not differ."
)
def test_a_position_without_an_id_is_known_by_its_values(both: TestClient):
    first = send_position(both).json()
    moment = "2024-05-01T10:00:00Z"
    again = send_position(both, taken_at=moment, id="205363")
    assert (again.status_code, again.json()["id"]) == (200, first["id"])
    assert set(again.json()["filled"]) == {"taken_at", "id"}
    assert both.get(f"{BASE}/205363").json() == both.get(f"{BASE}/{first['id']}").json()
    for known in ({}, {"taken_at": moment}, {"id": "205363"}):
        answer = send_position(both, **known)
        assert (answer.status_code, answer.json()["id"], answer.json()["filled"]) == (
            200,
            first["id"],
            [],
        )
    # Another time, or another id, is another measurement, though the sun was recorded alike.
    assert send_position(both, taken_at=moment, id="205364").status_code == 201
    assert send_position(both, taken_at="2024-06-01T10:00:00Z").status_code == 201
    answers = at_once(*[lambda: send_position(both, sun=sun_at(179.0))] * 4)
    assert sorted(answer.status_code for answer in answers) == [200, 200, 200, 201]


def test_a_position_without_an_id_is_known_after_a_correction(client: TestClient):
    sent = {"taken_at": "2024-05-01T10:00:00Z"}
    first = send_position(client, **sent).json()
    changes = {"sun": sun_at(159.0), "taken_at": "2024-05-01T11:00:00Z", "reason": "the clock"}
    assert client.patch(f"{BASE}/{first['id']}", json=changes).status_code == 200
    for again in (sent, sent | {"sun": sun_at(159.0), "taken_at": "2024-05-01T11:00:00Z"}):
        answer = send_position(client, **again)
        assert (answer.status_code, answer.json()["id"]) == (200, first["id"])
    assert len(client.get(BASE).json()["items"]) == 1


def test_a_position_fills_the_photograph_of_its_id(client: TestClient):
    """Also by an id that its image was sent with again."""
    post = poster(client)
    post(id="first")
    post(id="second")
    answer = send_position(client, id="second")
    assert (answer.status_code, answer.json()["id"], answer.json()["kind"]) == (
        200,
        "first",
        "flux",
    )
    assert answer.json()["filled"] == ["motor_position", "focal_spot_m"]
    assert len(client.get(BASE).json()["items"]) == 1


def test_a_position_is_filled_whatever_camera_its_time_names(client: TestClient):
    """There is no image to measure again."""
    declared = {"cameras": [{"transfer": {"gamma": 2.0}, "since": "2024-06-01T00:00:00Z"}]}
    assert (
        client.put(
            "/v1/plant?reason=surveyed", json=tower_document() | {"declared": declared}
        ).status_code
        == 200
    )
    assert send_position(client, id="1").status_code == 201
    answer = send_position(client, id="1", taken_at="2024-05-01T10:00:00Z")
    assert (answer.status_code, answer.json()["filled"]) == (200, ["taken_at"])


# --- deleted
# --------------------------------------------------------------------------------------------------


def files_of(client: TestClient) -> list[str]:
    app: Any = client.app
    root = app.state.runtime.images.root
    return sorted(
        path.relative_to(root).as_posix().replace("/", "")
        for path in root.rglob("*")
        if path.is_file()
    )


def test_a_photograph_is_deleted_and_what_was_made_from_it_says_so(both: TestClient):
    post, surfaces = poster(both), "/v1/heliostats/AA39/surfaces"
    for number in (1, 2):
        post(png(number), id=str(number), sun=sun_at(180 - 10.0 * number))
    post(png(3), id="1", kind="raw", sun=sun_at(170.0))
    assert both.post(surfaces, json={"measurements": ["1", "2"]}).status_code == 201
    post(png(4), id="4")  # it comes after the surface, and says how well that forecasts
    answer = both.delete(f"{BASE}/1", params={"reason": "another heliostat's"})
    assert answer.status_code == 200, answer.text
    assert answer.json() == {"deleted": ["1", "1-raw"], "surface_versions": [1], "forecasts": 0}
    assert both.get(f"{BASE}/1").status_code == both.get(f"{BASE}/1-raw").status_code == 404
    assert files_of(both) == sorted(digest(png(number)) for number in (2, 4))
    surface = both.get(f"{surfaces}/1").json()
    assert (surface["measurements"], surface["deleted"]) == (["2"], ["1"])
    page = both.get("/heliostats/AA39", headers=HTML).text
    assert "Made from photographs that were deleted since" in page
    entry = both.get("/v1/audit").json()["items"][0]
    assert (entry["action"], entry["subject"]) == ("measurement.deleted", "heliostat AA39 1")
    assert (entry["detail"]["reason"], len(entry["detail"]["images"])) == ("another heliostat's", 2)
    # The newest photograph, which drift refers to, goes as well, and again is nobody's.
    assert both.delete(f"{BASE}/4", params={"reason": "too"}).status_code == 200
    assert both.delete(f"{BASE}/4", params={"reason": "too"}).status_code == 404
    # Sent again it is new, and no proof for the surface that was made from it.
    assert post(png(1), id="1", sun=sun_at(170.0)).status_code == 201
    app: Any = both.app
    runtime: Runtime = app.state.runtime
    report = inspect_store(runtime.database, runtime.images, lambda _: None)
    assert (report.bad, report.unused) == ({}, 0)


def test_a_file_that_another_heliostat_needs_stays(client: TestClient):
    post = poster(client)
    post(id="1")
    post(heliostat="AB38", id="1", force=True, reason="both")
    assert client.delete(f"{BASE}/1", params={"reason": "not of AA39"}).status_code == 200
    assert files_of(client) == [digest(png())]
    assert client.get("/v1/heliostats/AB38/measurements/1/image").content == png()


@pytest.mark.parametrize("reason", [None, "", "x" * 201])
def test_deleting_needs_a_reason(client: TestClient, reason: str | None):
    poster(client)(id="1")
    answer = client.delete(f"{BASE}/1", params={} if reason is None else {"reason": reason})
    assert answer.status_code == 422
    assert "reason" in answer.json()["detail"]
    assert client.get(f"{BASE}/1").status_code == 200


def test_accuracy_is_computed_again_after_a_deletion(client: TestClient):
    """What is remembered of a heliostat depends on which photographs there are."""
    post = poster(client)
    post(png(1), id="1")
    client.post("/v1/heliostats/AA39/surfaces", json={"measurements": ["1"]})
    for number in (2, 3):
        post(png(number), id=str(number), sun=sun_at(180 - 10.0 * number))
    page = client.get("/heliostats/AA39", headers=HTML).text
    assert "on 2 photographs that it was not made from" in page
    client.delete(f"{BASE}/2", params={"reason": "a cloud"})
    page = client.get("/heliostats/AA39", headers=HTML).text
    assert "on 1 photographs that it was not made from" in page


def test_page_deletes_a_photograph_after_it_is_confirmed(client: TestClient):
    poster(client)(id="1")
    path = "/heliostats/AA39/photographs/1"
    unconfirmed = client.post(
        f"{path}/delete", data={"reason": "wrong"}, headers=HTML, follow_redirects=False
    )
    assert unconfirmed.status_code == 422
    answer = client.post(
        f"{path}/delete",
        data={"reason": "wrong", "confirmed": "true"},
        headers=HTML,
        follow_redirects=False,
    )
    assert (answer.status_code, answer.headers["Location"]) == (303, "/heliostats/AA39")
    assert client.get(path, headers=HTML).status_code == 404
