"""Clients that take more than their share: they wait, and nobody else does."""

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import httpx
import pytest
from fastapi import FastAPI, HTTPException, Response
from fastapi.testclient import TestClient
from starlette.types import Message, Receive, Scope, Send

from service.base.errors import BusyError
from service.base.settings import Settings
from service.twin.runtime import Runtime
from service.twin.slots import CALLER, ComputeSlots
from service.web.app import config_of, create_app
from service.web.auth.limiters import FairLimiter, Protocol, RateLimiter, protocol_of, sender_of
from service.web.auth.request_checks import BodyLimiter
from service.web.middleware import BodyLimitMiddleware
from tests.service.access import bearer, make_key
from tests.service.conftest import QUIET, FakeOperations, Post, client_of, png, serving, until
from tests.waiting import WAIT_LIMIT_S

FORECAST = {
    "heliostat": "AA39",
    "target": "lower",
    "sun": {"azimuth_deg": 180.0, "elevation_deg": 45.0},
}


@contextmanager
def _none_left(client: TestClient, app: FastAPI, what: str) -> Iterator[None]:
    """While another key holds the only slot, and nobody may wait."""
    limiter = FairLimiter(count=1, max_waiting=0)
    setattr(app.state, what, limiter)
    held = limiter.acquire("the test")
    assert client.portal is not None
    client.portal.call(held.__aenter__)
    yield
    client.portal.call(held.__aexit__, None, None, None)


def test_maps_have_turns_of_their_own_and_light_requests_need_none(
    client: TestClient, app: FastAPI
):
    made = client.post("/v1/forecasts", json={**FORECAST, "surface": "ideal"})
    with _none_left(client, app, "render_limiter"):
        refused = client.get(made.headers["Location"])
        assert (refused.status_code, refused.headers["Retry-After"]) == (503, "5")
        assert refused.headers["Content-Type"] == "application/problem+json"
        for light in (
            "/v1/plant",
            "/v1/heliostats/AA39",
            "/v1/forecasts",
            "/readyz",
            "/jobs",
            "/forecast",
        ):
            assert client.get(light).status_code == 200, light


def test_pages_with_maps_have_the_same_turns(client: TestClient, app: FastAPI):
    client.post("/v1/forecasts", json={**FORECAST, "surface": "ideal"})
    client.post("/v1/jobs/predictions", json={})
    drawn = ("/", "/heliostats/AA39", "/forecasts/1", "/jobs/1")
    assert [client.get(page).status_code for page in drawn] == [200] * 4
    with _none_left(client, app, "render_limiter"):
        assert [client.get(page).status_code for page in drawn] == [503] * 4


def test_one_key_does_not_fill_the_line_before_the_model(
    client: TestClient, app: FastAPI, post: Post
):
    asked = {**FORECAST, "surface": "ideal"}
    form = {"heliostat": "AA39", "target": "lower", "azimuth_deg": "180", "elevation_deg": "45"}
    with _none_left(client, app, "compute_limiter"):
        assert post().status_code == 503
        assert client.post("/v1/forecasts", json=asked).status_code == 503
        assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 503
        assert client.post("/forecast", data=form).status_code == 503
    assert [post(png(seed)).status_code for seed in (1, 2)] == [
        201,
        201,
    ]  # each gives its turn back


def test_requests_for_the_whole_field_have_separate_slots(client: TestClient, app: FastAPI):
    paths = ("/v1/field", "/v1/alarms", "/alarms", "/metrics")
    assert [client.get(path).status_code for path in paths] == [200] * 4
    with _none_left(client, app, "overview_limiter"):
        assert [client.get(path).status_code for path in paths] == [503] * 4
        assert client.get("/v1/heliostats").status_code == 200


def test_requests_for_the_model_are_queued_by_key(client: TestClient, app: FastAPI):
    seen = []
    reader = make_key(app, "greedy", "operate")

    class Noting(ComputeSlots):
        def enter(self, *arguments: Any) -> None:
            seen.append(CALLER.get())
            super().enter(*arguments)

    app.state.runtime = replace(app.state.runtime, compute_slots=Noting(1))
    assert (
        client.post(
            "/v1/forecasts", json={**FORECAST, "surface": "ideal"}, headers=bearer(reader)
        ).status_code
        == 201
    )
    assert seen == ["greedy"]


