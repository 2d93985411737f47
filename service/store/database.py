"""The database: connections to SQLite or PostgreSQL, transactions, and schema versions."""

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from sqlalchemy import URL, Connection, Engine, NullPool, create_engine, event, inspect, text
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.orm import Session

import migrations
from model.errors import InvalidInputError
from service.base.errors import SchemaError, StoreDamagedError
from service.base.settings import WEB_CONNECTIONS, Settings
from service.store.rows import serialize_writers

# Seconds that a writer waits for another on SQLite, and that connecting to PostgreSQL may take.
_PATIENCE_S = 15

# Notice after about a minute, not the system's two hours, that PostgreSQL no longer answers.
_ALIVE = {
    "keepalives_idle": 30,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    "tcp_user_timeout": 60_000,
}

# Connections that stay open. Further connections are closed after use.
_KEPT_CONNECTIONS = 5

# How often a transaction is tried that PostgreSQL ended because of a deadlock.
_ATTEMPTS = 5
_DEADLOCK = "40P01"
Done = TypeVar("Done")

logger = logging.getLogger("heliotwin.service")

# Alembic keeps its context in module globals, so a process runs one migration at a time.
_alembic = threading.Lock()


def alembic_config() -> Config:
    """The Alembic configuration for the scripts of the installed `migrations` package."""
    config = Config()
    config.set_main_option(
        "script_location", str(Path(migrations.__file__).parent).replace("%", "%%")
    )
    config.set_main_option("path_separator", "os")
    return config


def _prepare_sqlite(engine: Engine) -> None:
    @event.listens_for(engine, "connect")
    def _on_connect(connection: Any, _record: Any) -> None:
        # SQLAlchemy's "begin" below starts transactions, not the driver.
        connection.isolation_level = None
        for pragma in (
            "journal_mode=WAL",
            "synchronous=FULL",
            "foreign_keys=ON",
            f"busy_timeout={_PATIENCE_S * 1000}",
        ):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def _on_begin(connection: Connection) -> None:
        # A deferred transaction that reads and then writes fails at once if another one wrote in
        # between. A transaction that will write therefore takes the lock first.
        writes = connection.get_execution_options().get("writes", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def make_engine(url: URL, connections: int = WEB_CONNECTIONS) -> Engine:
    """Create an engine with a pool of ``connections`` for ``url``.

    SQLite gets a write-ahead log, durable commits and foreign keys.
    """
    kept = min(_KEPT_CONNECTIONS, connections)
    pool = {"pool_size": kept, "max_overflow": connections - kept, "pool_timeout": _PATIENCE_S}
    if url.get_backend_name() != "sqlite":
        connect = {"connect_timeout": _PATIENCE_S, **_ALIVE}
        return create_engine(url, pool_pre_ping=True, connect_args=connect, **pool)
    if url.database:
        Path(url.database).parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(url, **pool)
    _prepare_sqlite(engine)
    return engine


def is_deadlock(error: BaseException) -> bool:
    """Whether PostgreSQL ended a transaction because of a deadlock, so that a retry may succeed."""
    return isinstance(error, DBAPIError) and getattr(error.orig, "sqlstate", None) == _DEADLOCK


def _damage(error: DBAPIError) -> str | None:
    """SQLite's message if the error means that its file is damaged, else None."""
    # The lowest byte is the primary code; the others give details.
    code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF
    return str(error.orig) if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB) else None


