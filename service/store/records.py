"""Conversion of rows to documents: all columns except keys and bytes, with checked types."""

from datetime import datetime
from types import GenericAlias, NoneType, UnionType
from typing import Annotated, Any, get_args, get_type_hints

from pydantic import ConfigDict, FailFast, Field, create_model
from sqlalchemy import ColumnElement, LargeBinary, String, inspect

from service.base.fields import Moment
from service.store.columns import Base


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
