"""Bodies of requests: who may send one, what it may hold, and how much of it is held at a time."""

import errno
import json
import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, HTTPException
from fastapi.testclient import TestClient

from service.base import validation
from service.base.settings import Settings
from service.web.app import create_app
from service.web.auth.request_checks import MAX_DEPTH, MAX_KEYS, JsonShape
from service.web.responses import problems
from tests.service.access import bearer, make_key
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    Post,
    client_of,
    metadata,
    png,
    properties_document,
    serving,
    tower_document,
    until,
)

JSON = {"Content-Type": "application/json"}
PLAN = {
    "name": "day",
    "target": "lower",
    "first_at": "2026-06-21T06:00:00Z",
    "last_at": "2026-06-21T18:00:00Z",
}
POST = "/v1/heliostats/AA39/measurements"


# --- what JSON may hold
# -----------------------------------------------------------------------------------------------


def test_json_of_many_keys_is_refused_before_it_is_parsed(refusing: TestClient):
    body = json.dumps({f"k{number}": 0 for number in range(MAX_KEYS + 1)})
    answer = refusing.post("/v1/heliostats/AA39/motors", content=body, headers=JSON)
    assert answer.status_code == 413
    assert f"{MAX_KEYS} keys" in answer.json()["detail"]


@pytest.mark.parametrize("opening", ["[", '{"a":'])
def test_json_of_great_depth_is_refused_before_it_is_parsed(refusing: TestClient, opening: str):
    answer = refusing.put("/v1/plant", content=opening * (MAX_DEPTH + 1), headers=JSON)
    assert answer.status_code == 413
    assert f"{MAX_DEPTH} levels" in answer.json()["detail"]
    assert refusing.put("/v1/plant", content=opening * MAX_DEPTH, headers=JSON).status_code == 422


def test_no_json_body_may_have_a_key_twice(refusing: TestClient):
    paths = refusing.get("/openapi.json").json()["paths"]
    taking = [
        (method, path)
        for path, operations in paths.items()
        for method, operation in operations.items()
        if "application/json" in operation.get("requestBody", {}).get("content", {})
    ]
    assert len(taking) > 20
    for method, path in taking:
        at = re.sub(r"\{[^}]*\}", "1", path)
        answer = refusing.request(method, at, content='{"a": 1, "a": 2}', headers=JSON)
        assert answer.json()["detail"] == "body: 'a' is there twice; keep one", (method, path)


def test_keys_and_depth_are_counted_over_all_parts():
    shape = JsonShape()
    for part in (b'{"a":', b"", b"[" * (MAX_DEPTH - 1), b"]", b"["):
        shape.add(part)
    with pytest.raises(HTTPException, match="levels"):
        shape.add(b"[")
    shape = JsonShape()
    shape.add(b":" * MAX_KEYS)
    with pytest.raises(HTTPException, match="keys"):
        shape.add(b":")


def test_document_of_many_faults_costs_no_more_than_one_of_few(
    refusing: TestClient, monkeypatch: pytest.MonkeyPatch
):
    """The first ones are named; 140,000 kept the event loop for twelve seconds."""
    entries = []

    def counting(entry: Any) -> str:
        entries.append(entry)
        return validation.message_of(entry)

    monkeypatch.setattr(problems, "message_of", counting)
    aims: dict[str, Any] = {f"!{number}": ["", ""] for number in range(2_000)}
    for body, named in (
        ({**PLAN, "aim_offsets_m": aims}, "aim_offsets_m.!0"),
        ({**PLAN, "heliostats": [1] * 20_000}, "heliostats.0"),
        ({**{f"k{number}": 0 for number in range(2_000)}, **PLAN}, "k0"),
    ):
        entries.clear()
        answer = refusing.post("/v1/jobs/plans", json=body)
        assert answer.status_code == 422
        assert named in {error["field"] for error in answer.json()["errors"]}
        assert len(entries) <= 100


def test_faults_behind_the_first_entries_are_counted(refusing: TestClient):
    aims: dict[str, Any] = {f"A{number}": [0, 0] for number in range(100)} | {
        f"A{n}": [""] for n in range(100, 300)
    }
    answer = refusing.post("/v1/jobs/plans", json={**PLAN, "aim_offsets_m": aims})
    assert answer.status_code == 422
    assert "400 faults" in answer.json()["detail"]


def test_plan_that_aims_every_heliostat_in_two_ways_is_taken(client: TestClient):
    names = [f"A{number}" for number in range(20_000)]
    body = {
        **PLAN,
        "aim_offsets_m": dict.fromkeys(names, (0, 1)),
        "aim_points_m": dict.fromkeys(names, (0, 1, 2)),
    }
    answer = client.post("/v1/jobs/plans", json=body)  # it fits; the heliostats are not stored
    assert (answer.status_code, "not found" in answer.json()["detail"]) == (404, True)


def test_document_that_is_kept_as_it_comes_has_a_bound(refusing: TestClient):
    body = {**properties_document(), "more": [0] * 30_000}
    answer = refusing.put("/v1/heliostats/AA39", json=body)
    assert answer.status_code == 422
    assert "20000 values" in answer.json()["detail"]


# --- who may send one
# -------------------------------------------------------------------------------------------------


