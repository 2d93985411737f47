"""What services of tests share: routes, an empty store to copy, and who writes the state of the
field.
"""

import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import URL
from sqlalchemy.orm import Session
from starlette.routing import BaseRoute

from service.base.settings import Settings
from service.jobs.kind import Kinds
from service.store import acknowledgements, field_state
from service.store.database import Database
from service.twin.alarms.field_updates import FieldStateWriter
from service.twin.runtime import Runtime
from service.web import app as web_app


@pytest.fixture(scope="session", autouse=True)
def shared_routes() -> Iterator[None]:
    """Services with the same job kinds share their routes, which hold no state."""
    made: list[tuple[Kinds, list[BaseRoute]]] = []
    collect = web_app.collect_routes

    def collect_once(kinds: Kinds) -> list[BaseRoute]:
        for known, routes in made:
            if known == kinds:
                return routes
        made.append((kinds, collect(kinds)))
        return made[-1][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(web_app, "collect_routes", collect_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def copied_schema(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A SQLite store whose file does not exist begins as a copy of an empty migrated one.

    Tests of the migrations use a file that exists (`empty_url`).
    """
    template = tmp_path_factory.mktemp("schema") / "store.sqlite"
    migrated = Database(URL.create("sqlite", database=str(template)))
    migrated.upgrade()
    migrated.close()
    upgrade = Database.upgrade

    def copy_or_upgrade(self: Database, revision: str = "head") -> None:
        if revision == "head" and self.url.get_backend_name() == "sqlite" and self.url.database:
            file = Path(self.url.database)
            if not file.exists():
                shutil.copyfile(template, file)
                return
        upgrade(self, revision)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Database, "upgrade", copy_or_upgrade)
        yield


@pytest.fixture(scope="session", autouse=True)
def written_state() -> Iterator[None]:
    """Where no workers run, the state of the field is written just before it is read."""
    writers: dict[str, FieldStateWriter] = {}
    writing = threading.RLock()
    make, close = Runtime.from_settings, Runtime.close

    def make_and_register(settings: Settings, *arguments: Any) -> Runtime:
        runtime = make(settings, *arguments)
        if not settings.job_workers:
            writers[str(runtime.database.url)] = FieldStateWriter(runtime)
        return runtime

    def close_and_forget(runtime: Runtime) -> None:
        writers.pop(str(runtime.database.url), None)
        close(runtime)

    def written_first(read: Callable[..., Any]) -> Callable[..., Any]:
        def write_and_read(session: Session, *arguments: Any) -> Any:
            url = str(session.get_bind().engine.url)
            with writing:
                writer = writers.pop(url, None)  # it reads, too
                if writer is not None:
                    write_state(writer)
                    writers[url] = writer
            return read(session, *arguments)

        return write_and_read

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Runtime, "from_settings", make_and_register)
        patch.setattr(Runtime, "close", close_and_forget)
        for module, name in (
            (field_state, "read_field_state"),
            (acknowledgements, "count_unacknowledged"),
            (acknowledgements, "list_history"),
        ):
            patch.setattr(module, name, written_first(getattr(module, name)))
        yield


def write_state(writer: FieldStateWriter) -> None:
    """Write all that is pending; of a large field only if something was stored."""
    while (writer.is_due() or not writer.is_large) and writer.update():
        pass
