"""Run the web service, for the command ``serve``."""

import socket
import threading
from collections.abc import Callable
from types import FrameType

import uvicorn
from fastapi import FastAPI

from service.base import monitoring, processes
from service.base.errors import NotStartedError
from service.base.settings import Settings
from service.store.database import Database
from service.web.app import create_app, require_fit
from service.web.auth.connections import protocol_of

# Time to finish responses that have begun, after the signal to stop [s].
# `service.web.middleware.StoppingMiddleware` answers all other requests before. Jobs get another 20
# s. Process supervisors usually wait 30 to 40 s.
_GRACE_S = 10

# Time that an idle connection stays open [s]. Clients and proxies usually keep one for less.
_KEEP_ALIVE_S = 75

# Largest head of a request [bytes].
_MAX_HEAD_BYTES = 32 * 1024


class _Server(uvicorn.Server):
    """Server that reports when it listens, and sets ``stopping`` when it must stop.

    Responses without an end use ``stopping`` to end.
    """

    def __init__(
        self, config: uvicorn.Config, stopping: threading.Event, on_listening: Callable[[], None]
    ) -> None:
        super().__init__(config)
        self._stopping = stopping
        self._on_listening = on_listening

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application, then listen."""
        await super().startup(sockets)
        self._on_listening()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle SIGTERM or SIGINT."""
        self._stopping.set()
        super().handle_exit(sig, frame)


def serve(settings: Settings, on_listening: Callable[[], None] = lambda: None) -> None:
    """Run the service until a signal stops it. An embedded SQLite store is migrated first.

    ``on_listening`` is called when the service can answer requests.

    Raises
    ------
    NotStartedError
        If the port or the application prevents the start.
    SchemaError, UnauthenticatedExposureError
        From `require_fit`.
    """
    processes.limit_memory()
    monitoring.configure_logging(settings)
    monitoring.configure_tracing(settings, "heliotwin")
    _require_fit(settings)
    app = create_app(settings)
    config = config_of(settings, app)
    server = _Server(config, app.state.stopping, on_listening)
    try:
        with processes.returning_memory():
            server.run()
    except SystemExit as refusal:  # uvicorn exits this way if the application or the port failed
        raise NotStartedError("the service could not start; the log above says why") from refusal


def config_of(settings: Settings, app: FastAPI) -> uvicorn.Config:
    """The configuration of uvicorn.

    uvicorn answers 503 above ``limit_concurrency`` connections or requests. Connections without a
    request count, too. It limits the head of a request by its bytes. `protocol_of` adds the limits
    that uvicorn lacks.

    The client address and the scheme come from X-Forwarded-For and X-Forwarded-Proto only if the
    settings trust the proxy. The environment variable FORWARDED_ALLOW_IPS, which uvicorn would
    read, has no effect.
    """
    return uvicorn.Config(
        app,
        http=protocol_of(settings),
        proxy_headers=settings.proxy_headers,
        forwarded_allow_ips=settings.forwarded_allow_ips,
        limit_concurrency=settings.max_connections,
        h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
        host=settings.host,
        port=settings.port,
        log_config=None,  # configured above
        access_log=False,  # service.web.middleware logs requests with their ids
        server_header=False,
        timeout_graceful_shutdown=_GRACE_S,
        timeout_keep_alive=_KEEP_ALIVE_S,
    )


def _require_fit(settings: Settings) -> None:
    """Call `require_fit` before the server starts, which would hide its error in a traceback."""
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database)
    try:
        require_fit(settings, database)
    finally:
        database.close()
