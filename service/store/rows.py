"""How rows are written: insert, insert or find, change. All writers are idempotent, also when two of them race."""

from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.store.columns import Base
from service.store.tables import HeliostatRow, ReceiverRow, TargetRow

# Rounds that a writer takes against others who write the same thing before it gives up.
ROUNDS = 8
Named = TypeVar("Named", HeliostatRow, TargetRow, ReceiverRow)


class Change(StrEnum):
    """What a write did."""

    NEW = "new"
    CHANGED = "changed"
    UNCHANGED = "unchanged"


def insert(session: Session, row: Base) -> bool:
    """Insert ``row`` unless a unique constraint forbids it; False where another writer was first."""
    try:
        with session.begin_nested():
            session.add(row)
            session.flush()
    except IntegrityError:
        return False
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
