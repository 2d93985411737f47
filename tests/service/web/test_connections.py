"""The pool of database connections: enough for workers and requests, and an answer where all are
busy.
"""

from contextlib import ExitStack

import pytest

from service.base.settings import Settings
from service.store import keys
from service.twin.runtime import Runtime
from service.web.app import create_app
from tests.service.conftest import FakeOperations, client_of


def hold(runtime: Runtime, count: int, held: ExitStack) -> None:
    for _ in range(count):
        held.enter_context(runtime.database.engine.connect())


def test_requests_are_answered_beside_64_workers(settings: Settings):
    """Each of them holds two connections, and 40 threads of requests one each."""
    runtime = Runtime.from_settings(
        settings.model_copy(update={"job_workers": 64}), FakeOperations()
    )
    runtime.database.engine.pool._timeout = 0.2  # type: ignore[attr-defined]
    try:
        with ExitStack() as held:
            hold(runtime, 2 * 64 + 40, held)
            runtime.database.ping()
    finally:
        runtime.close()


@pytest.mark.parametrize("headers", [{}, {"Authorization": "Bearer htw_000000000000_" + "A" * 43}])
def test_busy_pool_is_answered_with_when_to_come_again(settings: Settings, headers: dict[str, str]):
    app = create_app(settings.model_copy(update={"database_connections": 8}), FakeOperations())
    with client_of(app) as client, ExitStack() as held:
        runtime = app.state.runtime
        if headers:  # the door itself asks the database then
            with runtime.database.writing() as session:
                keys.create(session, "reader", "read", "tester")
        runtime.database.engine.pool._timeout = 0.1
        hold(runtime, 8, held)
        answer = client.get("/v1/targets", headers=headers)
    assert (answer.status_code, answer.headers.get("Retry-After")) == (503, "5")
    assert "busy" in answer.json()["detail"]
