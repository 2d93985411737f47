"""Column types that all tables share: UTC times, JSON, and names of constraints."""

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import JSON, CheckConstraint, DateTime, Dialect, MetaData, TypeDecorator
from sqlalchemy.orm import DeclarativeBase

_NAMING = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}

# A missing JSON value is SQL's NULL, not the JSON text "null".
_Json = JSON(none_as_null=True)

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
"""Placeholder for an unknown start time."""


def one_of(column: str, values: tuple[str, ...]) -> CheckConstraint:
    """Constrain a column to these values."""
    return CheckConstraint(
        f"{column} IN ({', '.join(repr(value) for value in values)})", name=column
    )


class UtcDateTime(TypeDecorator[datetime]):
    """A time in UTC. SQLite stores no time zone, so it is restored when a value is read."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Convert to UTC. A time without a zone is a programming error."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("a stored moment needs a time zone")
        return value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Restore the time zone."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def now() -> datetime:
    """The current time in UTC."""
    return datetime.now(UTC)


class Base(DeclarativeBase):
    """Base class of all tables, with constraint names that migrations can refer to."""

    metadata = MetaData(naming_convention=_NAMING)
    type_annotation_map = {  # noqa: RUF012
        datetime: UtcDateTime,
        dict[str, Any]: _Json,
        dict[str, object]: _Json,
        dict[str, float]: _Json,
        dict[str, list[float]]: _Json,
        dict[str, str]: _Json,
        list[dict[str, Any]]: _Json,
        list[dict[str, object]]: _Json,
        list[float]: _Json,
        list[list[float]]: _Json,
        list[int]: _Json,
        list[str]: _Json,
    }
