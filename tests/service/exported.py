"""What an export must keep: a comparison of two stores, table by table.

`docs/reference/file-formats.md` says the same as `NOT_EXPORTED`.
"""

from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Table, select
from sqlalchemy.orm import Session

import service.store.job_tables  # noqa: F401 - its tables belong to the metadata
from service.base.settings import Settings
from service.sources.folder import read_folder
from service.store.columns import Base
from service.twin.exporting import export_folder
from service.twin.importing import import_folder
from service.twin.runtime import Operations, Runtime

ALL = frozenset({"*"})
NOT_EXPORTED: dict[str, frozenset[str]] = {
    "acknowledgements": ALL,  # of alarms, which the settings and the present time decide
    "alarms": ALL,
    "api_keys": ALL,
    "audit": ALL,
    "sessions": ALL,
    "field_state": ALL,  # computed again, as the next two
    "forecasts": ALL,
    "heliostat_state": ALL,
    "jobs": ALL,
    "job_steps": ALL,
    "image_totals": ALL,  # sums
    "heliostats": frozenset({"created_at", "updated_at", "photographs_changed_at"}),
    "targets": frozenset({"updated_at"}),
    "receivers": frozenset({"updated_at"}),
    # How long an image is kept: when it came to this store, and whether it was accepted then.
    "images": frozenset({"created_at", "accepted"}),
    "measurements": frozenset({"forecast_key"}),  # row ids
}
"""Tables, or columns of them, that an export leaves out by design."""

MEASURED_AGAIN = frozenset(
    {"accepted", "reason", "quality", "center_right_m", "center_up_m", "arrays", "warnings"}
)
"""Columns of measurements that an import measures, by the plant's current model."""

_KEYS = {
    "heliostats": ("name",),
    "targets": ("name",),
    "images": ("sha256",),
    "measurements": ("heliostat_id", "identifier"),
    "surfaces": ("heliostat_id", "version"),
    "studies": ("created_at", "conclusion"),
}
"""What identifies a row of a table that others refer to, in every store."""


def tables() -> list[Table]:
    """The tables that an export keeps."""
    return [
        table
        for table in Base.metadata.sorted_tables
        if NOT_EXPORTED.get(table.name, frozenset()) != ALL
    ]


def rows_of(runtime: Runtime) -> dict[str, list[dict[str, Any]]]:
    """All rows of the tables that an export keeps, by table. What refers to a row names it."""
    with runtime.database.reading() as session:
        return {table.name: _rows(session, table) for table in tables()}


def _rows(session: Session, table: Table) -> list[dict[str, Any]]:
    left_out = NOT_EXPORTED.get(table.name, frozenset())
    key = [column for column in table.primary_key if column.name == "id"]
    found = []
    for row in session.execute(select(table).order_by(*key)).mappings():
        known = {}
        for column in table.columns:
            reference = next(iter(column.foreign_keys), None)
            value = row[column]
            if reference is not None and value is not None:
                value = _name_of(session, reference.column.table, value)
            if column.name not in left_out and column not in key:
                known[column.name] = value
        if row.get("pruned_at") is None:  # an image without its file is left out
            found.append(known)
    return found


def _name_of(session: Session, table: Table, number: Any) -> tuple[Any, ...]:
    (key,) = table.primary_key
    row = session.execute(select(table).where(key == number)).mappings().one()
    name: list[Any] = []
    for part in _KEYS[table.name]:
        reference = next(iter(table.columns[part].foreign_keys), None)
        value = row[part]
        name += [value] if reference is None else _name_of(session, reference.column.table, value)
    return tuple(name)


def same(one: Any, other: Any) -> bool:
    """Whether two values are the same, numbers to a millionth: places go to degrees and back."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return bool(one == pytest.approx(other, abs=1e-6, rel=1e-9))
    return bool(one == other)


def require_same(one: Runtime, other: Runtime, without: frozenset[str] = frozenset()) -> None:
    """Assert that two stores have the same rows in every table that an export keeps.

    ``without`` are columns of measurements that are not compared.
    """
    before, after = rows_of(one), rows_of(other)
    for rows in (before["measurements"], after["measurements"]):
        for row in rows:
            for column in without:
                del row[column]
    for name, rows in before.items():
        others = list(after[name])
        lost = []
        for row in rows:
            place = next((at for at, there in enumerate(others) if same(row, there)), None)
            if place is None:
                lost.append(row)
            else:
                others.pop(place)
        apart = {"lost": lost, "added": others}
        assert apart == {"lost": [], "added": []}, name


def require_round_trip(
    runtime: Runtime,
    operations: Operations | None,
    folder: Path,
    without: frozenset[str] = frozenset(),
) -> None:
    """Assert that a store, exported to a folder and imported from it, is the same.

    A second import changes nothing.
    """
    assert export_folder(runtime, folder / "out")["skipped"] == {}
    settings = Settings(data_dir=folder / "other")
    other = Runtime.from_settings(settings, operations)
    try:
        other.database.upgrade()
        for times in range(2):
            done = import_folder(other, read_folder(folder / "out", whole_field=True))
            assert done["skipped"] == {}, (times, done["skipped"])
            require_same(runtime, other, without)
    finally:
        other.close()
