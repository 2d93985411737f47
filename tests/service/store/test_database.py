"""Migrations up, down and up again without drift, and transactions that wait their turn."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import URL, inspect, text
from sqlalchemy.exc import IntegrityError, StatementError

from service import store
from service.base.errors import SchemaError
from service.store.columns import Base
from service.store.database import Database
from service.store.tables import HeliostatRow
from tests.waiting import WAIT_LIMIT_S, child_process

ROOT = Path(__file__).parents[3]


def tables(database: Database) -> set[str]:
    return set(inspect(database.engine).get_table_names()) - {"alembic_version"}


def test_migrations_go_up_down_and_up_again(empty_url: URL):
    database = Database(empty_url)
    assert database.revision() is None
    assert not database.is_current()
    for _ in range(2):
        database.upgrade()
        assert database.is_current()
        assert tables(database) == set(Base.metadata.tables)
        database.downgrade("base")
        assert tables(database) == set()
    database.close()


def test_migrated_schema_is_the_mapped_one(database: Database):
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_server_default": True})
        assert compare_metadata(context, Base.metadata) == []


def checks(database: Database) -> set[tuple[str, str | None, str]]:
    """Table, name and text of each check; `compare_metadata` looks at none."""
    return {
        (table, check["name"], check["sqltext"])
        for table in Base.metadata.tables
        for check in inspect(database.engine).get_check_constraints(table)
    }


def partial_indexes(database: Database) -> set[tuple[str, str | None, str]]:
    """Table, name and condition of each index of some rows; it does not compare conditions."""
    return {
        (table, index["name"], str(index["dialect_options"][option]))
        for table in Base.metadata.tables
        for index in inspect(database.engine).get_indexes(table)
        for option in index.get("dialect_options", ())
        if option.endswith("_where")
    }


def test_migrated_conditions_are_the_mapped_ones(empty_url: URL):
    database = Database(empty_url)
    Base.metadata.create_all(database.engine)
    mapped = checks(database), partial_indexes(database)
    assert all(mapped)
    Base.metadata.drop_all(database.engine)
    database.upgrade()
    assert (checks(database), partial_indexes(database)) == mapped
    database.close()


def test_a_store_of_an_earlier_schema_is_left_alone(database: Database):
    current = database.revision()
    with database.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '0025'"))
    try:
        for refused in (database.upgrade, database.require_current, database.require_known):
            with pytest.raises(SchemaError, match=r"schema 0025, .*restore a back-up"):
                refused()
        assert database.revision() == "0025"
    finally:
        with database.writing() as session:
            session.execute(text("UPDATE alembic_version SET version_num = :it"), {"it": current})


@pytest.mark.full
def test_two_processes_migrate_at_once(empty_url: URL):
    environment = os.environ | {
        "HELIOTWIN_DATABASE_URL": empty_url.render_as_string(hide_password=False)
    }
    command = [sys.executable, "-m", "alembic", "upgrade", "head"]
    options = {"env": environment, "cwd": ROOT}
    with child_process(command, **options) as first, child_process(command, **options) as second:
        assert [process.wait(WAIT_LIMIT_S) for process in (first, second)] == [0, 0]
    database = Database(empty_url)
    assert database.is_current()
    database.close()


def test_foreign_keys_hold(database: Database):
    with pytest.raises(IntegrityError), database.writing() as session:
        session.execute(
            text("INSERT INTO surface_measurements (surface_id, measurement_id) VALUES (1, 1)")
        )


def test_values_are_checked_by_the_database(database: Database):
    found = {name for _, name, _ in checks(database)}
    columns = {
        "plant_single",
        "field_state_single",
        "measurements_kind",
        "surfaces_source",
        "studies_verdict",
        "jobs_state",
        "api_keys_role",
    }
    assert found == {f"ck_{column}" for column in columns} | {"ck_measurements_image"}


def test_moments_come_back_in_utc(database: Database):
    moment = datetime(2024, 6, 1, 14, tzinfo=timezone(timedelta(hours=2)))
    with database.writing() as session:
        session.add(
            HeliostatRow(name="A", properties={}, east_m=0, north_m=0, up_m=0, created_at=moment)
        )
    with database.reading() as session:
        found = store.get_heliostat(session, "A").created_at
    assert found == moment
    assert found.tzinfo is UTC


def test_moment_without_zone_is_refused(database: Database):
    row = HeliostatRow(
        name="A", properties={}, east_m=0, north_m=0, up_m=0, created_at=datetime(2024, 6, 1)
    )
    with pytest.raises(StatementError, match="time zone"), database.writing() as session:
        session.add(row)


def test_writers_wait_for_each_other(database: Database):
    """Read, then write, from several threads: no update is lost and none fails."""
    with database.writing() as session:
        session.add(HeliostatRow(name="A", properties={}, east_m=0, north_m=0, up_m=0))

    def count_up() -> None:
        for _ in range(5):
            with database.writing() as session:
                row = session.query(HeliostatRow).with_for_update().one()
                row.east_m += 1

    with ThreadPoolExecutor(6) as pool:
        for done in [pool.submit(count_up) for _ in range(6)]:
            done.result()
    with database.reading() as session:
        assert store.get_heliostat(session, "A").east_m == 30


def test_failed_write_leaves_nothing(database: Database):
    def fail() -> None:
        with database.writing() as session:
            store.put_heliostat(session, "A", {}, (0, 0, 0))
            raise RuntimeError("on purpose")

    with pytest.raises(RuntimeError):
        fail()
    with database.reading() as session:
        assert store.find_heliostat(session, "A") is None
