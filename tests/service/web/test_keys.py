"""The door: who may come in, to which routes, and what the audit trail says of it."""

import json
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import anyio
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import select

from model.errors import InvalidInputError
from service.base.errors import ConflictError, NotFoundError, UnauthenticatedExposureError
from service.base.settings import Settings
from service.store import job_tables, keys, sessions
from service.store.columns import now
from service.store.database import Database
from service.store.job_tables import AuditRow, KeyRow, SessionRow
from service.web.app import create_app
from service.web.auth import dependencies, security
from service.web.auth.limiters import RateLimiter
from service.web.auth.security import COOKIE, Role
from tests.service.access import bearer, make_key, withdraw
from tests.service.command import exit_code
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    client_of,
    free_port,
    properties_document,
    tower_document,
)

ROLES = list(Role)


# --- the keys themselves
# ----------------------------------------------------------------------------------------------


def test_key_is_kept_as_a_hash(database: Database):
    with database.writing() as session:
        key = keys.create(session, "calibration", "ingest", "tester")
    with database.reading() as session:
        row = session.scalars(select(KeyRow)).one()
        stored = " ".join(str(value) for value in vars(row).values())
        assert keys.find(session, key) is row
    secret = key.split("_", 2)[2]
    assert len(secret) == 43
    assert secret not in stored
    assert (row.role, row.prefix) == ("ingest", key.split("_")[1])


def test_keys_differ_and_names_are_not_given_again(database: Database):
    with database.writing() as session:
        made = {keys.create(session, name, "read", "tester") for name in ("a", "b", "c")}
        keys.withdraw(session, "a", "tester")
        with pytest.raises(ConflictError, match="choose another name"):
            keys.create(session, "a", "read", "tester")
        with pytest.raises(NotFoundError):
            keys.withdraw(session, "a", "tester")
    assert len(made) == 3


def test_keys_expire_and_their_sessions_too(database: Database, monkeypatch: pytest.MonkeyPatch):
    with database.writing() as session:
        key = keys.create(session, "a", "read", "tester", timedelta(hours=1))
        row = keys.find(session, key)
        assert row is not None
        token = sessions.begin(session, row)
    later = now() + timedelta(hours=1, seconds=1)
    monkeypatch.setattr(sessions, "now", lambda: later)
    with database.reading() as session:
        assert (keys.find(session, key), sessions.find_key(session, token)) == (None, None)
        assert not keys.any_valid(session)
        assert keys.any_made(session)


def test_rotation_has_two_valid_keys_at_once(database: Database, monkeypatch: pytest.MonkeyPatch):
    with database.writing() as session:
        former = keys.create(session, "a", "ingest", "tester", timedelta(days=90))
        following = keys.rotate(session, "a", "tester", timedelta(days=7))
        with pytest.raises(ConflictError, match="--former"):
            keys.rotate(session, "a", "tester", timedelta(days=7))
    with database.reading() as session:
        rows = [keys.find(session, key) for key in (former, following)]
        assert [(row.name, row.role) for row in rows if row is not None] == [("a", "ingest")] * 2
    for days, valid in ((6, [True, True]), (8, [False, True]), (91, [False, False])):
        later = now() + timedelta(days=days)
        with monkeypatch.context() as patch, database.reading() as session:
            patch.setattr(sessions, "now", lambda later=later: later)
            assert [keys.find(session, key) is not None for key in (former, following)] == valid
    with database.writing() as session:
        keys.withdraw(session, "a", "tester")
        assert not keys.any_valid(session)
        with pytest.raises(NotFoundError):
            keys.rotate(session, "a", "tester", timedelta())


def test_the_last_use_of_a_key_is_kept_to_the_hour(app: FastAPI, client: TestClient):
    client.headers.update(bearer(make_key(app, "reader", "read")))
    database, used = app.state.runtime.database, []
    for age in (timedelta(0), timedelta(minutes=50), timedelta(minutes=70)):
        with database.writing() as session:
            row = keys.list_keys(session)[0]
            used.append(row.last_used_at)
            row.last_used_at = row.last_used_at and row.last_used_at - age
        assert client.get("/v1/heliostats").status_code == 200
    with database.reading() as session:
        last = keys.list_keys(session)[0].last_used_at
    assert used[0] is None
    assert used[1] - timedelta(minutes=50) == used[2]
    assert last >= used[1]


