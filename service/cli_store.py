"""What commands on the store share: a session, who acts, and their ``--json``."""

import getpass
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
from sqlalchemy.orm import Session

AsJson = Annotated[bool, typer.Option("--json", help="Print as JSON on standard output.")]


@contextmanager
def writing() -> Iterator[Session]:
    """The store that the settings name; an embedded one is made and migrated first."""
    from service.database import Database
    from service.settings import Settings

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
