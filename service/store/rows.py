"""How rows are written: insert, insert or find, change. All writers are idempotent, also when two of them race."""

from collections.abc import Callable
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from sqlalchemy import inspect, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session, make_transient_to_detached
from sqlalchemy.orm.attributes import set_committed_value

from service.store.columns import Base
from service.store.tables import HeliostatRow, ReceiverRow, TargetRow

# The statement that knows ON CONFLICT DO NOTHING, by dialect.
_INSERTS: dict[str, Callable[..., Any]] = {"postgresql": postgresql.insert, "sqlite": sqlite.insert}

# Rounds that a writer takes against others who write the same thing before it gives up.
ROUNDS = 8
Named = TypeVar("Named", HeliostatRow, TargetRow, ReceiverRow)


class Change(StrEnum):
    """What a write did."""

    NEW = "new"
    CHANGED = "changed"
    UNCHANGED = "unchanged"


def insert(session: Session, row: Base) -> bool:
    """Insert ``row`` unless a unique constraint forbids it; False where another writer was first.

    Relationships are not written: set them on the row afterwards.

    Raises
    ------
    IntegrityError
        SQLAlchemy's, where something else forbids it: a CHECK or a foreign key is a fault of ours, and no other
        writer's.
    """
    state, table = inspect(row), type(row).__table__
    assert not state.mapper.relationships.keys() & state.dict.keys(), "set relationships after the insert"
    given = {column.name: state.dict[column.name] for column in table.columns if column.name in state.dict}
    made = [column for column in table.columns if column.primary_key or column.name not in given]
    begun = _INSERTS[session.get_bind().dialect.name](table).values(given)
    written = session.execute(begun.on_conflict_do_nothing().returning(*made)).one_or_none()
    if written is None:
        return False
    for column, value in zip(made, written, strict=True):
        set_committed_value(row, column.name, value)
    make_transient_to_detached(row)  # it is what the database holds now, and the session's like any row that was read
    session.add(row)
    return True


def insert_or_find(session: Session, row: Named) -> tuple[Named, bool]:
    """``row``, inserted, or the one that has its name already; the second value is True where it is new."""
    table = type(row)
    query = select(table).where(table.name == row.name)
    held = session.scalar(query)
    if held is None and insert(session, row):
        return row, True
    return held or session.scalars(query).one(), False


def assign(row: Base, values: dict[str, Any]) -> Change:
    """Give a row these values; whether that changed it."""
    changed = {name: value for name, value in values.items() if getattr(row, name) != value}
    for name, value in changed.items():
        setattr(row, name, value)
    return Change.CHANGED if changed else Change.UNCHANGED


def floats(values: ArrayLike) -> list[float]:
    """Numbers as JSON columns hold them."""
    return [float(value) for value in np.asarray(values)]
