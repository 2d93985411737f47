"""What HTTP promises: HEAD as GET, methods by path, numbers that are numbers, and every answer
documented.
"""

import copy
import json
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from starlette.types import Message

from service.jobs.kinds import KINDS
from service.web.auth import security
from tests.service.access import all_routes
from tests.service.conftest import Post, metadata, png, serving, sun_at, until
from tests.service.web.problems import check
from tests.service.web.promises import promise

SUN = {"azimuth_deg": 180.0, "elevation_deg": 45.0}
STAND_INS = [True, False, "1", "45.0", ""]

# --- numbers
# --------------------------------------------------------------------------------------------------

PLANE = {"center": [0, 0, 30], "normal": [0, 1, 0], "width": 8, "height": 8}
RECEIVER = {"center": [0, 0, 55], "normal": [0, 1, 0], "radius": 4, "height": 5, "opening_deg": 60}
ONE = {
    "heliostat": "AA39",
    "target": "lower",
    "sun": SUN,
    "dni_w_m2": 900,
    "window_m": 4,
    "resolution": 16,
}
FIELD = {
    "target": "lower",
    "sun": SUN,
    "aim_point_m": [0, 0, 30],
    "aim_points_m": {"AA39": [0, 0, 30]},
    "dni_w_m2": 900,
}

BODIES: list[tuple[str, str, dict[str, Any]]] = [
    ("POST", "forecasts", ONE),
    (
        "POST",
        "forecasts",
        {"heliostat": "AA39", "plane": PLANE, "sun": SUN, "aim_point_m": [0, 0, 30]},
    ),
    ("POST", "forecasts", {**ONE, "resolution": [16, 16], "surface": 1, "model_version": 1}),
    ("POST", "jobs/forecasts", FIELD),
    ("POST", "jobs/forecasts", {"receiver": RECEIVER, "sun": SUN, "model_version": 1}),
    ("POST", "jobs/predictions", {"images": 4, "model_version": 1}),
    ("POST", "jobs/studies", {"images": 4, "max_heliostats": 3}),
    ("POST", "heliostats/AA39/surfaces", {"images": 4, "model_version": 1}),
    ("PUT", "targets/new", {"plane": PLANE}),
    ("PUT", "receivers/new", RECEIVER),
]


