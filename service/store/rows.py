"""Rows: written by insert, insert or find, and update, and converted to documents.

All writers are idempotent, even in parallel. Documents have all columns except keys and bytes, with
checked types.
"""

from collections.abc import Callable
from datetime import datetime
from enum import StrEnum
from types import GenericAlias, NoneType, UnionType
from typing import Annotated, Any, Generic, NamedTuple, TypeVar, get_args, get_type_hints

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, FailFast, Field, create_model
from sqlalchemy import ColumnElement, LargeBinary, String, func, inspect, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session, make_transient_to_detached
from sqlalchemy.orm.attributes import set_committed_value

from service.base.errors import NotFoundError
from service.base.fields import Moment
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


def record(table: type[Base], without: tuple[str, ...] = (), **more: Any) -> Any:
    """Create the pydantic model for the documents of a table's rows.

    `service.base.fields.from_row` makes a document from a row; ``model_dump`` gives the columns.

    Parameters
    ----------
    table
        The table. Arrays, keys that only this database knows, and computed columns are left out.
    without
        Further columns to leave out.
    more
        Additional fields, each a type and a default as in `pydantic.create_model`.
    """
    hints: dict[str, object] = get_type_hints(table)
    fields: dict[str, object] = {}
    for column in inspect(table).columns:
        is_key = column.key == "id" or any(key.column.name == "id" for key in column.foreign_keys)
        if (
            not is_key
            and column.computed is None
            and column.key not in without
            and not isinstance(column.type, LargeBinary)
        ):
            (kind,) = get_args(hints[column.key])
            fields[column.key] = (_bounded(kind, column), None if column.nullable else ...)
    config = ConfigDict(extra="forbid", allow_inf_nan=False)
    return create_model(table.__name__, __config__=config, **{**fields, **more})


def many(document: Any) -> Any:
    """Return the type of a list of documents; validation ends at the first that is wrong, for a
    list may be long.
    """
    return Annotated[GenericAlias(list, document), FailFast()]


def _bounded(kind: Any, column: ColumnElement[Any]) -> Any:
    """A column's type with the database's limits: time zones, text lengths, integer ranges."""
    if isinstance(kind, UnionType):
        (inner,) = set(get_args(kind)) - {NoneType}
        return _bounded(inner, column) | None
    if kind is datetime:
        return Moment
    if kind is int:
        return Annotated[int, Field(ge=-(2**31), lt=2**31)]
    if kind is str and isinstance(column.type, String) and column.type.length:
        return Annotated[str, Field(max_length=column.type.length)]
    return kind