def test_a_turn_ends_with_its_request(client: TestClient, app: FastAPI):
    made = client.post("/v1/forecasts", json={**FORECAST, "surface": "ideal"})
    app.state.render_limiter = FairLimiter(count=1, max_waiting=1)
    assert [client.get(made.headers["Location"]).status_code for _ in range(3)] == [200] * 3
    assert client.get("/v1/forecasts/999").status_code == 404
    assert client.get(made.headers["Location"]).status_code == 200


def test_turns_are_bounded_in_number_and_time():
    async def ask() -> list[str]:
        limiter, said = FairLimiter(count=1, max_waiting=1, timeout_s=0.05), []
        async with limiter.acquire("a"):
            with pytest.raises(BusyError) as late:
                async with limiter.acquire("a"):
                    pass
            said.append(str(late.value))
        async with limiter.acquire("a"):  # a request that timed out holds no slot
            pass
        full = FairLimiter(count=1, max_waiting=0)
        async with full.acquire("a"):
            with pytest.raises(BusyError, match="too much"):
                async with full.acquire("a"):
                    pass
        return said

    assert "one after the other" in anyio.run(ask)[0]


def test_one_key_has_half_of_the_turns_and_of_the_places_to_wait():
    """However greedy it is, another has a turn at once, and two greedy ones are served by turns."""

    async def ask() -> list[str]:
        limiter, order, leave = FairLimiter(count=2, max_waiting=8), [], anyio.Event()

        async def take(who: str) -> None:
            try:
                async with limiter.acquire(who):
                    order.append(who)
                    await leave.wait()
            except BusyError:
                order.append(f"{who} refused")

        async with anyio.create_task_group() as asking:
            for who in ["greedy"] * 6 + ["victim"] + ["other"] * 3:
                asking.start_soon(take, who)
                await anyio.wait_all_tasks_blocked()
            leave.set()
        return order

    assert anyio.run(ask) == [
        *("greedy", "greedy refused", "victim"),
        *("greedy", "other", "greedy", "other", "greedy", "other", "greedy"),
    ]


def test_who_goes_while_waiting_leaves_no_place_taken():
    async def ask() -> None:
        limiter = FairLimiter(count=2, max_waiting=2)

        async def wait() -> None:
            async with limiter.acquire("a"):
                pass

        for _ in range(3):
            async with limiter.acquire("a"), anyio.create_task_group() as asking:
                asking.start_soon(wait)
                await anyio.wait_all_tasks_blocked()
                asking.cancel_scope.cancel()
        async with limiter.acquire("a"), limiter.acquire("b"):
            pass

    anyio.run(ask)


def test_a_debt_is_paid_before_the_next_request():
    moment = [0.0]
    buckets = RateLimiter(10.0, 20, lambda: moment[0])
    buckets.charge("greedy", 50.0)
    assert buckets.wait_s("greedy") == pytest.approx(3.1)
    assert buckets.wait_s("another") == 0
    moment[0] = 3.2
    assert buckets.wait_s("greedy") == 0


def test_large_answers_cost_their_key_more_and_others_nothing(tmp_path, tower, properties):
    settings = Settings(data_dir=tmp_path, job_workers=0, requests_per_s=0.001, requests_burst=12)
    app = create_app(settings, FakeOperations())
    with client_of(app) as client:
        assert client.put("/v1/plant", json=tower).status_code == 200
        assert client.put("/v1/heliostats/AA39", json=properties).status_code == 201
        large = client.post(
            "/v1/forecasts", json={**FORECAST, "surface": "ideal", "resolution": 1024}
        )
        assert large.status_code == 201
        greedy, victim = (
            bearer(make_key(app, "greedy", "read")),
            bearer(make_key(app, "victim", "read")),
        )
        first = client.get(large.headers["Location"], headers=greedy)
        assert len(first.content) > 12 * 65536
        assert client.get("/v1/plant", headers=greedy).status_code == 429
        assert client.get("/v1/plant", headers=victim).status_code == 200


def test_bad_keys_shut_out_neither_probes_nor_the_login_of_their_address(tmp_path):
    settings = Settings(
        data_dir=tmp_path, job_workers=0, public_requests_per_s=0.001, public_requests_burst=3
    )
    app = create_app(settings, FakeOperations())
    with client_of(app) as client:
        good, bad = (
            bearer(make_key(app, "good", "read")),
            bearer("htw_" + "0" * 12 + "_" + "A" * 43),
        )
        assert [client.get("/v1/audit", headers=bad).status_code for _ in range(5)] == [401] * 3 + [
            429
        ] * 2
        assert {
            client.get(probe).status_code for probe in ("/livez", "/readyz") for _ in range(8)
        } == {200}
        assert client.get("/login").status_code == 200
        assert client.get("/v1/heliostats", headers=good).status_code == 200


