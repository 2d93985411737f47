"""What commands on the store share: a session and who acts."""

import getpass
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sqlalchemy.orm import Session


@contextmanager
def writing() -> Iterator["Session"]:
    """The store that the settings name; an embedded one is made and migrated first."""
    from service.base.settings import Settings
    from service.store.database import Database

    settings = Settings()
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database)
    try:
        if settings.migrates_on_start:
            database.upgrade()
        database.require_current()
        with database.writing() as session:
            yield session
    finally:
        database.close()


@contextmanager
def reading() -> Iterator["Session | None"]:
    """The store that the settings name, to look at: without the write lock, and as it is.

    None where an embedded one was not made yet.

    Raises
    ------
    SchemaError
        Where it waits for a migration.
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
    """Who stands in the audit trail."""
    try:
        return f"cli {getpass.getuser()}"[:64]
    except (KeyError, OSError):  # a container's user may have no name
        return "cli"
