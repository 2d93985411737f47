"""Back-ups: a folder with the database as it was at one moment, all images that it knows, and their hashes.

It is taken while the service runs. The database is read in one snapshot; the images after it, which suffices because
an image lies in the store before its row does, is never changed, and is not removed meanwhile
(`service.store.photographs`): pruning waits. SQLite is copied by its own back-up
call; PostgreSQL table by table by COPY, so that no tool of the right version must be at hand. A restore verifies all
hashes before it writes anything, and writes only into a store that holds nothing.
"""

import gzip
import hashlib
import json
import os
import shutil
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from psycopg import sql
from sqlalchemy import Connection, inspect, text

from model.errors import InvalidInputError
from service.base.faults import ConflictError, StoreDamagedError
from service.base.progress import Progress, quiet
from service.base.settings import Settings
from service.base.wording import not_json, place_of
from service.store.database import Database
from service.store.images import ImageStore

_FORMAT = 1
_MANIFEST, _SQLITE, _IMAGES, _LIST = "manifest.json", "database.sqlite", "images", "images.txt"
_CHUNK = 2**20


def images_of(settings: Settings) -> ImageStore:
    """The image store that the settings name."""
    return ImageStore(settings.data_dir / "images")


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# --- taking one -------------------------------------------------------------------------------------------------------


def back_up(settings: Settings, out: Path, step: Progress = quiet) -> dict[str, Any]:
    """Write a back-up of the store to the new folder ``out`` and return its manifest.

    Images that are missing or damaged in the store are listed under ``damaged``; the rest is backed up all the same.
    The folder gets its name when all is written, so a folder of that name is whole.

    Raises
    ------
    InvalidInputError
        Where ``out`` exists.
    ConflictError
        Where there is no store.
    """
    if out.exists():
        raise InvalidInputError(f"{out} exists; name a new folder, a back-up overwrites nothing")
    database = Database(settings.database)
    partial = out.with_name(f"{out.name}.partial")
    try:
        if database.revision() is None:
            raise ConflictError("there is no store to back up: the database holds no schema")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        images = images_of(settings)
        with images.held():  # from before the snapshot: what it names is there until all is copied
            manifest = _write(database, images, partial, step)
    finally:
        database.close()
    os.sync()
    partial.rename(out)
    return manifest


