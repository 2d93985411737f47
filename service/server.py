"""Running the service: what the command line's ``serve`` and ``migrate`` call."""

import threading
from types import FrameType

import uvicorn

from model.errors import InvalidInputError
from service import logs, telemetry
from service.app import create_app
from service.database import Database
from service.faults import NotStartedError
from service.settings import Settings

# Seconds that requests under way get to finish when the service is told to stop.
_GRACE_S = 30
# Seconds that an idle connection stays open: longer than clients and proxies usually keep one for their next request.
_KEEP_ALIVE_S = 75


class _Server(uvicorn.Server):
    """Ends streams without an end when it is told to stop, instead of waiting for their readers."""

    def __init__(self, config: uvicorn.Config, stopping: threading.Event) -> None:
        super().__init__(config)
        self._stopping = stopping

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """On SIGTERM or SIGINT."""
        self._stopping.set()
        super().handle_exit(sig, frame)


def serve(settings: Settings) -> None:
    """Run the service until it is told to stop; an embedded SQLite store is migrated first.

    Raises
    ------
    NotStartedError
        Where the store or the door keeps it from starting.
    """
    logs.set_up(settings)
    telemetry.set_up(settings, "heliotwin")
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,  # ours above
        access_log=False,  # service.middleware writes one with request ids
        server_header=False,
        timeout_graceful_shutdown=_GRACE_S,
        timeout_keep_alive=_KEEP_ALIVE_S,
    )
    server = _Server(config, app.state.stopping)
    try:
        server.run()
    except SystemExit as refusal:  # uvicorn's way to say that the application or the port failed
        raise NotStartedError("the service could not start; the log above says why") from refusal


def migrate(settings: Settings, to: str = "head") -> str:
    """Bring the store's schema to its newest version, or back to an older one, and return that version.

    Raises
    ------
    InvalidInputError
        Where this version knows no such revision.
    """
    database = Database(settings.database)
    try:
        known = database.revisions()
        if to not in (*known, "head"):
            raise InvalidInputError(f"--to {to}: must be head or one of {', '.join(known)}")
        is_back = to != "head" and database.revision() in known[known.index(to) :]
        (database.downgrade if is_back else database.upgrade)(to)
        return database.revision() or "base"
    finally:
        database.close()
