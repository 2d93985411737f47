"""Running the service: what the command line's ``serve`` and ``migrate`` call."""

import socket
import threading
from collections.abc import Callable
from types import FrameType

import uvicorn
from fastapi import FastAPI

from service.base import logs, memory, telemetry
from service.base.faults import NotStartedError
from service.base.settings import Settings
from service.store.database import Database
from service.web.app import create_app, require_fit
from service.web.door.connections import protocol_of

# Seconds that answers which have begun get to be sent when the service is told to stop; all others are answered before
# (`service.web.middleware.StoppingMiddleware`). Jobs get 20 s after that, and supervisors usually wait 30 to 40.
_GRACE_S = 10

# Seconds that an idle connection stays open: longer than clients and proxies usually keep one for their next request.
_KEEP_ALIVE_S = 75

# Most bytes of a request's head.
_MOST_HEAD_BYTES = 32 * 1024


class _Server(uvicorn.Server):
    """Says when it listens, and when it is told to stop, so that answers without an end end."""

    def __init__(self, config: uvicorn.Config, stopping: threading.Event, on_listening: Callable[[], None]) -> None:
        super().__init__(config)
        self._stopping = stopping
        self._on_listening = on_listening

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """The application's start, then the port's."""
        await super().startup(sockets)
        self._on_listening()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """On SIGTERM or SIGINT."""
        self._stopping.set()
        super().handle_exit(sig, frame)


def serve(settings: Settings, on_listening: Callable[[], None] = lambda: None) -> None:
    """Run the service until it is told to stop; an embedded SQLite store is migrated first.

    ``on_listening`` is called once nothing keeps it from answering any more.

    Raises
    ------
    NotStartedError
        Where the port keeps it from starting.
    SchemaError, OpenDoorError
        Where the store or the door do.
    """
    memory.limit()
    logs.set_up(settings)
    telemetry.set_up(settings, "heliotwin")
    _require_fit(settings)
    app = create_app(settings)
    config = config_of(settings, app)
    server = _Server(config, app.state.stopping, on_listening)
    try:
        server.run()
    except SystemExit as refusal:  # uvicorn's way to say that the application or the port failed
        raise NotStartedError("the service could not start; the log above says why") from refusal


def config_of(settings: Settings, app: FastAPI) -> uvicorn.Config:
    """How uvicorn serves.

    It answers 503 by itself beyond ``limit_concurrency`` connections or requests, and bounds a request's head by its
    bytes; connections without a request count, too. What it has no options for `protocol_of` has. Who sends a request,
    and whether it came encrypted, is what a proxy says in X-Forwarded-For and -Proto where the settings trust it, and
    nobody else; the variable FORWARDED_ALLOW_IPS, which uvicorn would read by itself, means nothing here.
    """
    return uvicorn.Config(
        app,
        http=protocol_of(settings),
        proxy_headers=settings.proxy_headers,
        forwarded_allow_ips=settings.forwarded_allow_ips,
        limit_concurrency=settings.most_connections,
        h11_max_incomplete_event_size=_MOST_HEAD_BYTES,
        host=settings.host,
        port=settings.port,
        log_config=None,  # ours above
        access_log=False,  # service.web.middleware writes one with request ids
        server_header=False,
        timeout_graceful_shutdown=_GRACE_S,
        timeout_keep_alive=_KEEP_ALIVE_S,
    )


def _require_fit(settings: Settings) -> None:
    """`require_fit`, before the server: what it raises inside of that is buried in a traceback."""
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database)
    try:
        require_fit(settings, database)
    finally:
        database.close()