@pytest.fixture
def bounded(tmp_path: Path) -> Iterator[tuple[FastAPI, str]]:
    """A service behind a socket, which knows a heliostat, with narrow bounds."""
    settings = Settings(
        data_dir=tmp_path / "data",
        max_image_bytes=1_000_000,
        max_json_bytes=10_000,
        max_uploads_of_key=2,
        max_body_bytes_of_key=2_100_000,
        max_body_bytes=3_200_000,
        **QUIET,
    )
    app = create_app(settings, FakeOperations())
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        with serving(app, lifespan="off") as address:
            yield app, address


def _begin(
    address: str, key: dict[str, str], path: str, kind: str, size: int, sent: bytes = b""
) -> socket.socket:
    """A request whose body does not come, but for what is ``sent``."""
    connection = socket.create_connection(("127.0.0.1", int(address.rsplit(":", 1)[1])), timeout=60)
    head = (
        f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: {kind}\r\nContent-Length:"
        f" {size}\r\n"
    )
    head += "".join(f"{name}: {value}\r\n" for name, value in key.items())
    connection.sendall(head.encode() + b"\r\n" + sent)
    return connection


FORM = "multipart/form-data; boundary=x"
PART = b'--x\r\nContent-Disposition: form-data; name="image"; filename="a"\r\n\r\n' + b"a" * 1000


def _status(connection: socket.socket) -> int:
    with connection:
        return int(connection.recv(65536)[9:12])


def _photograph(address: str, key: dict[str, str], seed: int) -> httpx.Response:
    files, form = {"image": ("a.png", png(seed), "image/png")}, {"metadata": json.dumps(metadata())}
    return httpx.post(f"{address}{POST}", files=files, data=form, headers=key)


@pytest.mark.parametrize(
    ("path", "kind"),
    [(POST, FORM), ("/v1/jobs/plans", "application/json"), ("/plans", "application/json")],
)
def test_role_is_checked_before_a_body_is_read(bounded: tuple[FastAPI, str], path: str, kind: str):
    app, address = bounded
    reader = bearer(make_key(app, "reader", "read"))
    assert _status(_begin(address, reader, path, kind, 9_000)) == 403


def test_only_photographs_may_be_as_large_as_photographs(bounded: tuple[FastAPI, str]):
    """What says that it is a form, but goes elsewhere, would lie in memory as a whole."""
    app, address = bounded
    reader = bearer(make_key(app, "reader", "read"))
    assert _status(_begin(address, reader, "/v1/heliostats/AA39/motors", FORM, 500_000)) == 413


def test_stalled_photographs_of_one_key_keep_no_other_from_sending(bounded: tuple[FastAPI, str]):
    app, address = bounded
    greedy, victim = (
        bearer(make_key(app, "greedy", "ingest")),
        bearer(make_key(app, "victim", "ingest")),
    )
    limiter = app.state.bodies
    with ExitStack() as held:
        for _ in range(2):
            held.enter_context(_begin(address, greedy, POST, FORM, 900_000, PART))
        until(lambda: limiter.held_uploads("greedy") == 2)
        refused = _photograph(address, greedy, 1)
        assert (refused.status_code, refused.headers["Retry-After"]) == (429, "5")
        assert _photograph(address, victim, 2).status_code == 201
    until(lambda: limiter.held_uploads("greedy") == 0)
    assert _photograph(address, greedy, 3).status_code == 201


def test_bytes_that_are_announced_count(tmp_path: Path):
    bounds = {"max_body_bytes_of_key": 2_100_000, "max_body_bytes": 3_200_000}
    settings = Settings(data_dir=tmp_path, max_image_bytes=1_000_000, **bounds, **QUIET)
    app = create_app(settings, FakeOperations())
    with client_of(app), serving(app, lifespan="off") as address:
        keys = [bearer(make_key(app, name, "ingest")) for name in ("a", "b")]
        with ExitStack() as held:

            def stall(key: dict[str, str]) -> None:
                before = app.state.bodies.held_bytes()
                held.enter_context(_begin(address, key, POST, FORM, 900_000, PART))
                until(lambda: app.state.bodies.held_bytes() > before)

            for _ in range(2):
                stall(keys[0])
            assert _status(_begin(address, keys[0], POST, FORM, 900_000)) == 429
            stall(keys[1])
            assert _status(_begin(address, keys[1], POST, FORM, 900_000)) == 503
        until(lambda: app.state.bodies.held_bytes() == 0)


def test_full_disk_while_a_photograph_is_read_is_507(post: Post, monkeypatch: pytest.MonkeyPatch):
    """With 400, senders assumed that their photograph was wrong, and did not send it again."""

    class Full(SpooledTemporaryFile[bytes]):
        def write(self, data: Any) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("starlette.formparsers.SpooledTemporaryFile", Full)
    answer = post()
    assert answer.status_code == 507
    assert answer.headers["Retry-After"] == "60"


def test_bounds_of_bodies_fit_each_other(tmp_path: Path):
    with pytest.raises(ValueError, match="max_body_bytes_of_key: 33554432 must lie between"):
        Settings(data_dir=tmp_path, max_body_bytes_of_key=32 * 2**20)
