"""Running the service: what the command line's ``serve`` and ``migrate`` call."""

import logging

import uvicorn

from service.app import create_app
from service.database import Database
from service.settings import Settings

_FORMAT = "%(asctime)s %(levelname)s %(name)s %(message)s"
# Seconds that requests under way get to finish when the service is told to stop.
_GRACE_S = 30
# Seconds that an idle connection stays open: longer than clients and proxies usually keep one for their next request.
_KEEP_ALIVE_S = 75


def serve(settings: Settings) -> None:
    """Run the service until it is told to stop; an embedded SQLite store is migrated first."""
    logging.basicConfig(level=settings.log_level.upper(), format=_FORMAT)
    uvicorn.run(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        log_config=None,  # ours above
        access_log=False,  # service.middleware writes one with request ids
        server_header=False,
        timeout_graceful_shutdown=_GRACE_S,
        timeout_keep_alive=_KEEP_ALIVE_S,
    )


def migrate(settings: Settings) -> str:
    """Bring the store's schema to its newest version and return that version."""
    database = Database(settings.database)
    try:
        database.upgrade()
        return database.revision() or "base"
    finally:
        database.close()
