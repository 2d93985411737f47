"""A store with something in it, and an empty one."""

import uuid
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from sqlalchemy import URL

from service import store
from service.base.settings import Settings
from service.store import queue
from service.twin.photographs.ingest import ingest
from service.twin.runtime import Runtime
from service.twin.surfaces.prediction import predict_surface
from tests.service.conftest import (
    ORIGIN,
    POSTGRES,
    FakeOperations,
    png,
    properties_document,
    tower_document,
)
from tests.service.store.stores import PHOTOGRAPH, plain


@pytest.fixture
def runtime(store_url: URL, tmp_path: Path, operations: FakeOperations) -> Iterator[Runtime]:
    """A store with a plant, a heliostat, four photographs, a surface and a job."""
    from service.sources.documents import read_targets

    opened = Runtime.from_settings(
        Settings(data_dir=tmp_path / "data", database_url=plain(store_url)), operations
    )
    with opened.database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
        for plane in read_targets(tower_document()).values():
            store.put_target(session, plane)
        store.put_heliostat(session, "AA39", properties_document(), (0.0, 30.0, 1.0))
        queue.add_job(session, "predictions", {"heliostats": ["AA39"]}, "tester\n\\N\t'")
    for seed in range(4):
        ingest(opened, "AA39", PHOTOGRAPH, png(seed))
    predict_surface(opened, "AA39")
    ingest(opened, "AA39", PHOTOGRAPH, png(9))  # with its drift
    yield opened
    opened.close()


@pytest.fixture
def elsewhere(store_url: URL, tmp_path: Path) -> Iterator[Settings]:
    """Settings of an empty store on the same engine."""
    data_dir = tmp_path / "elsewhere"
    if store_url.get_backend_name() == "sqlite":
        yield Settings(data_dir=data_dir)
        return
    name = f"heliotwin_test_{uuid.uuid4().hex[:12]}"
    with psycopg.connect(POSTGRES, autocommit=True) as connection:
        connection.execute(f'CREATE DATABASE "{name}"')
    yield Settings(data_dir=data_dir, database_url=plain(store_url.set(database=name)))
    with psycopg.connect(POSTGRES, autocommit=True) as connection:
        connection.execute(f'DROP DATABASE "{name}" WITH (FORCE)')
