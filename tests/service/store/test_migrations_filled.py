"""Migrations on a database with rows in every table: from each revision to the newest, and back
again.
"""

from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from alembic.script import ScriptDirectory
from sqlalchemy import URL, Column, MetaData, Table, insert, inspect, select
from sqlalchemy.types import JSON, Boolean, DateTime, Float, Integer, LargeBinary

from service.base.arrays import pack, unpack
from service.jobs.kinds.plans import map_name
from service.store.columns import Base
from service.store.database import Database, alembic_config
from service.store.jobs import queue

JOBS_BEFORE = "0016"
"""The newest revision that keeps the maps of a plan together."""

REVISIONS = [
    script.revision for script in ScriptDirectory.from_config(alembic_config()).walk_revisions()
][::-1]

# Columns that take certain values only.
_CHOSEN: dict[str, Any] = {
    "kind": "flux",
    "source": "refined",
    "state": "done",
    "role": "read",
    "verdict": "effect",
    "model_version": "1:none",
    "pruned_for": "age",
    "sun_azimuth_deg": 90.0,  # the same from south as from north
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
            values = {
                column.name: _value(column) for column in table.columns if column.computed is None
            }
            if table.name == "heliostats":  # one beside, for numbers that go on
                connection.execute(insert(table).values({**values, "id": 7, "name": "y"}))
            connection.execute(insert(table).values(values))


def _rows(database: Database, columns: dict[str, list[str]]) -> dict[str, Any]:
    """What these columns of these tables hold."""
    tables = {table.name: table for table in _tables(database)}
    with database.engine.connect() as connection:
        return {
            name: [
                tuple(row)
                for row in connection.execute(select(*(tables[name].c[c] for c in names)))
            ]
            for name, names in columns.items()
        }


def _columns(database: Database) -> dict[str, list[str]]:
    """Those of every table but what the database computes."""
    return {
        table.name: [one.name for one in table.columns if one.computed is None]
        for table in _tables(database)
    }


def _names_now(columns: dict[str, list[str]]) -> dict[str, list[str]]:
    """The columns by the names that the newest revision gives them."""
    scripts = ScriptDirectory.from_config(alembic_config())
    renamed = {
        (table, old): new
        for revision in ("0019", "0020")
        for table, old, new in scripts.get_revision(revision).module.COLUMNS
    }
    return {
        table: [renamed.get((table, name), name) for name in names]
        for table, names in columns.items()
    }


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
    assert _rows(database, _names_now(columns)) == before
    database.downgrade(revision)
    assert _columns(database) == columns
    assert _rows(database, columns) == before
    database.close()


def test_results_of_older_predictions_are_read_by_the_new_names(empty_url: URL):
    database = Database(empty_url)
    database.upgrade("0018")
    _fill(database)
    tables = {table.name: table for table in _tables(database)}
    judged = {"taken": False, "against": 1, "reason": "forecasts worse"}
    with database.engine.execution_options(writes=True).begin() as connection:
        result = {"surfaces": {"AA39": 2}, "judged": {"AA39": judged}}
        connection.execute(tables["jobs"].update().values(kind="predictions", result=result))
        step = {"version": 2, "judged": judged}
        connection.execute(tables["job_steps"].update().values(result=step))
    columns = {"jobs": ["result"], "job_steps": ["result"]}
    before = _rows(database, columns)
    database.upgrade()
    after = _rows(database, columns)
    renamed = {"became_active": False, "against": 1, "reason": "forecasts worse"}
    assert after["jobs"][0][0] == {"surfaces": {"AA39": 2}, "judged": {"AA39": renamed}}
    assert after["job_steps"][0][0] == {"version": 2, "judged": renamed}
    database.downgrade("0018")
    assert _rows(database, columns) == before
    database.downgrade("base")
    database.close()


def test_azimuths_of_older_stores_are_from_north(empty_url: URL):
    database = Database(empty_url)
    database.upgrade("0019")
    _fill(database)
    tables = {table.name: table for table in _tables(database)}
    sun = {"azimuth_deg": -41.2, "elevation_deg": 33.5}
    with database.engine.execution_options(writes=True).begin() as connection:
        for name in ("measurements", "forecasts"):
            connection.execute(tables[name].update().values(sun_azimuth_deg=-41.2))
        fields = {"sun_azimuth": 20.0, "taken_at": "2024-06-01T09:14:03+00:00", "excluded": False}
        after = {"sun_azimuth": 200.1, "taken_at": None, "excluded": True}
        connection.execute(tables["corrections"].update().values(before=fields, after=after))
        asked = {"begin": "2024-06-01T09:14:03Z", "end": "2024-06-01T09:14:03Z", "target": "x"}
        changes = {"payload": asked, "result": {"steps": [{"sun": sun}]}}
        connection.execute(tables["jobs"].update().values(kind="forecasts", **changes))
        connection.execute(tables["job_steps"].update().values(result={"sun": sun}))
        connection.execute(tables["audit"].update().values(action="surface.seen"))
    columns = {
        "audit": ["action"],
        "measurements": ["sun_azimuth_deg"],
        "forecasts": ["sun_azimuth_deg"],
        "corrections": ["before", "after"],
        "jobs": ["payload", "result"],
        "job_steps": ["result"],
    }
    before = _rows(database, columns)
    database.upgrade()
    found, turned = _rows(database, columns), sun | {"azimuth_deg": 221.2}
    assert found["audit"] == [("surface.acknowledged",)]
    assert found["measurements"] == found["forecasts"] == [(221.2,)]
    assert found["corrections"] == [
        (
            {"sun.azimuth_deg": 160.0, "taken_at": "2024-06-01T09:14:03Z", "excluded": False},
            {"sun.azimuth_deg": pytest.approx(339.9), "taken_at": None, "excluded": True},
        )
    ]
    ((payload, result),) = found["jobs"]
    assert (set(payload), result) == (
        {"first_at", "last_at", "target"},
        {"steps": [{"sun": turned}]},
    )
    assert found["job_steps"] == [({"sun": turned},)]
    database.downgrade("0019")
    after = {"sun_azimuth": pytest.approx(-159.9), "taken_at": None, "excluded": True}
    assert _rows(database, columns) == before | {"corrections": [(fields, after)]}
    database.downgrade("base")
    database.close()


def test_images_of_older_stores_get_verdict_and_totals(empty_url: URL):
    database = Database(empty_url)
    database.upgrade("0006")
    _fill(database)
    tables = {table.name: table for table in _tables(database)}
    with database.engine.execution_options(writes=True).begin() as connection:
        image = {c.name: _value(c) for c in tables["images"].columns} | {
            "sha256": "y",
            "size_bytes": 5,
        }
        connection.execute(
            insert(tables["images"]).values(image)
        )  # of no measurement, as a refused one
    database.upgrade()
    assert _rows(database, {"image_totals": ["accepted", "images", "size_bytes"]})[
        "image_totals"
    ] == [(False, 1, 5), (True, 1, 1)]
    assert _rows(database, {"images": ["sha256", "accepted", "pruned_at"]})["images"] == [
        ("x", True, None),
        ("y", False, None),
    ]
    database.downgrade("base")
    database.close()


def test_images_that_two_heliostats_have_stay_and_are_marked(empty_url: URL):
    """Of stores from before one image was one heliostat's; only the later one is marked
    as forced.
    """
    database = Database(empty_url)
    database.upgrade("0014")
    _fill(database)
    tables = {table.name: table for table in _tables(database)}
    with database.engine.execution_options(writes=True).begin() as connection:
        row = {c.name: _value(c) for c in tables["measurements"].columns if c.computed is None}
        for number, heliostat, kind in ((2, 1, "cropped"), (3, 7, "flux")):
            other = {
                "id": number,
                "heliostat_id": heliostat,
                "kind": kind,
                "identifier": f"y{number}",
            }
            connection.execute(insert(tables["measurements"]).values({**row, **other}))
    database.upgrade()
    forced = dict(_rows(database, {"measurements": ["id", "forced"]})["measurements"])
    assert (forced[1], forced[2], forced[3] is None) == (None, None, False)
    database.downgrade("base")
    database.close()


def test_downgrade_of_a_full_store_takes_what_older_versions_cannot_hold(empty_url: URL):
    """Tables of later revisions go; a model's version that is too long for the older column is cut
    off, not refused.
    """
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


def test_maps_of_plans_are_kept_one_by_one_and_together_again_in_older_versions(empty_url: URL):
    database = Database(empty_url)
    database.upgrade(JOBS_BEFORE)
    rng = np.random.default_rng(2)
    maps = {name: rng.random((3, 4, 5)).astype(np.float32) for name in ("twin", "ideal")}
    peak = {"flux": maps["twin"].max(axis=0)}
    jobs = next(table for table in _tables(database) if table.name == "jobs")
    values = {column.name: _value(column) for column in jobs.columns}
    with database.engine.execution_options(writes=True).begin() as connection:
        connection.execute(
            insert(jobs).values(values | {"kind": "plans", "arrays": pack(maps | peak)})
        )
    before = _rows(database, {"jobs": ["arrays"]})
    database.upgrade()
    with database.reading() as session:
        row = queue.get_job(session, 1, arrays=True)
        assert row.arrays is not None
        assert list(unpack(row.arrays)) == ["flux"]
        for index in range(3):
            data = queue.checkpoint_arrays(session, 1, map_name(index))
            assert data is not None
            of_time = unpack(data)
            assert all((of_time[name] == maps[name][index]).all() for name in maps)
    database.downgrade(JOBS_BEFORE)
    (after,), (first,) = _rows(database, {"jobs": ["arrays"]})["jobs"], before["jobs"]
    assert all((unpack(after[0])[name] == array).all() for name, array in unpack(first[0]).items())
    assert _rows(database, {"job_steps": ["name"]})["job_steps"] == []
    database.downgrade("base")
    database.close()