@pytest.mark.parametrize(
    ("name", "role"),
    [("../x", "read"), ("a b", "read"), ("", "read"), ("local", "read"), ("a", "root")],
)
def test_bad_names_and_roles_are_refused(database: Database, name: str, role: str):
    with pytest.raises(InvalidInputError), database.writing() as session:
        keys.create(session, name, role, "tester")


def test_only_the_very_key_is_found(database: Database):
    with database.writing() as session:
        key = keys.create(session, "a", "read", "tester")
        other = keys.create(session, "b", "read", "tester")
    prefix, secret = key.rsplit("_", 1)[0], other.split("_", 2)[2]
    with database.reading() as session:
        for wrong in (
            "",
            "htw_",
            key[:-1],
            key + "A",
            key.upper(),
            f" {key}",
            f"htw_{key[4:16]}_{secret}",
            f"{prefix}_%",
        ):
            assert keys.find(session, wrong) is None, wrong


# --- every route
# --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def guarded(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[FastAPI, TestClient, dict[str, str]]]:
    """A service with a key of each role and a withdrawn one; those that may not come in change
    nothing in it.
    """
    settings = Settings(data_dir=tmp_path_factory.mktemp("guarded"), **QUIET)
    app = create_app(settings, FakeOperations())
    with client_of(app) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        made = {role.value: make_key(app, f"key-{role}", role) for role in Role}
        made["withdrawn"] = make_key(app, "old")
        withdraw(app, "old")
        yield app, client, made


def ask(client: TestClient, method: str, path: str, headers: dict[str, str]) -> Any:
    body = {"content": b"{}"} if method in ("POST", "PUT") else {}
    return client.request(
        method,
        path.format(name="AA39"),
        headers={"Content-Type": "application/json", **headers},
        **body,
    )


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/heliostats/{name}"),
        ("GET", "/v1/heliostats"),
        ("POST", "/v1/heliostats/{name}/measurements"),
        ("PUT", "/v1/heliostats/{name}"),
        ("GET", "/v1/audit"),
    ],
)
def test_route_lets_in_those_it_should(guarded: Any, method: str, path: str):
    """A page and one route of each role; the role of every route is below."""
    app, client, made = guarded
    needed = security.declared_roles(app)[method, path]
    assert needed is not None
    strangers = {
        "missing": {},
        "empty": {"Authorization": ""},
        "wrong": bearer("htw_" + "0" * 12 + "_" + "A" * 43),
        "nonsense": bearer("x"),
        "other scheme": {"Authorization": f"Basic {made['admin']}"},
        "withdrawn": bearer(made["withdrawn"]),
        "wrong cookie": {"Cookie": f"{security.COOKIE}=nonsense"},
    }
    for why, headers in strangers.items():
        answer = ask(client, method, path, headers)
        assert answer.status_code == 401, why
        assert answer.headers["WWW-Authenticate"] == "Bearer"
    for role in ROLES:
        answer = ask(client, method, path, bearer(made[role]))
        if role.includes(needed):
            assert answer.status_code not in (401, 403), role
        else:
            assert answer.status_code == 403, role
            assert f"needs {needed}" in answer.json()["detail"]


def test_roles_of_routes_are_those_documented(guarded: Any):
    roles = security.declared_roles(guarded[0])
    assert len(roles) > 100
    for (method, path), role in roles.items():
        if security.is_public(path):
            assert role is None
        elif path in ("/v1/audit", "/plant/audit", "/plant/keys", "/plant/settings"):
            assert role == Role.ADMIN
        elif method == "GET" or path.endswith("/motors"):  # what changes nothing is read
            assert role == Role.READ
        else:
            is_photograph = path.endswith("/measurements") and not path.startswith("/v1/jobs/")
            assert role == (Role.INGEST if is_photograph else Role.OPERATE), path


