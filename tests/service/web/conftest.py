"""Services whose pages are shown."""

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.base.settings import Settings
from service.web.app import create_app
from tests.service.conftest import (
    QUIET,
    FakeOperations,
    Post,
    client_of,
    png,
    properties_document,
    tower_document,
)
from tests.service.studies import SLOPE
from tests.service.web.pages import HTML, fill, keep_study
from tests.service.web.plans import DRUM


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service with a store that `pages.fill` filled, and a study, for tests that only look."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("shown"), **QUIET)
    with client_of(create_app(settings, FakeOperations())) as client:
        client.put("/v1/plant", json=tower_document())
        client.put("/v1/heliostats/AA39", json=properties_document())
        fill(client)
        keep_study(client.app, SLOPE)  # type: ignore[arg-type]
        yield client


@pytest.fixture
def two_heliostats(client: TestClient, post: Post, properties: dict[str, Any]) -> TestClient:
    """Two heliostats, one of them with a surface, and a receiver."""
    assert post(png(1), id="101").status_code == 201
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
    assert client.put("/v1/heliostats/AB01", json=properties).status_code == 201
    assert client.put("/v1/receivers/drum", json=DRUM).status_code == 201
    client.headers.update(HTML)
    return client
