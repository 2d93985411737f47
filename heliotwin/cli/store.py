"""Helpers for commands on the store: sessions, the actor, and private file permissions."""

import getpass
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from model.errors import InvalidInputError

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.twin.runtime import Runtime


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
def writing() -> Iterator["Session"]:
    """Write session on the store of the settings; an embedded store is migrated first.

    Raises
    ------
    InvalidInputError
        If there is no store.
    """
    from service.base.settings import Settings
    from service.store.database import Database, require_store

    keep_private()
    settings = Settings()
    require_store(settings)
    with closing(Database(settings.database)) as database:
        if settings.migrates_on_start:
            database.upgrade()
        database.require_current()
        with database.changing() as session:
            yield session


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
    with closing(Database(settings.database)) as database:
        database.require_current()
        with database.reading() as session:
            yield session


@contextmanager
def open_runtime(is_new: bool = False) -> Iterator["Runtime"]:
    """Open the store of the settings with the model; one that ``is_new`` is made or migrated.

    Raises
    ------
    InvalidInputError
        If there is no store.
    """
    from service.base.settings import Settings
    from service.store.database import require_store
    from service.twin.runtime import Runtime

    settings = Settings()
    if not is_new:
        require_store(settings)
    with closing(Runtime.from_settings(settings)) as runtime:
        if is_new and settings.migrates_on_start:
            runtime.database.upgrade()
        runtime.database.require_current()
        yield runtime


def actor() -> str:
    """Name of the user in the audit trail."""
    try:
        return f"cli {getpass.getuser()}"[:64]
    except (KeyError, OSError):  # a container's user may have no name
        return "cli"