def test_roles_are_those_of_the_keys():
    """By their names, in whatever order they are written down; each may do what those before it
    may.
    """
    assert {role.value for role in Role} == set(job_tables.ROLES)
    steps = [Role.READ, Role.INGEST, Role.OPERATE, Role.ADMIN]
    assert [[one.includes(other) for other in steps] for one in steps] == [
        [True, False, False, False],
        [True, True, False, False],
        [True, True, True, False],
        [True, True, True, True],
    ]
    asked = (dependencies.READ, dependencies.INGEST, dependencies.OPERATE, dependencies.ADMIN)
    assert [found.dependency.role for found in asked] == steps


def test_route_without_a_role_keeps_the_service_from_starting():
    app = create_app(Settings())
    app.add_api_route("/v1/new", lambda: {}, methods=["POST"])
    with pytest.raises(LookupError, match="POST /v1/new"):
        security.require_declared_roles(app)


def test_unknown_paths_disclose_nothing_without_a_key(guarded: Any):
    _, client, made = guarded
    for path in (
        "/v1/nothing",
        "/",
        "/metrics",
        "/docsx",
        "/livez/../v1/heliostats",
        "/docs/../v1/heliostats",
    ):
        assert client.get(path).status_code in (401, 404), path
        assert client.get(path, headers=bearer(made["admin"])).status_code in (200, 404), path
    assert client.get("/docs/%2e%2e/v1/heliostats").status_code in (401, 404)


def test_public_paths_need_no_key(guarded: Any):
    _, client, _ = guarded
    for path in ("/livez", "/docs", "/docs/start.js", "/openapi.json"):
        assert client.get(path).status_code == 200


def test_body_without_a_key_is_not_read(guarded: Any):
    """The answer comes without a chunk being asked for."""
    app, sent = guarded[0], []
    scope = {
        "type": "http",
        "method": "POST",
        "path": "/v1/heliostats/AA39/measurements",
        "headers": [(b"host", b"127.0.0.1"), (b"content-type", b"multipart/form-data; boundary=x")],
        "query_string": b"",
        "client": ("127.0.0.1", 1),
    }

    async def receive() -> Any:
        raise AssertionError("the body was asked for")

    async def send(message: Any) -> None:
        sent.append(message)

    anyio.run(app, scope, receive, send)
    assert sent[0]["status"] == 401


# --- open and closed
# --------------------------------------------------------------------------------------------------


def test_open_on_this_machine_until_the_first_key(app: FastAPI, bare: TestClient):
    assert bare.get("/v1/heliostats").status_code == 200
    assert bare.get("/v1/audit").status_code == 200
    key = make_key(app, "first")
    assert bare.get("/v1/heliostats").status_code == 401
    assert bare.get("/v1/heliostats", headers=bearer(key)).status_code == 200
    withdraw(app, "first")
    assert bare.get("/v1/heliostats").status_code == 401
    assert bare.get("/v1/heliostats", headers=bearer(key)).status_code == 401


def test_does_not_start_open_to_other_machines(settings: Settings, operations: FakeOperations):
    reachable = settings.model_copy(update={"host": "0.0.0.0"})
    app = create_app(reachable, operations)
    with pytest.raises(UnauthenticatedExposureError, match="heliotwin keys create"), client_of(app):
        pass
    with client_of(create_app(settings, operations)) as client:
        key = make_key(client.app, "first")  # type: ignore[arg-type]
    with client_of(create_app(reachable, operations)) as client:
        assert client.get("/v1/heliostats").status_code == 401
        assert (
            client.get(
                "/v1/heliostats", headers=bearer(key) | {"Host": "plant.example"}
            ).status_code
            == 200
        )
        withdraw(client.app, "first")  # type: ignore[arg-type]
    with pytest.raises(UnauthenticatedExposureError), client_of(create_app(reachable, operations)):
        pass


