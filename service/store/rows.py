"""Writing rows: insert, insert or find, update. All writers are idempotent, even in parallel."""

from collections.abc import Callable
from enum import StrEnum
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from sqlalchemy import func, inspect, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session, make_transient_to_detached
from sqlalchemy.orm.attributes import set_committed_value

from service.base.errors import NotFoundError
from service.store.columns import Base
from service.store.tables import HeliostatRow, ReceiverRow, TargetRow

# The INSERT with ON CONFLICT, by dialect.
_INSERTS: dict[str, Callable[..., Any]] = {"postgresql": postgresql.insert, "sqlite": sqlite.insert}

# Attempts of a writer that competes with others before it fails.
ROUNDS = 8

# Key of PostgreSQL's advisory lock in `serialize_writers`. Any constant will do.
_CHANGES = 0x68656C69
Named = TypeVar("Named", HeliostatRow, TargetRow, ReceiverRow)
Row = TypeVar("Row", bound=Base)


class Change(StrEnum):
    """The effect of a write."""

    NEW = "new"
    CHANGED = "changed"
    UNCHANGED = "unchanged"


class Added(NamedTuple, Generic[Row]):
    """A row that is new, or that existed already."""

    row: Row
    is_new: bool


class Put(NamedTuple, Generic[Row]):
    """A row, and how it was changed."""

    row: Row
    change: Change


def serialize_writers(session: Session) -> None:
    """Wait for other changes (`Database.run_in_transaction`), and block them until the transaction
    ends. SQLite has only one writer anyway.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(select(func.pg_advisory_xact_lock(_CHANGES)))


def lock_row(session: Session, table: type[Base], number: int, name: str) -> None:
    """Prevent the deletion of a row that was read in an earlier transaction.

    Raises
    ------
    NotFoundError
        If it was deleted since; the message names it as ``name``.
    """
    key = inspect(table).primary_key[0]
    query = select(key).where(key == number).with_for_update(read=True, key_share=True)
    if session.scalar(query) is None:
        raise NotFoundError(f"{name} was deleted in the meantime")


def lock_heliostat(session: Session, row: HeliostatRow) -> None:
    """Wait for other writers of a heliostat's photographs and surfaces, and block them.

    Lock it before reading what the transaction decides on. Rows that only refer to the heliostat
    do not wait.

    Raises
    ------
    NotFoundError
        If it was deleted since it was read.
    """
    query = select(HeliostatRow.id).where(HeliostatRow.id == row.id)
    if session.scalar(query.with_for_update(key_share=True)) is None:
        raise NotFoundError(f"heliostat {row.name} was deleted in the meantime")


def inserting(session: Session, table: type[Base]) -> Any:
    """The INSERT statement with ON CONFLICT for the session's database."""
    return _INSERTS[session.get_bind().dialect.name](table)


def insert(session: Session, row: Base) -> bool:
    """Insert ``row`` unless a unique constraint forbids it; False if another writer was first.

    Relationships are not written: set them on the row afterwards.

    Raises
    ------
    IntegrityError
        SQLAlchemy's, for a failed CHECK or foreign key. It means a programming error.
    """
    state, table = inspect(row), type(row).__table__
    assert not state.mapper.relationships.keys() & state.dict.keys(), (
        "set relationships after the insert"
    )
    values = {
        column.name: state.dict[column.name]
        for column in table.columns
        if column.name in state.dict
    }
    missing = [
        column for column in table.columns if column.primary_key or column.name not in values
    ]
    statement = inserting(session, type(row)).values(values)
    found = session.execute(statement.on_conflict_do_nothing().returning(*missing)).one_or_none()
    if found is None:
        return False
    for column, value in zip(missing, found, strict=True):
        set_committed_value(row, column.name, value)
    # The row now equals the database's, and belongs to the session like any row that was read.
    make_transient_to_detached(row)
    session.add(row)
    return True


def insert_or_find(session: Session, row: Named) -> Added[Named]:
    """Insert ``row``, or find the row with its name."""
    table = type(row)
    query = select(table).where(table.name == row.name)
    existing = session.scalar(query)
    if existing is None and insert(session, row):
        return Added(row, True)
    return Added(existing or session.scalars(query).one(), False)


def assign(row: Base, values: dict[str, object]) -> Change:
    """Assign values to a row, and return whether they changed it."""
    changed = {name: value for name, value in values.items() if getattr(row, name) != value}
    for name, value in changed.items():
        setattr(row, name, value)
    return Change.CHANGED if changed else Change.UNCHANGED


def floats(values: ArrayLike) -> list[float]:
    """Convert numbers to a list for a JSON column."""
    return [float(value) for value in np.asarray(values)]
