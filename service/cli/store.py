"""What commands on the store share: a session and who acts."""

import getpass
from collections.abc import Iterator
from contextlib import contextmanager
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


def actor() -> str:
    """Who stands in the audit trail."""
    try:
        return f"cli {getpass.getuser()}"[:64]
    except (KeyError, OSError):  # a container's user may have no name
        return "cli"
