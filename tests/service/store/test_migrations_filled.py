"""Migrations on a database with rows in every table: from each revision to the newest, and back again."""

from datetime import UTC, datetime
from typing import Any

import pytest
from alembic.script import ScriptDirectory
from sqlalchemy import URL, Column, MetaData, Table, insert, inspect, select
from sqlalchemy.types import JSON, Boolean, DateTime, Float, Integer, LargeBinary

from service.store.columns import Base
from service.store.database import Database, alembic_config

REVISIONS = [script.revision for script in ScriptDirectory.from_config(alembic_config()).walk_revisions()][::-1]

# Columns that take certain values only.
_CHOSEN: dict[str, Any] = {
    "kind": "flux",
    "source": "refined",
    "state": "done",
    "role": "read",
    "verdict": "effect",
    "model_version": "1:none",
    "pruned_for": "age",
}
_TYPES = (
    (JSON, {"a": [1.5, None, "é"]}),
    (Boolean, True),
    (DateTime, datetime(2024, 6, 1, 12, tzinfo=UTC)),
    (Integer, 1),
    (Float, 1.5),
    (LargeBinary, b"\x00\xff"),
)


def _value(column: Column[Any]) -> Any:
    if column.name in _CHOSEN:
        return _CHOSEN[column.name]
    return next((value for kind, value in _TYPES if isinstance(column.type, kind)), "x")


def _tables(database: Database) -> list[Table]:
    reflected = MetaData()
    reflected.reflect(database.engine)
    return [table for table in reflected.sorted_tables if table.name != "alembic_version"]


def _fill(database: Database) -> None:
    with database.engine.execution_options(writes=True).begin() as connection:
        for table in _tables(database):
            values = {column.name: _value(column) for column in table.columns if column.computed is None}
            if table.name == "heliostats":  # one beside, for numbers that go on
                connection.execute(insert(table).values({**values, "id": 7, "name": "y"}))
            connection.execute(insert(table).values(values))


def _rows(database: Database, columns: dict[str, list[str]]) -> dict[str, Any]:
    """What these columns of these tables hold."""
    tables = {table.name: table for table in _tables(database)}
    with database.engine.connect() as connection:
        return {
            name: [tuple(row) for row in connection.execute(select(*(tables[name].c[c] for c in names)))]
            for name, names in columns.items()
        }


def _columns(database: Database) -> dict[str, list[str]]:
    return {table.name: [column.name for column in table.columns] for table in _tables(database)}


@pytest.mark.parametrize("revision", REVISIONS)
def test_rows_survive_the_way_up_and_down(empty_url: URL, revision: str):
    database = Database(empty_url)
    database.upgrade(revision)
    _fill(database)
    columns = _columns(database)
    before = _rows(database, columns)
    assert all(before.values())
    database.upgrade()
    assert set(_columns(database)) == set(Base.metadata.tables)
    assert _rows(database, columns) == before
    database.downgrade(revision)
    assert _columns(database) == columns
    assert _rows(database, columns) == before
    database.close()


def test_images_of_older_stores_get_verdict_and_totals(empty_url: URL):
    database = Database(empty_url)
    database.upgrade("0006")
    _fill(database)
    tables = {table.name: table for table in _tables(database)}
    with database.engine.execution_options(writes=True).begin() as connection:
        image = {c.name: _value(c) for c in tables["images"].columns} | {"sha256": "y", "size_bytes": 5}
        connection.execute(insert(tables["images"]).values(image))  # of no measurement, as a refused one
    database.upgrade()
    assert _rows(database, {"image_totals": ["accepted", "images", "size_bytes"]})["image_totals"] == [
        (False, 1, 5),
        (True, 1, 1),
    ]
    assert _rows(database, {"images": ["sha256", "accepted", "pruned_at"]})["images"] == [
        ("x", True, None),
        ("y", False, None),
    ]
    database.downgrade("base")
    database.close()


def test_downgrade_of_a_full_store_takes_what_older_versions_cannot_hold(empty_url: URL):
    """Tables of later revisions go; a model's version that is too long for the older column is cut off, not refused."""
    database = Database(empty_url)
    database.upgrade()
    _fill(database)
    tables = {table.name: table for table in _tables(database)}
    with database.engine.execution_options(writes=True).begin() as connection:
        connection.execute(tables["forecasts"].update().values(model_version="x" * 256))
    for revision in reversed(REVISIONS[:-1]):
        database.downgrade(revision)
        assert database.revision() == revision
    assert "jobs" not in inspect(database.engine).get_table_names()
    (row,) = _rows(database, {"forecasts": ["model_version"]})["forecasts"]
    assert set(row[0]) == {"x"}
    database.downgrade("base")
    database.close()