def _write(database: Database, images: ImageStore, folder: Path, step: Progress) -> dict[str, Any]:
    engine = database.url.get_backend_name()
    step("database")
    about = (_copy_sqlite if engine == "sqlite" else _copy_postgres)(database, folder)
    wanted = (folder / _LIST).read_text(encoding="ascii").split()
    damaged = [sha256 for sha256 in wanted if not _copy_image(images, folder, sha256, step)]
    files = {path.name: _sha256(path) for path in sorted(folder.iterdir()) if path.is_file()}
    made_at = datetime.now(UTC).isoformat()
    manifest = {"format": _FORMAT, "engine": engine, "made_at": made_at, **about}
    manifest |= {"images": len(wanted) - len(damaged), "damaged": damaged, "files": files}
    (folder / _MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    return manifest


def _copy_image(images: ImageStore, folder: Path, sha256: str, step: Progress) -> bool:
    step(sha256[:12])
    try:
        data = images.read(sha256)
    except StoreDamagedError:
        return False
    _place(ImageStore(folder / _IMAGES), sha256, data)
    return True


def _place(images: ImageStore, sha256: str, data: bytes) -> None:
    """Write an image; the caller brings all to the disk at once."""
    path = images.path(sha256)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _kept_images(columns: Iterable[str]) -> str:
    """The statement that lists images whose files are kept; before schema 0007 all were."""
    return f"SELECT sha256 FROM images {'WHERE pruned_at IS NULL ' if 'pruned_at' in columns else ''}ORDER BY sha256"


def _list_images(folder: Path, digests: Iterable[str]) -> None:
    (folder / _LIST).write_text("".join(f"{sha256}\n" for sha256 in digests), encoding="ascii")


def _copy_sqlite(database: Database, folder: Path) -> dict[str, Any]:
    path = folder / _SQLITE
    with closing(sqlite3.connect(str(database.url.database))) as source, closing(sqlite3.connect(path)) as copy:
        source.backup(copy)
        copy.execute("PRAGMA journal_mode=DELETE")  # all of it in the one file
        columns = [row[1] for row in copy.execute("PRAGMA table_info(images)")]
        _list_images(folder, (row[0] for row in copy.execute(_kept_images(columns))))
        return {"revision": copy.execute("SELECT version_num FROM alembic_version").fetchone()[0]}


def _copy_postgres(database: Database, folder: Path) -> dict[str, Any]:
    snapshot = {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
    with database.engine.connect().execution_options(**snapshot) as connection:
        revision = connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalar_one()
        tables = _tables(connection)
        for name, columns in tables.items():
            _copy_out(connection, name, columns, folder / f"{name}.copy.gz")
        _list_images(folder, connection.scalars(text(_kept_images(tables["images"]))))
    return {"revision": revision, "tables": tables}


def _tables(connection: Connection) -> dict[str, list[str]]:
    """All tables with their columns, those first that others refer to."""
    inspector = inspect(connection)
    names = [name for name, _ in inspector.get_sorted_table_and_fkc_names() if name not in (None, "alembic_version")]
    return {  # what the database works out by itself it does not take
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
    with gzip.open(path, "wb", compresslevel=1) as file, _driver(connection).cursor().copy(statement) as copy:
        for data in copy:
            file.write(data)


# --- putting one back -------------------------------------------------------------------------------------------------


def restore(settings: Settings, folder: Path, step: Progress = quiet) -> dict[str, Any]:
    """Put a back-up into the empty store that the settings name, and return its manifest.

    Raises
    ------
    InvalidInputError
        Where ``folder`` is no whole back-up, or one of another engine or a newer schema.
    ConflictError
        Where the store is not empty.
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
        (_load_sqlite if manifest["engine"] == "sqlite" else _load_postgres)(manifest, folder, database)
    finally:
        database.close()
    return manifest


def _read_manifest(folder: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((folder / _MANIFEST).read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise InvalidInputError(f"{folder} is no back-up: its {_MANIFEST} {not_json(place_of(error))}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"{folder} is no back-up: its {_MANIFEST} cannot be read ({error})") from error
    if not isinstance(manifest, dict):
        raise InvalidInputError(f"{folder} is no back-up: its {_MANIFEST} must be a JSON object")
    if manifest.get("format") != _FORMAT:
        raise InvalidInputError(f"{folder}: format {manifest.get('format')!r} is not {_FORMAT}; use a newer heliotwin")
    lacking = [name for name in ("engine", "revision", "images", "damaged", "files") if name not in manifest]
    if lacking:
        raise InvalidInputError(f"{folder} is no back-up: its {_MANIFEST} has no {', '.join(lacking)}")
    return manifest


def _require_fit(manifest: dict[str, Any], database: Database, folder: Path) -> None:
    engine = database.url.get_backend_name()
    if manifest["engine"] != engine:
        raise InvalidInputError(f"{folder} is of {manifest['engine']}; HELIOTWIN_DATABASE_URL names {engine}")
    if manifest["revision"] not in database.revisions():
        raise InvalidInputError(f"{folder} has schema {manifest['revision']}; use the newer heliotwin that made it")


def _require_empty(database: Database, images: ImageStore, folder: Path) -> None:
    # The table of the schema's version stays, without a row, where a restore has failed before.
    if set(inspect(database.engine).get_table_names()) - {"alembic_version"}:
        raise ConflictError("the database holds a store already; name an empty one, a restore overwrites nothing")
    backed_up = ImageStore(folder / _IMAGES)
    for path in images.root.rglob("*"):
        if path.is_file() and not (backed_up.root / path.relative_to(images.root)).is_file():
            raise ConflictError(f"{images.root} holds images that are not of this back-up; name another data_dir")


def _verify(manifest: dict[str, Any], folder: Path, step: Progress) -> list[str]:
    """The digests of the back-up's images; InvalidInputError unless every file is what was written."""
    step("verification")
    bad = [name for name, sha256 in manifest["files"].items() if not _is(folder / name, sha256)]
    if bad:
        raise InvalidInputError(f"{folder} is damaged: {', '.join(bad[:3])}; use another back-up")
    images, missing = ImageStore(folder / _IMAGES), set(manifest["damaged"])
    digests = [sha256 for sha256 in (folder / _LIST).read_text(encoding="ascii").split() if sha256 not in missing]
    bad = [sha256 for sha256 in digests if not _is(images.path(sha256), sha256)]
    if bad:
        raise InvalidInputError(f"{folder} is damaged: {len(bad)} images, {bad[0]} among them; use another back-up")
    return digests


def _is(path: Path, sha256: str) -> bool:
    return path.is_file() and _sha256(path) == sha256


def _load_sqlite(_manifest: dict[str, Any], folder: Path, database: Database) -> None:
    path = Path(str(database.url.database))
    database.close()
    partial = path.with_name(f"{path.name}.partial")
    shutil.copyfile(folder / _SQLITE, partial)
    for leftover in (f"{path.name}-wal", f"{path.name}-shm"):
        path.with_name(leftover).unlink(missing_ok=True)
    os.sync()
    partial.rename(path)


def _load_postgres(manifest: dict[str, Any], folder: Path, database: Database) -> None:
    database.upgrade(manifest["revision"])
    try:
        with database.engine.begin() as connection:
            for name, columns in manifest["tables"].items():
                _copy_in(connection, name, columns, folder / f"{name}.copy.gz")
    except BaseException:  # an interruption too: a schema without rows passes for a store, and bars a second attempt
        database.downgrade("base")
        raise


def _copy_in(connection: Connection, name: str, columns: Sequence[str], path: Path) -> None:
    statement = _statement("COPY {} ({}) FROM STDIN", name, columns)
    cursor = _driver(connection).cursor()
    with gzip.open(path, "rb") as file, cursor.copy(statement) as copy:
        while data := file.read(_CHUNK):
            copy.write(data)
    if "id" in columns:  # new rows go on after the last one
        last = sql.SQL("SELECT setval(pg_get_serial_sequence({}, 'id'), max(id)) FROM {} HAVING max(id) IS NOT NULL")
        cursor.execute(last.format(sql.Literal(name), sql.Identifier(name)))
