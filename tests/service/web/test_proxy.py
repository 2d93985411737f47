"""Behind a proxy: nobody is let in without a key, and its word on who asks counts where it is
trusted only.
"""

import http.client
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.web.app import config_of, create_app
from tests.service.access import bearer, make_key
from tests.service.conftest import FakeOperations, free_port, listening, serving

FORWARDED = [
    {"Forwarded": "for=192.0.2.1"},
    {"X-Forwarded-For": "192.0.2.1"},
    {"X-Forwarded-For": "127.0.0.1"},
    {"X-Forwarded-For": ""},
    {"X-Forwarded-Proto": "https"},
    {"X-Forwarded-Host": "127.0.0.1"},
    {"x-forwarded-anything": "1"},
    {"X-Real-IP": "127.0.0.1"},
    {"Via": "1.1 proxy"},
]


@pytest.mark.parametrize("headers", FORWARDED, ids=str)
def test_nobody_behind_a_proxy_comes_in_without_a_key(
    app: FastAPI, bare: TestClient, headers: dict[str, str]
):
    """It sends 127.0.0.1 as Host, for that is where it found the service."""
    assert bare.get("/v1/audit").status_code == 200
    refused = bare.get("/v1/audit", headers=headers)
    assert refused.status_code == 401
    assert "heliotwin keys create" in refused.json()["detail"]
    page = bare.get("/", headers={**headers, "Accept": "text/html"}, follow_redirects=False)
    assert page.headers["Location"].startswith("/login")
    assert bare.get("/livez", headers=headers).status_code == 200
    key = bearer(make_key(app, "first"))
    assert bare.get("/v1/audit", headers={**headers, **key}).status_code == 200


def test_a_proxy_that_says_nothing_is_known_by_its_version(app: FastAPI, bare: TestClient):
    """nginx with its default settings: HTTP/1.0, the service's name as Host, no added header."""
    with serving(app, lifespan="off") as address:
        connection = http.client.HTTPConnection(address.removeprefix("http://"))
        for version, status in (("HTTP/1.0", 401), ("HTTP/1.1", 200)):
            connection._http_vsn_str = version  # type: ignore[attr-defined]  # it has no other way
            connection.request("GET", "/v1/audit", headers={"Connection": "close"})
            assert connection.getresponse().status == status
            connection.close()


# --- a service and a proxy
# --------------------------------------------------------------------------------------------


@contextmanager
def proxy(service: str) -> Iterator[str]:
    """A proxy that the service sees as one with TLS.

    It takes its client's address from a header of the request.
    """

    class Handler(BaseHTTPRequestHandler):
        def _pass_on(self) -> None:
            client, given = self.headers["X-Test-Client"], self.headers["X-Forwarded-For"]
            seen = {
                "X-Forwarded-For": client if given is None else f"{given}, {client}",
                "X-Forwarded-Proto": "https",
            }
            headers = {**dict(self.headers), **seen}
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            answer = httpx.request(self.command, service + self.path, headers=headers, content=body)
            self.send_response(answer.status_code)
            for name, value in answer.headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(answer.content)

        do_GET = do_POST = _pass_on  # noqa: N815  # as http.server calls them

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextmanager
def plant(folder: Path, **environment: str) -> Iterator[tuple[str, str]]:
    """A proxy before a service that lets each client try four times; yields its address and a valid
    key.
    """
    few = {"HELIOTWIN_PUBLIC_REQUESTS_PER_S": "0.001", "HELIOTWIN_PUBLIC_REQUESTS_BURST": "4"}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (few | environment).items():
            patch.setenv(name, value)
        settings = Settings(data_dir=folder / "data", port=free_port(), job_workers=0)
        app = create_app(settings, FakeOperations())
        with listening(config_of(settings, app), app) as service, proxy(service) as address:
            yield address, make_key(app, "operator", "read")


def guess(address: str, client: str, **headers: str) -> int:
    wrong = bearer("nonsense") | {"X-Test-Client": client, **headers}
    return httpx.get(f"{address}/v1/plant", headers=wrong).status_code


def logged_in(address: str, key: str) -> str:
    answer = httpx.post(
        f"{address}/session", data={"key": key}, headers={"X-Test-Client": "192.0.2.9"}
    )
    assert answer.status_code == 204
    return answer.headers["Set-Cookie"].lower()


def test_a_trusted_proxy_says_who_asks_and_how(tmp_path: Path):
    with plant(tmp_path) as (address, key):
        assert [guess(address, "192.0.2.1") for _ in range(5)] == [401] * 4 + [429]
        # What the client itself writes before the proxy's word helps it nothing.
        assert guess(address, "192.0.2.1", **{"X-Forwarded-For": "192.0.2.77"}) == 429
        assert guess(address, "192.0.2.2") == 401
        assert "secure" in logged_in(address, key)


@pytest.mark.parametrize(
    "environment",
    [
        {"HELIOTWIN_PROXY_HEADERS": "false"},
        {"HELIOTWIN_FORWARDED_ALLOW_IPS": "192.0.2.50", "FORWARDED_ALLOW_IPS": "*"},
    ],
    ids=["none is", "another is"],
)
def test_another_proxy_says_nothing_that_is_believed(tmp_path: Path, environment: dict[str, str]):
    with plant(tmp_path, **environment) as (address, key):
        assert [guess(address, f"192.0.2.{client}") for client in range(1, 6)] == [401] * 4 + [429]
        assert "secure" not in logged_in(address, key)
