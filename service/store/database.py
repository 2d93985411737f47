"""The database: connections to SQLite or PostgreSQL, transactions, and the schema's version."""

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
from service.base.faults import SchemaError, StoreDamagedError
from service.base.settings import WEB_CONNECTIONS, Settings

# Seconds that a writer waits for another on SQLite, and that a connection to PostgreSQL may take.
_PATIENCE_S = 15

# A PostgreSQL server that vanished without a word is given up after about a minute, not after the system's two hours.
_ALIVE = {"keepalives_idle": 30, "keepalives_interval": 10, "keepalives_count": 3, "tcp_user_timeout": 60_000}

# Connections that are kept open; those beyond are closed after use.
_KEPT_CONNECTIONS = 5

# How often a deed is begun that PostgreSQL ended because it and another waited for each other.
_ATTEMPTS = 5
_DEADLOCK = "40P01"
Done = TypeVar("Done")

logger = logging.getLogger("heliotwin.service")

# Alembic keeps its context in module globals: one migration at a time in a process.
_alembic = threading.Lock()


def alembic_config() -> Config:
    """The Alembic configuration whose scripts are the installed `migrations` package."""
    config = Config()
    config.set_main_option("script_location", str(Path(migrations.__file__).parent).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


def _prepare_sqlite(engine: Engine) -> None:
    @event.listens_for(engine, "connect")
    def _on_connect(connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # SQLAlchemy's "begin" below starts transactions, not the driver
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", f"busy_timeout={_PATIENCE_S * 1000}"):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def _on_begin(connection: Connection) -> None:
        # A deferred transaction that reads and then writes fails at once when another wrote in between; one that
        # will write therefore takes the lock first and waits its turn.
        writes = connection.get_execution_options().get("writes", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def make_engine(url: URL, connections: int = WEB_CONNECTIONS) -> Engine:
    """A pool of ``connections`` for ``url``; SQLite with write-ahead log, durable commits and foreign keys."""
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
    """Whether PostgreSQL ended a transaction that waited for another, and that for it; begun again it may pass."""
    return isinstance(error, DBAPIError) and getattr(error.orig, "sqlstate", None) == _DEADLOCK


def _damage(error: DBAPIError) -> str | None:
    """What SQLite says of its file where that is none of its own any more."""
    code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF  # the lowest byte is the kind, the others say more of it
    return str(error.orig) if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB) else None


class Database:
    """A connection pool and its transactions.

    Use ``with database.reading() as session`` to look and ``with database.writing() as session`` to change; the
    latter commits at the end of its block, or rolls back when the block raises.
    """

    def __init__(self, url: URL, connections: int = WEB_CONNECTIONS) -> None:
        self.url = url
        self.engine = make_engine(url, connections)
        self._writer = self.engine.execution_options(writes=True)

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session that is rolled back at the end."""
        with Session(self.engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """A session in one transaction; on SQLite it holds the only write lock, so compute before entering."""
        with Session(self._writer, expire_on_commit=False) as session, session.begin():
            yield session

    def written(self, deed: Callable[[Session], Done]) -> Done:
        """Do ``deed`` in a session of `writing`, and again where that was ended as a deadlock; what it returns."""
        for _ in range(_ATTEMPTS - 1):
            try:
                with self.writing() as session:
                    return deed(session)
            except OperationalError as error:
                if not is_deadlock(error):
                    raise
                logger.info("a write and another waited for each other; it is begun again")
        with self.writing() as session:
            return deed(session)

    def upgrade(self, revision: str = "head") -> None:
        """Bring the schema up to ``revision``."""
        with self._migrating() as config:
            command.upgrade(config, revision)

    def downgrade(self, revision: str) -> None:
        """Take the schema down to ``revision`` ("base" for nothing)."""
        with self._migrating() as config:
            command.downgrade(config, revision)

    @contextmanager
    def _migrating(self) -> Iterator[Config]:
        config = alembic_config()
        with _alembic, self._writer.connect() as connection:
            config.attributes["connection"] = connection
            yield config

    def ping(self) -> None:
        """Ask the database for an answer; raises SQLAlchemy's error where there is none.

        Raises
        ------
        StoreDamagedError
            Where SQLite's file is damaged at the head of a table. Deeper down `heliotwin check` looks.
        """
        with self.telling_damage():
            with self.engine.connect() as connection:
                connection.execute(text("SELECT 1"))
            if self.url.get_backend_name() == "sqlite":
                self._look_at_file()

    def _look_at_file(self) -> None:
        fresh = create_engine(self.url, poolclass=NullPool)  # the pool's would answer out of their memory of the file
        with fresh.connect() as connection:
            for name in inspect(connection).get_table_names():
                connection.execute(text(f'SELECT 1 FROM "{name}" NOT INDEXED LIMIT 1'))

    @contextmanager
    def telling_damage(self) -> Iterator[None]:
        """Say in one line, as `StoreDamagedError`, where SQLite's file proves damaged inside the block."""
        try:
            yield
        except DBAPIError as error:
            if (said := _damage(error)) is None:
                raise
            raise StoreDamagedError(
                f"the database {self.url.database} is damaged ({said}): restore it from a back-up"
            ) from error

    def revision(self) -> str | None:
        """The schema's present version."""
        # Alembic's own question writes two lines to the log, and readiness is asked for every few seconds.
        with self.engine.connect() as connection:
            if not inspect(connection).has_table("alembic_version"):
                return None
            found: str | None = connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one_or_none()
            return found

    def revisions(self) -> list[str]:
        """All versions of the schema that this code knows, the oldest first."""
        return [script.revision for script in ScriptDirectory.from_config(alembic_config()).walk_revisions()][::-1]

    def is_current(self) -> bool:
        """Whether the schema is at the newest version that this code knows."""
        return self.revision() == ScriptDirectory.from_config(alembic_config()).get_current_head()

    def require_current(self) -> None:
        """Raise `SchemaError` unless the schema is at the newest version that this code knows."""
        if not self.is_current():
            raise SchemaError(
                f"the store's schema is at {self.revision()}, this version works with {self.revisions()[-1]}: run "
                "`heliotwin migrate`, or the version that fits"
            )
        logger.info("the store's schema is at %s, its newest version", self.revisions()[-1])

    def close(self) -> None:
        """Close all pooled connections."""
        self.engine.dispose()


def migrate(settings: Settings, to: str = "head") -> str:
    """Bring the store's schema to its newest version, or back to an older one, and return that version.

    Raises
    ------
    InvalidInputError
        Where this version knows no such revision.
    """
    database = Database(settings.database)
    try:
        known = database.revisions()
        if to not in (*known, "head"):
            raise InvalidInputError(f"--to {to}: must be head or one of {', '.join(known)}")
        is_back = to != "head" and database.revision() in known[known.index(to) :]
        (database.downgrade if is_back else database.upgrade)(to)
        return database.revision() or "base"
    finally:
        database.close()
