"""How rows are written: insert, insert or find, change. All writers are idempotent, also when two of them race."""

from collections.abc import Callable
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from sqlalchemy import func, inspect, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session, make_transient_to_detached
from sqlalchemy.orm.attributes import set_committed_value

from service.base.faults import NotFoundError
from service.store.columns import Base
from service.store.tables import HeliostatRow, ReceiverRow, TargetRow

# The statement that knows ON CONFLICT, by dialect.
_INSERTS: dict[str, Callable[..., Any]] = {"postgresql": postgresql.insert, "sqlite": sqlite.insert}

# Rounds that a writer takes against others who write the same thing before it gives up.
ROUNDS = 8
Named = TypeVar("Named", HeliostatRow, TargetRow, ReceiverRow)

# The number under which PostgreSQL keeps the lock of `one_at_a_time`: any, as long as it is always the same.
_PLANT_LOCK = 0x68656C69


class Change(StrEnum):
    """What a write did."""

    NEW = "new"
    CHANGED = "changed"
    UNCHANGED = "unchanged"


def one_at_a_time(session: Session) -> None:
    """Wait for whoever else changes what the plant is made of, and keep others waiting until the transaction ends.

    A name is one thing's among targets and receivers, which no constraint of a single table can hold; and who sets
    many things at once would meet another who sets them in another order. On SQLite a writer is alone anyway. The
    plant's row would not do as the lock: targets may be set before there is one.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(select(func.pg_advisory_xact_lock(_PLANT_LOCK)))


def hold(session: Session, table: type[Base], number: int, what: str) -> None:
    """Keep a row that was read in an earlier transaction from being deleted in this one.

    Raises
    ------
    NotFoundError
        Where it was deleted since; ``what`` names it.
    """
    key = inspect(table).primary_key[0]
    query = select(key).where(key == number).with_for_update(read=True, key_share=True)
    if session.scalar(query) is None:
        raise NotFoundError(f"{what} was deleted in the meantime")


def inserting(session: Session, table: type[Base]) -> Any:
    """The INSERT of the session's database, which knows ON CONFLICT."""
    return _INSERTS[session.get_bind().dialect.name](table)


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
    begun = inserting(session, type(row)).values(given)
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
