"""Helpers for commands on the store: sessions, the actor, and private file permissions."""

import getpass
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from model.errors import InvalidInputError

if TYPE_CHECKING:
    from sqlalchemy.orm import Session


def keep_private() -> None:
    """Let only this user read what the process writes from now on: 0600 for files, 0700 for
    folders.

    The store holds hashes of keys, photographs and positions, and so does a backup.
    """
    os.umask(0o077)


def require_reason(reason: str) -> None:
    """Require a reason that fits the store; InvalidInputError else."""
    if not 1 <= len(reason) <= 200:
        raise InvalidInputError("--reason must have 1 to 200 characters")


@contextmanager
def writing(makes: bool = False) -> Iterator["Session"]:
    """Write session on the store of the settings; an embedded store is migrated first.

    If ``makes`` is true, a missing embedded store is created.

    Raises
    ------
    InvalidInputError
        If there is no store, and ``makes`` is false.
    """
    from service.base.settings import Settings
    from service.store.database import Database, require_store

    keep_private()
    settings = Settings()
    if not makes:
        require_store(settings)
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database)
    try:
        if settings.migrates_on_start:
            database.upgrade()
        database.require_current()
        with database.changing() as session:
            yield session
    finally:
        database.close()


@contextmanager
def reading() -> Iterator["Session | None"]:
    """Read session on the store of the settings, without write lock or migration.

    Yields None if an embedded store does not exist yet.

    Raises
    ------
    SchemaError
        If the store needs a migration.
    """
    from service.base.settings import Settings
    from service.store.database import Database

    settings = Settings()
    file = settings.database.database
    if settings.database.get_backend_name() == "sqlite" and not (file and Path(file).is_file()):
        yield None
        return
    database = Database(settings.database)
    try:
        database.require_current()
        with database.reading() as session:
            yield session
    finally:
        database.close()


def actor() -> str:
    """Name of the user in the audit trail."""
    try:
        return f"cli {getpass.getuser()}"[:64]
    except (KeyError, OSError):  # a container's user may have no name
        return "cli"
