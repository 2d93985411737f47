"""A store and its database, processes on it that can be killed, and a client that remembers what it
was promised.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import httpx
import psycopg
from sqlalchemy import make_url

from service.base.settings import Settings
from service.store.backup import images_of
from service.store.check import StoreReport, inspect_store
from service.store.database import Database
from tests.forked import ForkedProcess, forked_process
from tests.service.conftest import (
    POSTGRES,
    free_port,
    metadata,
    properties_document,
    tower_document,
)
from tests.waiting import WAIT_LIMIT_S, child_process, until

from .process import run

ROOT = Path(__file__).parents[2]


@dataclass
class Store:
    """Where a store lies; ``url`` names its database, None for SQLite inside of ``folder``."""

    folder: Path
    url: str | None
    environment: dict[str, str] = field(default_factory=dict)

    @property
    def settings(self) -> Settings:
        return Settings(data_dir=self.folder, database_url=self.url)

    def check(self) -> StoreReport:
        """What `heliotwin check` finds."""
        database = Database(self.settings.database)
        try:
            return inspect_store(database, images_of(self.settings), lambda _: None)
        finally:
            database.close()


@contextmanager
def postgres_database() -> Iterator[str]:
    """The URL of a separate database, dropped at the end."""
    name = f"heliotwin_fault_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(POSTGRES, autocommit=True, connect_timeout=60) as connection:
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
    """A service, or a worker, on a store, from `__enter__` on; `kill` ends it by SIGKILL.

    ``module`` is what ``python -m`` runs; without it, a copy of `tests.faults.process` runs, which
    starts in a fraction of a second.
    """

    def __init__(
        self,
        store: Store,
        what: str = "serve",
        module: str | None = None,
        port: int | None = None,
        start_limit_s: float = WAIT_LIMIT_S,
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
            "HELIOTWIN_JOB_LEASE_S": "5",
            "HELIOTWIN_JOB_POLL_S": "0.1",
            # A worker that a busy machine keeps from renewing its lease loses an attempt, and
            # nothing else.
            "HELIOTWIN_JOB_ATTEMPTS": "20",
            "HELIOTWIN_REQUESTS_PER_S": "1000000",
            "HELIOTWIN_REQUESTS_BURST": "1000000",
            "HELIOTWIN_PUBLIC_REQUESTS_PER_S": "1000000",
            "HELIOTWIN_PUBLIC_REQUESTS_BURST": "1000000",
            "HELIOTWIN_LOG_LEVEL": "error",
        }
        self._command = [sys.executable, "-m", module, what] if module else None
        self._environment = os.environ | settings | store.environment | environment
        self._what = what
        self._start_limit_s = start_limit_s
        self._held = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as starting:  # a service that does not come up leaves no process behind
            self._process = starting.enter_context(self._start())
            if self._what == "serve":
                until(self.is_alive, "the service answers", self._start_limit_s)
            self._held = starting.pop_all()
        return self

    def _start(self) -> AbstractContextManager[subprocess.Popen[Any] | ForkedProcess]:
        if self._command is None:
            return forked_process(run, self._environment, self._what)
        options = {"cwd": ROOT, "env": self._environment, "stderr": subprocess.DEVNULL}
        return child_process(self._command, **options)

    def __exit__(self, *_: object) -> None:
        with self._held:
            self.end(signal.SIGTERM)

    def client(self) -> "Client":
        """A client of this service, closed with it."""
        client = Client(self.base)
        self._held.enter_context(client.http)
        return client

    def is_alive(self) -> bool:
        assert self._process.poll() is None, "the process ended by itself"
        try:
            return httpx.get(f"{self.base}/livez", timeout=60).status_code == 200
        except httpx.TransportError:
            return False

    @property
    def has_ended(self) -> bool:
        """Whether the process is over, and was waited for."""
        return self._process.returncode is not None

    @property
    def number(self) -> int:
        """Of the process."""
        return self._process.pid

    def kill(self) -> None:
        self.end(signal.SIGKILL)

    def end(self, number: int) -> None:
        if self._process.poll() is None:
            self._process.send_signal(number)
        self._process.wait(WAIT_LIMIT_S)


class Client:
    """Posts photographs and remembers those that were acknowledged, by the measurement's id."""

    def __init__(self, base: str) -> None:
        self.http = httpx.Client(base_url=base, timeout=WAIT_LIMIT_S)
        self.kept: dict[str, bytes] = {}

    def set_up(self, heliostats: int = 1) -> list[str]:
        """A plant with some heliostats; their names."""
        assert self.http.put("/v1/plant", json=tower_document()).status_code == 200
        names = [f"H{number}" for number in range(heliostats)]
        for name in names:
            assert (
                self.http.put(f"/v1/heliostats/{name}", json=properties_document()).status_code
                == 201
            )
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