def places(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where in a document numbers stand."""
    if isinstance(document, dict | list):
        entries = document.items() if isinstance(document, dict) else enumerate(document)
        return [place for key, entry in entries for place in places(entry, (*path, key))]
    return [path] if isinstance(document, int | float) and not isinstance(document, bool) else []


def changed(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    made = inner = copy.deepcopy(document)
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return made


@pytest.mark.parametrize(("method", "path", "body"), BODIES)
def test_other_types_are_refused_as_numbers(
    refusing: TestClient, method: str, path: str, body: dict[str, Any]
):
    for place in places(body):
        for value in STAND_INS:
            answer = refusing.request(method, f"/v1/{path}", json=changed(body, place, value))
            assert answer.status_code == 422, (place, value)


@promise('Numbers are JSON\'s numbers: `"45"` is refused as a string, and so is `true`.')
def test_other_types_are_refused_as_numbers_in_documents(
    refusing: TestClient, refused_post: Post, tower: Any, properties: Any
):
    used = [place for place in places(tower["lower"]["coordinates"]) if place[0] != "center"]
    for value in (True, "1"):
        for place in [
            ("power_plant_properties", "coordinates", 0),
            *(("lower", "coordinates", *p) for p in used),
        ]:
            assert (
                refusing.put("/v1/plant", json=changed(tower, place, value)).status_code == 422
            ), place
        for place in (
            ("heliostat_position", 2),
            ("width",),
            ("facet_properties", "facets", 0, "canting_e", 0),
        ):
            assert (
                refusing.put("/v1/heliostats/A", json=changed(properties, place, value)).status_code
                == 422
            ), place
        for name in ("azimuth_deg", "elevation_deg"):
            assert refused_post(sun=sun_at(**{name: value})).status_code == 422, name
        assert refused_post(motor_position=[value, 1]).status_code == 422
        assert refused_post(focal_spot_m=[0.0, value, 40.0]).status_code == 422
        assert refused_post(corners=[[value, 1]] * 4).status_code == 422


@pytest.mark.parametrize("value", [1, 0, "true", "yes"])
def test_other_types_are_refused_as_booleans(refusing: TestClient, value: Any):
    for path, body in (
        ("forecasts", {**ONE, "normalised": value}),
        ("jobs/forecasts", {**FIELD, "neighbours": value}),
        ("studies/1/adopt", {"force": value}),
    ):
        assert refusing.post(f"/v1/{path}", json=body).status_code == 422, path


def test_whole_numbers_are_numbers_and_text_is_where_there_is_only_text(
    client: TestClient, post: Post
):
    whole = {
        **ONE,
        "surface": "ideal",
        "sun": {"azimuth_deg": 180, "elevation_deg": 45},
        "resolution": 16.0,
    }
    assert client.post("/v1/forecasts", json=whole).status_code == 201
    assert post(png(3), sun=sun_at(160)).status_code == 201
    assert client.get("/v1/forecasts", params={"limit": "1", "after": "1"}).status_code == 200
    form = {
        "heliostat": "AA39",
        "target": "lower",
        "azimuth_deg": "180",
        "elevation_deg": "45",
        "dni_w_m2": "900",
    }
    form["surface"] = "ideal"
    assert client.post("/forecast", data=form, follow_redirects=False).status_code == 303
    answer = client.post(
        "/v1/heliostats/AA39/measurements",
        files={"image": ("spot.png", png(4), "image/png")},
        data={"metadata": json.dumps(metadata(sun=sun_at("160")))},
    )
    assert answer.status_code == 422


# --- methods
# --------------------------------------------------------------------------------------------------


@pytest.fixture
def filled(client: TestClient, post: Post) -> TestClient:
    """With a forecast, a photograph, a surface and a job that has ended."""
    post(id="1")
    client.post("/v1/heliostats/AA39/surfaces", json={})
    client.post("/v1/forecasts", json=ONE)
    client.post("/v1/jobs/predictions", json={})
    client.post("/v1/jobs/1/cancel")
    until(lambda: client.get("/v1/alarms").json()["pending"] == 0)
    return client


@pytest.mark.full
def test_head_answers_as_get_without_its_body(filled: TestClient):
    differ = ("x-request-id", "date")
    asked = 0
    for method, template in all_routes():
        path = template.replace("{path:path}", "index.html").format(
            name="AA39", measurement="1", number="1", version="1", view="thumbnail", verb="take"
        )
        if method != "GET" or path in (
            "/",
            "/heliostats/AA39",
            "/metrics",
        ):  # what these show changes by the moment
            continue
        head, answer = (
            filled.head(path, follow_redirects=False),
            filled.get(path, follow_redirects=False),
        )
        assert (head.status_code, head.content) == (answer.status_code, b""), path
        headers = [
            {name: value for name, value in one.headers.items() if name not in differ}
            for one in (head, answer)
        ]
        assert headers[0] == headers[1], path
        asked += answer.status_code == 200
    assert asked > 20
    assert filled.head("/v1/nothing").status_code == 404
    assert filled.head("/v1/jobs/1/cancel").headers["Allow"] == "POST"
    assert filled.head("/livez").status_code == filled.head("/docs").status_code == 200


def test_head_of_what_has_no_end_ends(app: FastAPI, client: TestClient):
    client.post("/v1/jobs/predictions", json={})  # nobody works at it
    with serving(app, lifespan="off") as address:
        with httpx.Client(
            base_url=address
        ) as http:  # one connection: a second answer needs the first one's end
            answers = [
                http.head("/v1/jobs/1/events"),
                http.head("/v1/plant"),
                http.get("/v1/plant"),
            ]
        assert [answer.status_code for answer in answers] == [200] * 3
        assert answers[0].headers["Content-Type"].startswith("text/event-stream")
        assert answers[1].headers["Content-Length"] == str(len(answers[2].content))


def test_failure_of_head_is_answered_without_a_body(
    app: FastAPI, bare: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """It is answered outside of the middleware: the server has to know the method again."""

    def fail(*_: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("service.store.list_heliostats", fail)
    scope: dict[str, Any] = {
        "type": "http",
        "method": "HEAD",
        "path": "/v1/heliostats",
        "headers": [(b"host", b"127.0.0.1")],
        "query_string": b"",
        "client": ("127.0.0.1", 1),
    }

    async def ask() -> None:
        async def receive() -> Message:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: Message) -> None:
            pass

        with pytest.raises(ZeroDivisionError):
            await app(scope, receive, send)

    assert bare.portal is not None
    bare.portal.call(ask)
    assert scope["method"] == "HEAD"


@pytest.mark.parametrize("kind", KINDS)
def test_addresses_that_take_jobs_give_nothing(refusing: TestClient, kind: str):
    for method in ("GET", "HEAD", "PUT", "DELETE"):
        answer = refusing.request(method, f"/v1/jobs/{kind}")
        assert (answer.status_code, answer.headers["Allow"]) == (405, "POST"), method
    check(refusing.get(f"/v1/jobs/{kind}"), 405)


# --- the document
# --------------------------------------------------------------------------------------------------


def test_answers_of_the_door_are_documented(refusing: TestClient):
    paths = refusing.get("/openapi.json").json()["paths"]
    for path, operations in paths.items():
        for method, operation in operations.items():
            documented, where = {int(status) for status in operation["responses"]}, (method, path)
            assert documented >= {405, 500}, where
            assert security.is_public(path) or documented >= {401, 403, 429, 503}, where
            assert path not in ("/session",) or documented >= {403, 429, 503}, where
            assert method == "get" or documented >= {403, 413}, where
            assert method == "get" or security.is_public(path) or 507 in documented, where
            assert "requestBody" not in operation or documented >= {400, 408, 413, 415, 422}, where
            assert not ("{" in path and method == "get") or documented >= {404, 422}, where
    assert {"400", "401", "403", "408", "413", "415", "422", "429", "503"} <= set(
        paths["/session"]["post"]["responses"]
    )


def test_ways_to_miss_a_session_are_answered_as_documented(bare: TestClient):
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    check(bare.post("/session", data={"key": "x"}), 401)
    check(bare.post("/session", content=b"{}", headers={"Content-Type": "application/json"}), 415)
    check(bare.post("/session", content=b"x" * 5000, headers=form), 413)
    check(bare.post("/session", content=b"", headers=form), 422)
    check(bare.post("/session", data={"key": "x"}, headers={"Sec-Fetch-Site": "cross-site"}), 403)
    check(bare.put("/session"), 405)