def test_open_network_must_be_acknowledged(settings: Settings, operations: FakeOperations):
    acknowledged = settings.model_copy(update={"host": "0.0.0.0", "allow_open_network": True})
    with client_of(create_app(acknowledged, operations)) as client:
        for host in ("192.0.2.7:8000", "[2001:db8::7]:8000", "localhost:8000"):
            assert client.get("/v1/heliostats", headers={"Host": host}).status_code == 200
        make_key(client.app, "first")  # type: ignore[arg-type]
        assert client.get("/v1/heliostats").status_code == 401


FOREIGN = [
    "evil.example",
    "127.0.0.1.evil.example",
    "[::1",
    "",
    "localhost@evil.example:80",
    "evil.example:8000",
]


@pytest.mark.parametrize("host", FOREIGN)
def test_foreign_names_of_this_machine_are_refused(bare: TestClient, host: str):
    answer = bare.get("/v1/heliostats", headers={"Host": host})
    assert (answer.status_code, answer.json()["type"]) == (421, "urn:heliotwin:problem:other-host")
    assert "HELIOTWIN_ALLOWED_HOSTS" in answer.json()["detail"]
    assert bare.get("/livez", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("host", FOREIGN)
def test_foreign_names_are_refused_where_the_network_is_open(
    settings: Settings, operations: FakeOperations, host: str
):
    """A page of another site could make the first key, or read all, by a name of its owner's that
    points here.
    """
    reachable = {
        "host": "0.0.0.0",
        "allow_open_network": True,
        "allowed_hosts": "plant.example, Twin.example",
    }
    with client_of(create_app(settings.model_copy(update=reachable), operations)) as client:
        assert client.get("/v1/heliostats", headers={"Host": host}).status_code == 421
        assert (
            client.put("/v1/plant", json=tower_document(), headers={"Host": host}).status_code
            == 421
        )
        for own in ("plant.example", "PLANT.example:8000", "twin.example.", "plant.example."):
            assert client.get("/v1/heliostats", headers={"Host": own}).status_code == 200, own


def test_any_name_will_do_with_a_key(app: FastAPI, bare: TestClient):
    """A proxy on the same machine passes on the name that the plant knows the service by."""
    headers = bearer(make_key(app, "first")) | {"Host": "plant.example"}
    assert bare.get("/v1/heliostats", headers=headers).status_code == 200


@pytest.mark.parametrize("host", ["localhost", "localhost:8000", "127.0.0.1:8000", "[::1]:8000"])
def test_own_names_of_this_machine_are_known(bare: TestClient, host: str):
    assert bare.get("/v1/heliostats", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    ("headers", "is_allowed"),
    [
        ({"Sec-Fetch-Site": "cross-site"}, False),
        ({"Sec-Fetch-Site": "same-site"}, False),
        ({"Origin": "http://evil.example"}, False),
        ({"Origin": "null"}, False),
        ({"Sec-Fetch-Site": "same-origin", "Origin": "http://127.0.0.1"}, True),
        ({"Origin": "http://127.0.0.1"}, True),
        ({"Sec-Fetch-Site": "none"}, True),
        ({}, True),
    ],
)
def test_pages_of_other_sites_change_nothing(
    bare: TestClient, headers: dict[str, str], is_allowed: bool
):
    answer = bare.put("/v1/plant", json=tower_document(), headers=headers)
    assert answer.status_code == (200 if is_allowed else 403)
    assert bare.get("/v1/targets", headers=headers).status_code == 200


# --- the cookie
# --------------------------------------------------------------------------------------------------


def test_cookie_for_pages(app: FastAPI, bare: TestClient):
    key = make_key(app, "operator", "read")
    assert bare.post("/session", data={"key": "wrong"}).status_code == 401
    assert not bare.cookies
    answer = bare.post("/session", data={"key": key})
    assert answer.status_code == 204
    cookie = answer.headers["Set-Cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert bare.get("/v1/heliostats").status_code == 200
    assert bare.get("/v1/audit").status_code == 403
    # A header goes before the cookie, also where it is wrong.
    assert bare.get("/v1/heliostats", headers=bearer("wrong")).status_code == 401
    assert bare.delete("/session").status_code == 204
    assert bare.get("/v1/heliostats").status_code == 401
    bare.post("/session", data={"key": key})
    withdraw(app, "operator")
    assert bare.get("/v1/heliostats").status_code == 401


def copied(client: TestClient) -> dict[str, str]:
    """The browser's cookie, as somebody else would send it."""
    return {"Cookie": f"{COOKIE}={client.cookies[COOKIE]}"}


def answer_to(app: FastAPI, headers: dict[str, str]) -> int:
    """What another browser is answered, on the same service."""
    return (
        TestClient(app, base_url="http://127.0.0.1")
        .get("/v1/heliostats", headers=headers)
        .status_code
    )


def test_cookie_holds_a_session_and_never_the_key(app: FastAPI, bare: TestClient):
    key = make_key(app, "operator", "read")
    for begin in (
        lambda: bare.post("/session", data={"key": key}),
        lambda: bare.post("/login", data={"key": key}, follow_redirects=False),
    ):
        answer = begin()
        token = bare.cookies[COOKIE]
        assert key.split("_", 2)[2] not in answer.headers["Set-Cookie"]
        with app.state.runtime.database.reading() as session:
            rows = session.scalars(select(SessionRow)).all()
            assert token not in str([vars(row) for row in rows])
            assert all(len(row.sha256) == 64 for row in rows)
        assert bare.get("/v1/heliostats").status_code == 200
    # Each is of use in its own place only.
    assert answer_to(app, bearer(token)) == 401
    assert answer_to(app, {"Cookie": f"{COOKIE}={key}"}) == 401


@pytest.mark.parametrize("end", ["logout", "delete", "withdraw", "time"])
def test_session_ends_for_all_its_copies(
    app: FastAPI, bare: TestClient, end: str, monkeypatch: pytest.MonkeyPatch
):
    key = make_key(app, "operator", "read")
    bare.post("/session", data={"key": key})
    stolen = copied(bare)
    assert answer_to(app, stolen) == 200
    if end == "logout":
        bare.post("/logout")
    elif end == "delete":
        bare.delete("/session")
    elif end == "withdraw":
        withdraw(app, "operator")
    else:
        later = now() + sessions.LASTS + timedelta(seconds=1)
        monkeypatch.setattr(sessions, "now", lambda: later)
    assert answer_to(app, stolen) == 401
    assert "session of this browser has ended" in bare.get("/login", headers=stolen).text
    assert answer_to(app, bearer(key)) == (401 if end == "withdraw" else 200)


def test_sessions_of_a_key_are_bounded_and_old_ones_deleted(
    database: Database, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sessions, "_MOST", 2)
    with database.writing() as session:
        keys.create(session, "operator", "read", "tester")
        row = keys.list_keys(session)[0]
        tokens = [sessions.begin(session, row) for _ in range(3)]
    with database.reading() as session:
        assert [sessions.find_key(session, token) is not None for token in tokens] == [
            False,
            True,
            True,
        ]
    later = now() + sessions.LASTS + timedelta(seconds=1)
    monkeypatch.setattr(sessions, "now", lambda: later)
    with database.writing() as session:
        sessions.begin(session, session.merge(row))
        assert len(session.scalars(select(SessionRow)).all()) == 1


def test_cookie_is_for_encrypted_connections_where_there_is_one(app: FastAPI, bare: TestClient):
    key = make_key(app, "operator", "read")
    answer = bare.post("https://127.0.0.1/session", data={"key": key})
    assert "secure" in answer.headers["Set-Cookie"].lower()


# --- limits and headers
# -----------------------------------------------------------------------------------------------


def test_bucket_empties_and_fills():
    at = [0.0]
    buckets = RateLimiter(rate_per_s=2.0, burst=3, clock=lambda: at[0])
    assert [buckets.wait_s("a") for _ in range(4)] == [0, 0, 0, 0.5]
    assert buckets.wait_s("b") == 0
    at[0] = 0.5
    assert [buckets.wait_s("a"), buckets.wait_s("a")] == [0, 0.5]
    at[0] = 100.0
    assert [buckets.wait_s("a") for _ in range(4)] == [0, 0, 0, 0.5]


SLOW = {
    "requests_per_s": 0.01,
    "requests_burst": 3,
    "public_requests_per_s": 0.01,
    "public_requests_burst": 3,
}
"""Settings by which a key, and an address without one, may ask three times."""


def test_who_asks_too_often_has_to_wait(settings: Settings, operations: FakeOperations):
    slow = settings.model_copy(update=SLOW)
    app = create_app(slow, operations)
    with client_of(app) as client:
        first, second = make_key(app, "first"), make_key(app, "second")
        answers = [client.get("/v1/heliostats", headers=bearer(first)) for _ in range(4)]
        assert [answer.status_code for answer in answers] == [200, 200, 200, 429]
        assert int(answers[-1].headers["Retry-After"]) > 60
        assert client.get("/v1/heliostats", headers=bearer(second)).status_code == 200
        guesses = [
            client.get("/v1/heliostats", headers=bearer(f"guess{i}")).status_code for i in range(5)
        ]
        assert guesses == [401, 401, 401, 429, 429]


@pytest.mark.full
@pytest.mark.parametrize(
    "path", ["/login", "/session", "/logout", "/docs", "/openapi.json", "/static/app.css"]
)
def test_public_paths_are_limited_by_address(
    settings: Settings, operations: FakeOperations, path: str
):
    """They have a separate limit: a valid key at that address, and supervisors, are not limited."""
    app = create_app(settings.model_copy(update=SLOW), operations)
    with client_of(app) as client:
        reader = bearer(make_key(app, "reader"))
        answers = [client.get(path) for _ in range(8)]
        refused = [answer.status_code == 429 for answer in answers]
        assert refused == sorted(refused), "once refused, an address stays so until it has waited"
        assert not refused[0]
        assert refused[3:] == [True] * 5
        assert int(answers[-1].headers["Retry-After"]) > 60
        assert (
            client.get("/static/app.css", headers=reader).status_code == 429
        )  # a key changes nothing where none is
        assert client.get("/v1/heliostats", headers=reader).status_code == 200
        assert {
            client.get(probe).status_code for probe in ("/livez", "/readyz") for _ in range(5)
        } == {200}


def test_public_limit_is_below_the_limit_of_keys():
    """What the machine serves is measured by ``python -m benchmarks.public``: 28
    /openapi.json a second.
    """
    fields = Settings.model_fields
    assert fields["public_requests_per_s"].default <= fields["requests_per_s"].default / 10


@pytest.mark.parametrize(
    "path", ["/livez", "/docs", "/v1/heliostats", "/v1/nothing", "/v1/forecasts/x", "/openapi.json"]
)
def test_headers_for_browsers(bare: TestClient, path: str):
    headers = bare.get(path).headers
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert "unsafe" not in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"


def test_failures_have_headers_for_browsers(bare: TestClient, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("service.store.list_heliostats", fail)
    answer = bare.get("/v1/heliostats")
    assert answer.status_code == 500
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_documentation_asks_nobody_else(bare: TestClient):
    page = bare.get("/docs").text
    assert "//" not in page.replace("<!doctype html>", "")
    for asset, kind in (
        ("swagger-ui.css", "text/css"),
        ("swagger-ui-bundle.js", "text/javascript"),
        ("start.js", "text/"),
    ):
        assert f"/docs/{asset}" in page
        answer = bare.get(f"/docs/{asset}")
        assert answer.status_code == 200
        assert answer.headers["Content-Type"].startswith(kind)
    assert "validatorUrl: null" in bare.get("/docs/start.js").text
    assert bare.get("/docs/other.js").status_code == 404


# --- the audit trail
# --------------------------------------------------------------------------------------------------


def test_audit_trail_says_who_did_what(app: FastAPI, client: TestClient, post: Any):
    post()
    key = make_key(app, "operator", "operate")
    client.post("/v1/heliostats/AA39/surfaces", json={}, headers=bearer(key))
    job = client.post("/v1/jobs/predictions", json={}, headers=bearer(key)).json()
    client.post(f"/v1/jobs/{job['id']}/cancel", headers=bearer(key))
    admin = make_key(app, "admin")
    withdraw(app, "operator")
    page = client.get("/v1/audit", params={"limit": 4}, headers=bearer(admin)).json()
    rest = client.get("/v1/audit", params={"after": page["next"]}, headers=bearer(admin)).json()
    found = [
        (entry["actor"], entry["action"], entry["subject"])
        for entry in page["items"] + rest["items"]
    ]
    assert found == [
        ("tester", "key.withdrawn", "key operator"),
        ("tester", "key.created", "key admin"),
        ("operator", "job.cancelled", "job 1"),
        ("operator", "job.created", "job 1"),
        ("operator", "surface.predicted", "heliostat AA39"),
        ("tester", "key.created", "key operator"),
        ("local", "heliostat.set", "heliostat AA39"),
        ("local", "plant.set", "plant WRI1030197"),
    ]
    assert page["items"][0]["created_at"]


def test_what_fails_leaves_no_entry(app: FastAPI, client: TestClient):
    with app.state.runtime.database.reading() as session:
        before = len(session.scalars(select(AuditRow)).all())
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 409
    assert client.post("/v1/jobs/7/cancel").status_code == 404
    with app.state.runtime.database.reading() as session:
        assert len(session.scalars(select(AuditRow)).all()) == before


# --- the command line
# -------------------------------------------------------------------------------------------------


def test_keys_by_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(tmp_path / "data"))
    assert exit_code("keys", "create", "plant", "--role", "operate") == 2
    said = capsys.readouterr().err
    assert (str(tmp_path / "data") in said, "HELIOTWIN_DATA_DIR" in said) == (True, True)
    assert not (tmp_path / "data").exists()  # a key never makes a store
    assert exit_code("migrate") == 0
    capsys.readouterr()
    assert exit_code("keys", "create", "plant", "--role", "operate", "--days", "30") == 0
    shown = capsys.readouterr()
    assert shown.err.strip() == f"in the store of HELIOTWIN_DATA_DIR={tmp_path / 'data'}"
    key = shown.out.strip()
    assert exit_code("keys", "list", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed[0]["expires_at"] > listed[0]["created_at"]
    assert [(entry["name"], entry["role"], entry["withdrawn_at"]) for entry in listed] == [
        ("plant", "operate", None)
    ]
    assert key.split("_", 2)[2] not in json.dumps(listed)
    database = Database(Settings().database)
    with database.reading() as session:
        assert keys.find(session, key) is not None
    assert exit_code("keys", "rotate", "plant", "--overlap-days", "1") == 0
    following = capsys.readouterr().out.strip()
    assert exit_code("keys", "withdraw", "plant", "--former") == 0
    with database.reading() as session:
        assert keys.find(session, key) is None
        assert keys.find(session, following) is not None
    assert exit_code("keys", "withdraw", "plant") == 0
    with database.reading() as session:
        assert keys.find(session, following) is None
    database.close()
    capsys.readouterr()
    assert exit_code("keys", "withdraw", "plant") == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert exit_code("keys", "create", "a b", "--role", "read") == 2
    capsys.readouterr()
    assert exit_code("keys", "create", "x", "--role", "root") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "--role must be" in said
    assert all(f"'{role}'" in said for role in ROLES)
    assert exit_code("keys", "create", "x") == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert exit_code("worker", "--count", "0") == 2


def test_serve_refuses_unauthenticated_exposure(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
):
    monkeypatch.setenv("HELIOTWIN_DATA_DIR", str(tmp_path / "data"))
    assert exit_code("serve", "--host", "0.0.0.0", "--port", str(free_port())) == 1
    said = capsys.readouterr().err
    assert "heliotwin: host 0.0.0.0" in said
    assert "heliotwin keys create" in said
    assert "Traceback" not in said + caplog.text
