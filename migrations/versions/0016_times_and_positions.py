"""Measurements without an image; times that are not known stay unknown; warnings of
measurements.
"""

from datetime import UTC, datetime

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

_INDEXES = (("{}", "id"), ("accepted", "{}", "id"), ("target_id", "{}", "id"))
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

# What changes of the tables' definitions: each text of SQLite with the one that takes its place.
_OLD_KIND = "CHECK (kind IN ('raw', 'cropped', 'flux', 'flux-centered'))"
_NEW_KIND = "CHECK (kind IN ('raw', 'cropped', 'flux', 'flux-centered', 'none'))"
_IMAGE = "CONSTRAINT ck_measurements_image CHECK ((kind = 'none') = (image_sha256 IS NULL))"
_DEFINITIONS = (
    ("measurements", "image_sha256 VARCHAR(64) NOT NULL", "image_sha256 VARCHAR(64)"),
    ("measurements", _OLD_KIND, f"{_NEW_KIND}, {_IMAGE}"),
    ("surfaces", "valid_from DATETIME NOT NULL", "valid_from DATETIME"),
    ("mounts", "valid_from DATETIME NOT NULL", "valid_from DATETIME"),
)


def upgrade() -> None:
    is_sqlite = op.get_context().dialect.name == "sqlite"
    _index("moment", is_made=False)
    op.drop_column("measurements", "moment")
    _index("taken_at", is_made=True)
    op.add_column("measurements", sa.Column("warnings", sa.JSON(none_as_null=True), nullable=True))
    if is_sqlite:
        _redefine([(table, old, new) for table, old, new in _DEFINITIONS])
    else:
        op.alter_column("measurements", "image_sha256", nullable=True)
        op.drop_constraint(op.f("ck_measurements_kind"), "measurements", type_="check")
        op.execute(
            f"ALTER TABLE measurements ADD CONSTRAINT ck_measurements_kind {_NEW_KIND}, ADD"
            f" {_IMAGE}"
        )
        for table in ("surfaces", "mounts"):
            op.alter_column(table, "valid_from", nullable=True)
    surfaces = sa.table("surfaces", sa.column("valid_from", sa.DateTime(timezone=True)))
    op.execute(surfaces.update().where(surfaces.c.valid_from <= _EPOCH).values(valid_from=None))
    op.execute(
        "DELETE FROM drift WHERE measurement_id IN (SELECT id FROM measurements WHERE taken_at IS"
        " NULL)"
    )
    op.execute(_warnings_of_clocks(is_sqlite))
    op.create_index(
        op.f("ix_measurements_warned"),
        "measurements",
        ["heliostat_id"],
        postgresql_where=sa.text("warnings IS NOT NULL"),
        sqlite_where=sa.text("warnings IS NOT NULL"),
    )


def downgrade() -> None:
    is_sqlite = op.get_context().dialect.name == "sqlite"
    op.execute(
        "DELETE FROM corrections WHERE measurement_id IN (SELECT id FROM measurements WHERE"
        " image_sha256 IS NULL)"
    )
    op.execute("DELETE FROM measurements WHERE image_sha256 IS NULL")
    surfaces = sa.table("surfaces", sa.column("valid_from", sa.DateTime(timezone=True)))
    op.execute(surfaces.update().where(surfaces.c.valid_from.is_(None)).values(valid_from=_EPOCH))
    op.execute("UPDATE mounts SET valid_from = created_at WHERE valid_from IS NULL")
    if is_sqlite:
        _redefine([(table, new, old) for table, old, new in _DEFINITIONS])
    else:
        op.alter_column("measurements", "image_sha256", nullable=False)
        op.drop_constraint(op.f("ck_measurements_kind"), "measurements", type_="check")
        op.drop_constraint(op.f("ck_measurements_image"), "measurements", type_="check")
        op.execute(f"ALTER TABLE measurements ADD CONSTRAINT ck_measurements_kind {_OLD_KIND}")
        for table in ("surfaces", "mounts"):
            op.alter_column(table, "valid_from", nullable=False)
    op.drop_index(op.f("ix_measurements_warned"), "measurements")
    op.drop_column("measurements", "warnings")
    _index("taken_at", is_made=False)
    computed = sa.Computed("coalesce(taken_at, created_at)", persisted=not is_sqlite)
    op.add_column(
        "measurements", sa.Column("moment", sa.DateTime(timezone=True), computed, nullable=True)
    )
    _index("moment", is_made=True)


def _index(time: str, is_made: bool) -> None:
    """The indexes by which photographs are listed in the order of a column of time."""
    for columns in _INDEXES:
        named = [column.format(time) for column in columns]
        name = op.f(f"ix_measurements_{'_'.join(named)}")
        if is_made:
            op.create_index(name, "measurements", named)
        else:
            op.drop_index(name, "measurements")


def _redefine(changes: list[tuple[str, str, str]]) -> None:
    """Edit SQLite's definitions of tables, as its documentation of ALTER TABLE allows for
    constraints.

    The usual way copies the table, gigabytes of fluxes, and SQLite lets no table go that others
    refer to.
    """
    connection = op.get_bind()
    version = connection.exec_driver_sql("PRAGMA schema_version").scalar_one()
    connection.exec_driver_sql("PRAGMA writable_schema=ON")
    for table, old, new in changes:
        where = (table,)
        sql = connection.exec_driver_sql(
            "SELECT sql FROM sqlite_master WHERE type='table' AND name=?", where
        ).scalar()
        if sql is None or sql.count(old) != 1:
            raise RuntimeError(
                f"the table {table} is not defined as revision 0015 defines it: {old!r} is not"
                " in it"
            )
        changed = (sql.replace(old, new), table)
        connection.exec_driver_sql(
            "UPDATE sqlite_master SET sql=? WHERE type='table' AND name=?", changed
        )
    connection.exec_driver_sql(f"PRAGMA schema_version={version + 1}")
    connection.exec_driver_sql("PRAGMA writable_schema=OFF")


def _warnings_of_clocks(is_sqlite: bool) -> str:
    """What older versions kept in words, as a warning with its type."""
    clock = "json_extract(quality, '$.clock')" if is_sqlite else "quality ->> 'clock'"
    array, record = (
        ("json_array", "json_object") if is_sqlite else ("json_build_array", "json_build_object")
    )
    made = f"{array}({record}('type', 'sun_contradicts_time', 'detail', {clock}))"
    return f"UPDATE measurements SET warnings = {made} WHERE {clock} IS NOT NULL"
