"""Back-ups: a folder with a snapshot of the database, all its images, and their hashes.

A back-up runs while the service runs. It reads the database in one snapshot, then copies the
images. This order suffices, because an image is stored before its row, and never changes. Deletion
of images waits meanwhile (`service.store.image_files`). SQLite is copied by its
back-up function, PostgreSQL table by table with COPY, so that no external tool is needed. A restore
verifies all hashes before it writes, and writes only into an empty store.
"""

import gzip
import hashlib
import os
import shutil
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from psycopg import sql
from pydantic import BaseModel, Field, ValidationError
from sqlalchemy import Connection, inspect, text

from model.errors import InvalidInputError
from service.base.errors import ConflictError, StoreDamagedError
from service.base.progress import Progress, no_progress
from service.base.settings import Settings
from service.base.validation import format_validation_error
from service.store.database import Database
from service.store.image_files import ImageStore

_FORMAT = 1
_MANIFEST, _SQLITE, _IMAGES, _LIST = "manifest.json", "database.sqlite", "images", "images.txt"
_KEPT_IMAGES = "SELECT sha256 FROM images WHERE pruned_at IS NULL ORDER BY sha256"
_CHUNK = 2**20


def images_of(settings: Settings) -> ImageStore:
    """The image store of the settings."""
    return ImageStore(settings.data_dir / "images")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Manifest(BaseModel):
    """What a back-up holds: ``files`` with their hashes, and what images are ``damaged``.

    ``tables`` are the columns of PostgreSQL's tables, referenced tables first.
    """

    format: int = _FORMAT
    engine: str
    made_at: str | None = None
    revision: str
    tables: dict[str, list[str]] = Field(default_factory=dict)
    images: int
    damaged: list[str]
    files: dict[str, str]


# --- Creation -------------------------------------------------------------------------------------


def back_up(settings: Settings, out: Path, step: Progress = no_progress) -> Manifest:
    """Write a back-up of the store to the new folder ``out`` and return its manifest.

    Missing or damaged images are listed under ``damaged``, and everything else is copied. The
    folder gets its final name at the end, so a folder of that name is complete.

    Raises
    ------
    InvalidInputError
        If ``out`` exists.
    ConflictError
        If there is no store.
    """
    if out.exists():
        raise InvalidInputError(f"{out} exists; name a new folder, a back-up overwrites nothing")
    database = Database(settings.database)
    partial = out.with_name(f"{out.name}.partial")
    try:
        if database.revision() is None:
            raise ConflictError("there is no store to back up: the database holds no schema")
        database.require_known()
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        images = images_of(settings)
        # Held from before the snapshot, so that its images exist until all are copied.
        with images.held():
            manifest = _write(database, images, partial, step)
    finally:
        database.close()
    os.sync()
    partial.rename(out)
    return manifest


def _write(database: Database, images: ImageStore, folder: Path, step: Progress) -> Manifest:
    engine = database.url.get_backend_name()
    step("database")
    copied = (_copy_sqlite if engine == "sqlite" else _copy_postgres)(database, folder)
    wanted = (folder / _LIST).read_text(encoding="ascii").split()
    damaged = [sha256 for sha256 in wanted if not _copy_image(images, folder, sha256, step)]
    manifest = Manifest(
        engine=engine,
        made_at=datetime.now(UTC).isoformat(),
        revision=copied.revision,
        tables=copied.tables,
        images=len(wanted) - len(damaged),
        damaged=damaged,
        files={path.name: _sha256(path) for path in sorted(folder.iterdir()) if path.is_file()},
    )
    (folder / _MANIFEST).write_text(manifest.model_dump_json(indent=1), encoding="utf-8")
    return manifest


class _Copied(NamedTuple):
    revision: str
    tables: dict[str, list[str]]


def _copy_image(images: ImageStore, folder: Path, sha256: str, step: Progress) -> bool:
    step(sha256[:12])
    try:
        data = images.read(sha256)
    except StoreDamagedError:
        return False
    _place(ImageStore(folder / _IMAGES), sha256, data)
    return True