def test_server_bounds_connections_and_heads():
    settings = Settings(max_connections=77)
    config = config_of(settings, create_app(settings, FakeOperations()))
    assert (config.limit_concurrency, config.h11_max_incomplete_event_size) == (77, 32768)
    assert isinstance(config.http, type)
    assert issubclass(config.http, Protocol)
    assert config.http.max_each == settings.max_connections_each


@pytest.mark.full
def test_half_a_head_is_not_waited_for_for_ever(app: FastAPI):
    class Hasty(Protocol):
        head_s = 0.2

    with serving(app, http=Hasty) as address:
        port = int(address.rsplit(":", 1)[1])
        for sent in (
            b"",
            b"GET /livez HTTP/1.1\r\nHost: 127",
            b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\nGET /li",
        ):
            with socket.create_connection(("127.0.0.1", port), timeout=WAIT_LIMIT_S) as half:
                half.sendall(sent)
                while half.recv(65536):
                    pass


def _large_answer(protocol: type[Protocol]) -> AbstractContextManager[str]:
    """A server of 32 MB, more than the sockets' own buffers hold."""
    app = FastAPI()
    app.state.stopping = threading.Event()
    app.get("/")(lambda: Response(bytes(2**25)))
    return serving(app, http=protocol)


def _ask_for_it(address: str) -> socket.socket:
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect(("127.0.0.1", int(address.rsplit(":", 1)[1])))
    connection.settimeout(60)
    connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
    return connection


def test_reader_that_never_reads_is_cut():
    """Its answer stayed in memory, and its connection open, for as long as it liked."""
    ended = []

    class Hasty(Protocol):
        read_s = 0.2

        def connection_lost(self, exc: Exception | None) -> None:
            ended.append(self.transport.get_write_buffer_size())
            super().connection_lost(exc)

    with _large_answer(Hasty) as address, _ask_for_it(address):
        until(lambda: len(ended) == 1)


@pytest.mark.parametrize(("taken", "is_cut"), [(0, True), (99, True), (100, False), (5000, False)])
def test_reader_may_be_slow_but_not_slower_than_the_least_rate(taken: int, is_cut: bool):
    class Transport:
        left = 10_000 - taken
        was_cut = False

        def get_write_buffer_size(self) -> int:
            return self.left

        def abort(self) -> None:
            self.was_cut = True

    class Watching(Protocol):
        read_s, min_bytes_per_s = 10.0, 10.0
        watched = 0

        def __init__(self) -> None:
            self.transport = Transport()  # type: ignore[assignment]

        def _watch_reader(self) -> None:
            self.watched += 1

    protocol = Watching()
    protocol._require_reading(10_000)
    assert (protocol.transport.was_cut, protocol.watched) == (is_cut, 0 if is_cut else 1)  # type: ignore[attr-defined]


def test_one_connection_too_many_is_answered_503(tmp_path):
    settings = Settings(data_dir=tmp_path, **QUIET)
    app = create_app(settings, FakeOperations())
    with serving(app, limit_concurrency=2) as address, httpx.Client(base_url=address) as first:
        assert first.get("/livez").status_code == 200  # keeps its connection
        assert httpx.get(f"{address}/livez").status_code == 503


def _connect(address: str, port: int) -> socket.socket:
    """A connection from one of this machine's own addresses, silent."""
    return socket.create_connection(
        ("127.0.0.1", port), timeout=WAIT_LIMIT_S, source_address=(address, 0)
    )


