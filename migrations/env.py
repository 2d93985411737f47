"""How Alembic reaches the database: the connection that `service.store.database` hands in, or one
from the settings.
"""

from alembic import context
from sqlalchemy import Connection, text

from service.base.settings import Settings
from service.store import job_tables, tables  # noqa: F401 - the metadata knows what was loaded
from service.store.columns import Base
from service.store.database import make_engine

# Any fixed number: it names the lock that lets one migration run at a time on PostgreSQL.
_MIGRATION_LOCK = 0x68656C696F


def _migrate(connection: Connection) -> None:
    is_sqlite = connection.dialect.name == "sqlite"
    context.configure(
        connection=connection,
        target_metadata=Base.metadata,
        render_as_batch=is_sqlite,
        transactional_ddl=True,  # on SQLite too: service.store.database begins real transactions
    )
    with context.begin_transaction():
        if not is_sqlite:
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _MIGRATION_LOCK})
        context.run_migrations()


def _run() -> None:
    connection = context.config.attributes.get("connection")
    if connection is not None:
        _migrate(connection)
        return
    engine = make_engine(Settings().database)
    with engine.execution_options(writes=True).connect() as own:
        _migrate(own)
    engine.dispose()


_run()
