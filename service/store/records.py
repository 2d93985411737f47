"""Rows as documents, and documents as rows: every column but keys and bytes, each checked by its type on the way in."""

from datetime import datetime
from types import GenericAlias, UnionType
from typing import Any, get_args, get_type_hints

from pydantic import AwareDatetime, ConfigDict, create_model
from sqlalchemy import LargeBinary, inspect

from service.store.columns import Base


def record(table: type[Base], without: tuple[str, ...] = (), **more: Any) -> Any:
    """The documents of a table's rows, a pydantic model: `read` makes one of a row, its ``model_dump`` the columns.

    ``without`` are columns that it leaves out, beside arrays, keys that only this database knows, and what it works
    out; ``more`` are fields that it has beside them, each its type and default as `pydantic.create_model` takes them.
    """
    hints: dict[str, Any] = get_type_hints(table)
    fields: dict[str, Any] = {}
    for column in inspect(table).columns:
        is_key = column.key == "id" or any(key.column.name == "id" for key in column.foreign_keys)
        if (
            not is_key
            and column.computed is None
            and column.key not in without
            and not isinstance(column.type, LargeBinary)
        ):
            (kind,) = get_args(hints[column.key])
            fields[column.key] = (_aware(kind), None if column.nullable else ...)
    return create_model(table.__name__, __config__=ConfigDict(extra="forbid"), **{**fields, **more})


def many(document: Any) -> Any:
    """The type of a list of documents."""
    return GenericAlias(list, document)


def _aware(kind: Any) -> Any:
    """Moments have a zone, as columns demand."""
    if kind is datetime:
        return AwareDatetime
    return AwareDatetime | None if isinstance(kind, UnionType) and datetime in get_args(kind) else kind


def read(document: Any, row: Base, **more: Any) -> Any:
    """The document of a row, with what it has ``more``."""
    columns = {name: getattr(row, name) for name in document.model_fields if name not in more}
    return document.model_validate({**columns, **more})
