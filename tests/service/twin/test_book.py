"""Background computations: once for each key, however many requests arrive meanwhile."""

import threading
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.twin.alarms import field_overview
from service.twin.caches import BackgroundCache
from tests.service.conftest import FakeOperations, Post, png, sun_at
from tests.waiting import WAIT_LIMIT_S


def test_what_is_under_way_is_neither_queued_again_nor_done_twice():
    began, go, done = threading.Event(), threading.Event(), []

    def work(key: str) -> str:
        began.set()
        go.wait(WAIT_LIMIT_S)
        done.append(key)
        return key.upper()

    cache: BackgroundCache[str, str] = BackgroundCache(work, "", "test", 10)
    assert cache.wait_for("a", 0) is None
    assert began.wait(WAIT_LIMIT_S)
    # As a page asks that looks again before its first answer is there.
    assert [cache.wait_for(key, 0) for key in ("a", "b", "c", "b")] == [None] * 4
    go.set()
    assert [cache.wait_for(key, WAIT_LIMIT_S) for key in "abc"] == ["A", "B", "C"]
    cache.close()
    assert done == ["a", "b", "c"]


def test_what_fails_has_an_answer_too_and_the_rest_is_done():
    def work(key: int) -> float:
        return 1 / key

    cache: BackgroundCache[int, float] = BackgroundCache(work, -1.0, "test", 2)
    assert [cache.wait_for(key, WAIT_LIMIT_S) for key in (0, 1, 2)] == [-1.0, 1.0, 0.5]
    assert [cache.wait_for(key, 0) for key in (1, 2)] == [1.0, 0.5]
    cache.close()
    assert cache.wait_for(4, WAIT_LIMIT_S) is None


def test_the_field_reads_one_version_of_each_heliostat(
    client: TestClient, post: Post, monkeypatch: pytest.MonkeyPatch
):
    for number in range(1, 4):
        assert post(png(number), sun=sun_at(180 + 10.0 * number)).status_code == 201
        assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
    read = []

    def counted(surface: Any, *values: Any) -> None:
        read.append(values)
        begin(surface, *values)

    begin = field_overview.ActiveSurface.__init__
    monkeypatch.setattr(field_overview.ActiveSurface, "__init__", counted)
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        (line,) = field_overview.read_summaries(session)
    assert line.surface is not None
    assert line.surface.version == 3
    assert len(read) == 1


@pytest.mark.full
def test_the_heliostats_page_is_traced_once_for_what_it_depends_on(
    client: TestClient, post: Post, operations: FakeOperations
):
    assert post(png(1)).status_code == 201
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201

    def traced(path: str = "/heliostats/AA39") -> int:
        client.get("/v1/alarms")  # traced for the state of the field
        before = operations.rendered
        page = client.get(path, headers={"Accept": "text/html"})
        assert 'alt="measured flux of' in page.text
        return operations.rendered - before

    assert [traced(), traced(), traced()] == [1, 0, 0]
    assert post(png(2), sun=sun_at(210.0)).status_code == 201
    assert [traced(), traced()] == [1, 0]
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
    assert [traced(), traced(), traced("/heliostats/AA39?version=1")] == [1, 0, 0]
