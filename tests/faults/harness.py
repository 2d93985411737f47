"""A store and its database, processes on it that can be killed, and a client that remembers what it was promised."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import httpx
import psycopg
from sqlalchemy import make_url

from service.base.settings import Settings
from service.store.backup import images_of
from service.store.check import inspect_store
from service.store.database import Database
from tests.service.conftest import POSTGRES, free_port, metadata, properties_document, tower_document

ROOT = Path(__file__).parents[2]
PATIENCE_S = 90.0


def until(condition: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
    """Wait until ``condition`` gives something, and return it."""
    end = time.monotonic() + patience_s
    while not (found := condition()):
        assert time.monotonic() < end, f"{what}: it does not happen"
        time.sleep(0.05)
    return found


@dataclass
class Store:
    """Where a store lies; ``url`` names its database, None for SQLite inside of ``folder``."""

    folder: Path
    url: str | None
    environment: dict[str, str] = field(default_factory=dict)

    @property
    def settings(self) -> Settings:
        return Settings(data_dir=self.folder, database_url=self.url)

    def check(self) -> dict[str, Any]:
        """What `heliotwin check` finds."""
        database = Database(self.settings.database)
        try:
            return inspect_store(database, images_of(self.settings), lambda _: None)
        finally:
            database.close()


@contextmanager
def postgres_database() -> Iterator[str]:
    """The URL of a database of our own, dropped at the end."""
    name = f"heliotwin_fault_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(POSTGRES, autocommit=True, connect_timeout=3) as connection:
        connection.execute(f'CREATE DATABASE "{name}"')
    try:
        yield make_url(POSTGRES).set(database=name).render_as_string(hide_password=False)
    finally:
        with psycopg.connect(POSTGRES, autocommit=True) as connection:
            connection.execute(f'DROP DATABASE "{name}" WITH (FORCE)')


@contextmanager
def new_store(engine: str, folder: Path) -> Iterator[Store]:
    """An empty store on sqlite or postgres."""
    if engine == "sqlite":
        yield Store(folder / "data", None)
        return
    with postgres_database() as url:
        yield Store(folder / "data", url)


class Process:
    """A service, or a worker, on a store; `kill` ends it by SIGKILL."""

    def __init__(
        self,
        store: Store,
        what: str = "serve",
        module: str = "tests.faults.process",
        port: int | None = None,
        **environment: str,
    ) -> None:
        self.port = port or free_port()
        self.base = f"http://127.0.0.1:{self.port}"
        settings = {
            "HELIOTWIN_DATA_DIR": str(store.folder),
            "HELIOTWIN_DATABASE_URL": store.url or "",
            "HELIOTWIN_MIGRATE_ON_START": "true",
            "HELIOTWIN_PORT": str(self.port),
            "HELIOTWIN_JOB_WORKERS": "1" if what == "worker" else "0",
            "HELIOTWIN_JOB_LEASE_S": "2",
            "HELIOTWIN_JOB_POLL_S": "0.1",
            "HELIOTWIN_REQUESTS_PER_S": "1000000",
            "HELIOTWIN_REQUESTS_BURST": "1000000",
            "HELIOTWIN_LOG_LEVEL": "error",
        }
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, what],
            cwd=ROOT,
            env=os.environ | settings | store.environment | environment,
            stderr=subprocess.DEVNULL,
        )
        self._what = what
        self._clients: list[Client] = []

    def __enter__(self) -> Self:
        if self._what == "serve":
            until(self.is_alive, "the service answers")
        return self

    def __exit__(self, *_: object) -> None:
        for client in self._clients:
            client.http.close()
        self.end(signal.SIGTERM)

    def client(self) -> "Client":
        """A client of this service, closed with it."""
        self._clients.append(Client(self.base))
        return self._clients[-1]

    def is_alive(self) -> bool:
        assert self._process.poll() is None, "the process ended by itself"
        try:
            return httpx.get(f"{self.base}/livez", timeout=10).status_code == 200
        except httpx.TransportError:
            return False

    @property
    def number(self) -> int:
        """Of the process."""
        return self._process.pid

    def kill(self) -> None:
        self.end(signal.SIGKILL)

    def end(self, number: int) -> None:
        if self._process.poll() is None:
            self._process.send_signal(number)
        self._process.wait(60)


class Client:
    """Posts photographs and remembers those that were acknowledged, by the measurement's id."""

    def __init__(self, base: str) -> None:
        self.http = httpx.Client(base_url=base, timeout=60)
        self.kept: dict[str, bytes] = {}

    def set_up(self, heliostats: int = 1) -> list[str]:
        """A plant with some heliostats; their names."""
        assert self.http.put("/v1/plant", json=tower_document()).status_code == 200
        names = [f"H{number}" for number in range(heliostats)]
        for name in names:
            assert self.http.put(f"/v1/heliostats/{name}", json=properties_document()).status_code == 201
        return names

    def post(self, image: bytes, heliostat: str = "H0", **changes: Any) -> httpx.Response:
        answer = self.http.post(
            f"/v1/heliostats/{heliostat}/measurements",
            files={"image": ("spot.png", image, "image/png")},
            data={"metadata": json.dumps(metadata(**changes))},
        )
        if answer.status_code in (200, 201):
            self.kept[f"{heliostat}/{answer.json()['id']}"] = image
        return answer

    def require_kept(self) -> int:
        """Every photograph that was acknowledged is there, byte for byte; how many there are."""
        for key, image in self.kept.items():
            heliostat, identifier = key.split("/")
            answer = self.http.get(f"/v1/heliostats/{heliostat}/measurements/{identifier}/image")
            assert answer.status_code == 200, f"{key} was acknowledged and is lost: {answer.text}"
            assert answer.content == image, f"{key} is altered"
            flux = self.http.get(f"/v1/heliostats/{heliostat}/measurements/{identifier}/flux")
            assert flux.status_code == 200, f"the flux of {key} is lost: {flux.text}"
        return len(self.kept)

    def measurements(self, heliostat: str = "H0") -> list[str]:
        """Ids of all measurements."""
        found: list[str] = []
        after: str | None = None
        while True:
            query = {"limit": "500"} | ({} if after is None else {"after": after})
            page = self.http.get(f"/v1/heliostats/{heliostat}/measurements", params=query).json()
            found += [item["id"] for item in page["items"]]
            if (after := page["next"]) is None:
                return found


class Proxy:
    """A TCP relay to PostgreSQL that can be cut, with all connections through it, and mended."""

    def __init__(self, host: str, port: int) -> None:
        self._target = (host, port)
        self.port = free_port()
        self._open: list[socket.socket] = []
        self._listener: socket.socket | None = None
        self.mend()

    def mend(self) -> None:
        listener = socket.create_server(("127.0.0.1", self.port))
        self._listener = listener
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()

    def cut(self) -> None:
        assert self._listener is not None
        for one in (self._listener, *self._open):
            with suppress(OSError):  # it may have ended by itself
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._open.clear()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            server = socket.create_connection(self._target)
            self._open += [client, server]
            for pair in ((client, server), (server, client)):
                threading.Thread(target=self._relay, args=pair, daemon=True).start()

    @staticmethod
    def _relay(source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
        except OSError:  # cut
            return