def _ask(connection: socket.socket) -> bytes:
    connection.sendall(b"GET /livez HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
    return connection.recv(65536)[:12]


def test_one_address_cannot_hold_all_connections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Silent connections beyond its share are ended; who comes from elsewhere notices nothing."""
    monkeypatch.setattr(
        "service.web.auth.limiters.is_loopback", lambda address: address == "127.0.0.9"
    )
    settings = Settings(
        data_dir=tmp_path, max_connections_each=3, forwarded_allow_ips="127.0.0.7", **QUIET
    )
    app = create_app(settings, FakeOperations())
    with serving(app, http=protocol_of(settings)) as address, ExitStack() as held:
        port = int(address.rsplit(":", 1)[1])
        # Of this machine and of a trusted proxy any number, for many come through there.
        for sender, most in (("127.0.0.2", 3), ("127.0.0.7", 6), ("127.0.0.9", 6)):
            silent = [held.enter_context(_connect(sender, port)) for _ in range(6)]
            for refused in silent[most:]:
                assert refused.recv(100).startswith(b"HTTP/1.1 503 ")
            assert _ask(silent[0]) == b"HTTP/1.1 200"
        assert _ask(held.enter_context(_connect("127.0.0.3", port))) == b"HTTP/1.1 200"
        # One of the three has gone.
        assert _ask(held.enter_context(_connect("127.0.0.2", port))) == b"HTTP/1.1 200"


def test_addresses_of_one_holder_count_together():
    assert sender_of("2001:db8::1") == sender_of("2001:db8::2:1") != sender_of("2001:db8:1::1")
    assert sender_of("::ffff:192.0.2.1") == sender_of("192.0.2.1") != sender_of("192.0.2.2")


def test_public_paths_take_small_forms_only(bare: TestClient):
    for path in ("/login", "/session"):
        assert bare.post(path, data={"key": "x" * 5000}).status_code == 413
        assert bare.post(path, files={"key": ("a", b"x")}).status_code == 415
        assert bare.post(path, data={"key": "nonsense"}).status_code == 401


class _VirtualTimeLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is that of the tasks alone: where all of them sleep, it passes at
    once.
    """

    def __init__(self) -> None:
        super().__init__()
        self._now_s, select = 0.0, self._selector.select

        def pass_time(timeout: float | None = None) -> Any:
            self._now_s += timeout or 0.0
            return select(None if timeout is None else 0.0)

        self._selector.select = pass_time

    def time(self) -> float:
        return self._now_s


def _sent_slowly(
    settings: Settings, part: bytes, pause_s: float, timeout_s: float
) -> tuple[str, int]:
    """What a sender of one part after the other is answered, and how many parts it got rid of."""
    answers: list[str] = []
    taken = 0

    async def reads_its_body(scope: Scope, receive: Receive, send: Send) -> None:
        nonlocal taken
        try:
            while (await receive()).get("more_body", False):
                taken += 1
        except HTTPException as error:
            answers.append(f"{error.status_code}")

    async def receive() -> Message:
        await anyio.sleep(pause_s)
        return {"type": "http.request", "body": part, "more_body": taken < 60}

    async def send(message: Message) -> None:
        pass

    middleware = BodyLimitMiddleware(reads_its_body, settings, BodyLimiter(settings))
    middleware.timeout_s = timeout_s
    scope = {"type": "http", "path": "/v1/plant", "headers": []}
    with pytest.MonkeyPatch.context() as patch:
        clock = SimpleNamespace(monotonic=lambda: asyncio.get_running_loop().time())
        patch.setattr("service.web.middleware.time", clock)
        anyio.run(
            middleware, scope, receive, send, backend_options={"loop_factory": _VirtualTimeLoop}
        )
    return "".join(answers), taken


def test_a_body_that_does_not_come_is_not_waited_for(settings: Settings):
    assert _sent_slowly(settings, b"{", 60.0, 0.01) == ("408", 0)


def test_a_body_that_drips_ends_as_a_whole(settings: Settings):
    """No pause is long, and it would never end."""
    slow = settings.model_copy(update={"min_bytes_per_s": 1000.0})
    answer, taken = _sent_slowly(slow, b" ", 0.01, 0.2)
    assert answer == "408"
    assert taken < 40
    assert _sent_slowly(slow, b" " * 100, 0.01, 0.2) == (
        "",
        60,
    )  # ten times the rate, and three times as long


def test_a_busy_model_is_503_for_requests_and_nothing_for_the_light(
    client: TestClient, app: FastAPI
):
    busy = ComputeSlots(1, max_waiting=0)
    busy.enter()
    app.state.runtime = replace(app.state.runtime, compute_slots=busy)
    refused = client.post("/v1/forecasts", json={**FORECAST, "surface": "ideal"})
    assert (refused.status_code, refused.headers["Retry-After"]) == (503, "5")
    assert client.get("/v1/plant").status_code == 200
    busy.leave()


def test_requests_have_little_patience_and_jobs_all(bare: TestClient, app: FastAPI):
    assert app.state.runtime.timeout_s is not None
    assert Runtime.from_settings(app.state.runtime.settings, FakeOperations()).timeout_s is None
