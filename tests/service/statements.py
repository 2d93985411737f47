"""Statements that a database is sent."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import event

from service.store.database import Database


@contextmanager
def statements(database: Database) -> Iterator[list[str]]:
    """Those that are sent to the database meanwhile, but for the thread of the field's state."""
    sent: list[str] = []

    def note(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        is_of_field = threading.current_thread().name == "field-state"
        if not (is_of_field or statement.startswith(("BEGIN", "PRAGMA"))):
            sent.append(statement)

    event.listen(database.engine, "before_cursor_execute", note)
    try:
        yield sent
    finally:
        event.remove(database.engine, "before_cursor_execute", note)
