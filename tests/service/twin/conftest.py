"""A service on a dense field."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import URL

from service.base.settings import Settings
from service.web.app import create_app
from tests.service.conftest import QUIET, client_of
from tests.service.twin.fields import fill


@pytest.fixture
def field(store_url: URL, tmp_path: Path) -> Iterator[TestClient]:
    url = store_url.render_as_string(hide_password=False).replace("+psycopg", "")
    app = create_app(Settings(data_dir=tmp_path / "data", database_url=url, **QUIET))
    with client_of(app) as client:
        fill(app.state.runtime.database)
        yield client