def _place(images: ImageStore, sha256: str, data: bytes) -> None:
    """Write an image without syncing it; the caller syncs all files at once."""
    path = images.path(sha256)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _list_images(folder: Path, digests: Iterable[str]) -> None:
    (folder / _LIST).write_text("".join(f"{sha256}\n" for sha256 in digests), encoding="ascii")


def _copy_sqlite(database: Database, folder: Path) -> _Copied:
    path = folder / _SQLITE
    with (
        closing(sqlite3.connect(str(database.url.database))) as source,
        closing(sqlite3.connect(path)) as copy,
    ):
        source.backup(copy)
        copy.execute("PRAGMA journal_mode=DELETE")  # Makes a single file.
        _list_images(folder, (row[0] for row in copy.execute(_KEPT_IMAGES)))
        return _Copied(copy.execute("SELECT version_num FROM alembic_version").fetchone()[0], {})


def _copy_postgres(database: Database, folder: Path) -> _Copied:
    snapshot = {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
    with database.engine.connect().execution_options(**snapshot) as connection:
        revision = connection.exec_driver_sql(
            "SELECT version_num FROM alembic_version"
        ).scalar_one()
        tables = _tables(connection)
        for name, columns in tables.items():
            _copy_out(connection, name, columns, folder / f"{name}.copy.gz")
        _list_images(folder, connection.scalars(text(_KEPT_IMAGES)))
    return _Copied(revision, tables)


def _tables(connection: Connection) -> dict[str, list[str]]:
    """All tables with their columns, referenced tables first."""
    inspector = inspect(connection)
    names = [
        name
        for name, _ in inspector.get_sorted_table_and_fkc_names()
        if name not in (None, "alembic_version")
    ]
    return {  # The database fills computed columns itself.
        name: [column["name"] for column in inspector.get_columns(name) if "computed" not in column]
        for name in names
        if name is not None
    }


def _statement(template: str, name: str, columns: Sequence[str]) -> sql.Composed:
    listed = sql.SQL(", ").join(map(sql.Identifier, columns))
    return sql.SQL(template).format(sql.Identifier(name), listed)


def _driver(connection: Connection) -> Any:
    return connection.connection.driver_connection


def _copy_out(connection: Connection, name: str, columns: Sequence[str], path: Path) -> None:
    statement = _statement("COPY {} ({}) TO STDOUT", name, columns)
    with (
        gzip.open(path, "wb", compresslevel=1) as file,
        _driver(connection).cursor().copy(statement) as copy,
    ):
        for data in copy:
            file.write(data)


# --- Restoration ----------------------------------------------------------------------------------


def restore(settings: Settings, folder: Path, step: Progress = no_progress) -> Manifest:
    """Restore a back-up into the empty store of the settings, and return its manifest.

    Raises
    ------
    InvalidInputError
        If ``folder`` is not a complete back-up, or has another engine or schema.
    ConflictError
        If the store is not empty.
    """
    manifest = _read_manifest(folder)
    database, images = Database(settings.database), images_of(settings)
    try:
        _require_fit(manifest, database, folder)
        _require_empty(database, images, folder)
        digests = _verify(manifest, folder, step)
        for sha256 in digests:
            step(sha256[:12])
            _place(images, sha256, ImageStore(folder / _IMAGES).read(sha256))
        os.sync()
        step("database")
        (_load_sqlite if manifest.engine == "sqlite" else _load_postgres)(
            manifest, folder, database
        )
    finally:
        database.close()
    return manifest


def _read_manifest(folder: Path) -> Manifest:
    try:
        return Manifest.model_validate_json((folder / _MANIFEST).read_bytes())
    except OSError as error:
        raise InvalidInputError(
            f"{folder} is no back-up: its {_MANIFEST} cannot be read ({error})"
        ) from error
    except ValidationError as error:
        reason = format_validation_error(error, "it")
        raise InvalidInputError(f"{folder} is no back-up: its {_MANIFEST}: {reason}") from error


def _require_fit(manifest: Manifest, database: Database, folder: Path) -> None:
    if manifest.format != _FORMAT:
        raise InvalidInputError(
            f"{folder}: format {manifest.format} is not {_FORMAT}; use a newer heliotwin"
        )
    engine = database.url.get_backend_name()
    if manifest.engine != engine:
        raise InvalidInputError(
            f"{folder} is of {manifest.engine}; HELIOTWIN_DATABASE_URL names {engine}"
        )
    if manifest.revision not in database.revisions():
        raise InvalidInputError(
            f"{folder} has schema {manifest.revision}; use the version of heliotwin that made it"
        )


def _require_empty(database: Database, images: ImageStore, folder: Path) -> None:
    # After a failed restore, an empty table of the schema version remains.
    if set(inspect(database.engine).get_table_names()) - {"alembic_version"}:
        raise ConflictError(
            "the database holds a store already; name an empty one, a restore overwrites nothing"
        )
    backed_up = ImageStore(folder / _IMAGES)
    for path in images.root.rglob("*"):
        if path.is_file() and not (backed_up.root / path.relative_to(images.root)).is_file():
            raise ConflictError(
                f"{images.root} holds images that are not of this back-up; name another data_dir"
            )


def _verify(manifest: Manifest, folder: Path, step: Progress) -> list[str]:
    """The digests of the back-up's images; InvalidInputError if any file is damaged."""
    step("verification")
    bad = [name for name, sha256 in manifest.files.items() if not _is(folder / name, sha256)]
    if bad:
        raise InvalidInputError(f"{folder} is damaged: {', '.join(bad[:3])}; use another back-up")
    images, missing = ImageStore(folder / _IMAGES), set(manifest.damaged)
    digests = [
        sha256
        for sha256 in (folder / _LIST).read_text(encoding="ascii").split()
        if sha256 not in missing
    ]
    bad = [sha256 for sha256 in digests if not _is(images.path(sha256), sha256)]
    if bad:
        raise InvalidInputError(
            f"{folder} is damaged: {len(bad)} images, {bad[0]} among them; use another back-up"
        )
    return digests


def _is(path: Path, sha256: str) -> bool:
    return path.is_file() and _sha256(path) == sha256


def _load_sqlite(_manifest: Manifest, folder: Path, database: Database) -> None:
    path = Path(str(database.url.database))
    database.close()
    partial = path.with_name(f"{path.name}.partial")
    shutil.copyfile(folder / _SQLITE, partial)
    for leftover in (f"{path.name}-wal", f"{path.name}-shm"):
        path.with_name(leftover).unlink(missing_ok=True)
    os.sync()
    partial.rename(path)


def _load_postgres(manifest: Manifest, folder: Path, database: Database) -> None:
    database.upgrade(manifest.revision)
    try:
        with database.engine.begin() as connection:
            for name, columns in manifest.tables.items():
                _copy_in(connection, name, columns, folder / f"{name}.copy.gz")
    # Also after an interruption: a schema without rows would count as a store and block a retry.
    except BaseException:
        database.downgrade("base")
        raise


def _copy_in(connection: Connection, name: str, columns: Sequence[str], path: Path) -> None:
    statement = _statement("COPY {} ({}) FROM STDIN", name, columns)
    cursor = _driver(connection).cursor()
    with gzip.open(path, "rb") as file, cursor.copy(statement) as copy:
        while data := file.read(_CHUNK):
            copy.write(data)
    if "id" in columns:  # New rows continue after the last id.
        last = sql.SQL(
            "SELECT setval(pg_get_serial_sequence({}, 'id'), max(id)) FROM {} HAVING max(id) IS NOT"
            " NULL"
        )
        cursor.execute(last.format(sql.Literal(name), sql.Identifier(name)))