class Database:
    """A connection pool and its transactions.

    Use ``with database.reading() as session`` to read and ``with database.writing() as session`` to
    write. The latter commits at the end of its block, or rolls back if the block raises.
    """

    def __init__(self, url: URL, connections: int = WEB_CONNECTIONS) -> None:
        self.url = url
        self.engine = make_engine(url, connections)
        self._writer = self.engine.execution_options(writes=True)

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Open a session that is rolled back at the end."""
        with Session(self.engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Open a session in one transaction.

        On SQLite it holds the only write lock, so finish computations before entering.
        """
        with Session(self._writer, expire_on_commit=False) as session, session.begin():
            yield session

    def run_in_transaction(self, fn: Callable[[Session], Done]) -> Done:
        """Return the result of a function that changes what people decide, in one transaction.

        Such functions run one after another, on PostgreSQL as on SQLite, also those of other
        services. What ``fn`` reads is therefore what it changes, a name is unique in two tables,
        and changes of many things in different orders do not wait for each other. Transactions of
        photographs and jobs do not wait here; `service.store.rows.lock_heliostat` orders them. If
        PostgreSQL ends the transaction because of a deadlock with one of these, it begins again.
        """
        for _ in range(_ATTEMPTS - 1):
            try:
                with self.changing() as session:
                    return fn(session)
            except OperationalError as error:
                if not is_deadlock(error):
                    raise
                logger.info("a write and another waited for each other; it is begun again")
        with self.changing() as session:
            return fn(session)

    @contextmanager
    def changing(self) -> Iterator[Session]:
        """Open a session as `run_in_transaction` does, for one that is not tried again."""
        with self.writing() as session:
            serialize_writers(session)
            yield session

    def upgrade(self, revision: str = "head") -> None:
        """Upgrade the schema to ``revision``."""
        with self._migrating() as config:
            command.upgrade(config, revision)

    def downgrade(self, revision: str) -> None:
        """Downgrade the schema to ``revision`` ("base" for an empty database)."""
        with self._migrating() as config:
            command.downgrade(config, revision)

    @contextmanager
    def _migrating(self) -> Iterator[Config]:
        self.require_known()
        config = alembic_config()
        with _alembic, self._writer.connect() as connection:
            config.attributes["connection"] = connection
            yield config

    def ping(self) -> None:
        """Test whether the database answers. Raises SQLAlchemy's error if it does not.

        Raises
        ------
        StoreDamagedError
            If SQLite's file is damaged at the start of a table. `heliotwin check` reads all of it.
        """
        with self.telling_damage():
            with self.engine.connect() as connection:
                connection.execute(text("SELECT 1"))
            if self.url.get_backend_name() == "sqlite":
                self._look_at_file()

    def _look_at_file(self) -> None:
        # Pooled connections would answer from their cached pages.
        fresh = create_engine(self.url, poolclass=NullPool)
        with fresh.connect() as connection:
            for name in inspect(connection).get_table_names():
                connection.execute(text(f'SELECT 1 FROM "{name}" NOT INDEXED LIMIT 1'))

    @contextmanager
    def telling_damage(self) -> Iterator[None]:
        """Convert errors from a damaged SQLite file to `StoreDamagedError` inside the block."""
        try:
            yield
        except DBAPIError as error:
            if (said := _damage(error)) is None:
                raise
            raise StoreDamagedError(
                f"the database {self.url.database} is damaged ({said}): restore it from a back-up"
            ) from error

    def revision(self) -> str | None:
        """The current version of the schema, or None."""
        # Alembic's function writes two lines to the log, and readiness probes come every few
        # seconds.
        with self.engine.connect() as connection:
            if not inspect(connection).has_table("alembic_version"):
                return None
            revision: str | None = connection.execute(
                text("SELECT version_num FROM alembic_version")
            ).scalar_one_or_none()
            return revision

    def revisions(self) -> list[str]:
        """All schema versions that this code knows, oldest first."""
        return [
            script.revision
            for script in ScriptDirectory.from_config(alembic_config()).walk_revisions()
        ][::-1]

    def is_current(self) -> bool:
        """Whether the schema is at the newest version that this code knows."""
        return self.revision() == _newest_revision()

    def require_known(self) -> None:
        """Raise `SchemaError` if a version that this code does not know made the schema."""
        if (found := self.revision()) not in (None, *self.revisions()):
            raise SchemaError(
                f"{self.url}: a newer version, or one before 1.0.0, made this store (schema"
                f" {found}, not {_newest_revision()}); start that one, restore a back-up of this"
                " one, or set HELIOTWIN_DATA_DIR or HELIOTWIN_DATABASE_URL to a new store"
            )

    def require_current(self) -> None:
        """Raise `SchemaError` unless the schema is at the newest version that this code knows."""
        self.require_known()
        if not self.is_current():
            raise SchemaError(
                f"the store's schema is at {self.revision()}, this version works with"
                f" {_newest_revision()}: run `heliotwin migrate`"
            )
        logger.info("the store's schema is at %s, its newest version", _newest_revision())

    def close(self) -> None:
        """Close all pooled connections."""
        self.engine.dispose()


@cache
def _newest_revision() -> str | None:
    """Return the newest schema version that this code knows.

    Cached, because Alembic reads all its scripts to find it.
    """
    return ScriptDirectory.from_config(alembic_config()).get_current_head()


def require_store(settings: Settings) -> None:
    """Raise `InvalidInputError` if the embedded database does not exist, without creating it."""
    file = settings.database.database
    if settings.database.get_backend_name() == "sqlite" and not (file and Path(file).is_file()):
        raise InvalidInputError(
            f"{file and Path(file).absolute()}: there is no store; set HELIOTWIN_DATA_DIR or"
            " HELIOTWIN_DATABASE_URL to where it is, or make one by `heliotwin serve`, `heliotwin"
            " import` or `heliotwin migrate`"
        )


def migrate(settings: Settings) -> str:
    """Bring the schema to its newest version, and return that version."""
    database = Database(settings.database)
    try:
        database.upgrade()
        return database.revision() or "base"
    finally:
        database.close()
