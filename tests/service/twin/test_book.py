"""What is worked out in the background: once for each key, whoever asks meanwhile."""

import threading
from typing import Any

import pytest
from fastapi.testclient import TestClient

from service.twin import field
from service.twin.book import Book
from tests.service.conftest import FakeOperations, Post, png


def test_what_is_under_way_is_neither_queued_again_nor_done_twice():
    began, go, done = threading.Event(), threading.Event(), []

    def work(key: str) -> str:
        began.set()
        go.wait(30)
        done.append(key)
        return key.upper()

    book: Book[str, str] = Book(work, "", "test", 10)
    assert book.look_up(["a", "b"]) == ({}, 2)
    assert began.wait(30)
    # As a page asks that looks again before its first answer is there.
    assert book.look_up(["a", "b"]) == ({}, 2)
    assert book.wait_for("a", 0) is None
    go.set()
    assert (book.wait_for("a", 30), book.wait_for("b", 30)) == ("A", "B")
    book.close()
    assert done == ["a", "b"]


def test_what_fails_has_an_answer_too_and_the_rest_is_done():
    def work(key: int) -> float:
        return 1 / key

    book: Book[int, float] = Book(work, -1.0, "test", 2)
    assert [book.wait_for(key, 30) for key in (0, 1, 2)] == [-1.0, 1.0, 0.5]
    assert book.look_up([0, 1, 2])[0] == {1: 1.0, 2: 0.5}
    book.close()
    assert book.wait_for(4, 30) is None


def test_who_waits_a_while_has_what_is_quick():
    book: Book[int, int] = Book(lambda key: 2 * key, 0, "test", 10)
    assert book.look_up([1, 2, 3], 30) == ({1: 2, 2: 4, 3: 6}, 0)
    book.close()


def test_the_field_reads_one_version_of_each_heliostat(client: TestClient, post: Post, monkeypatch: pytest.MonkeyPatch):
    for number in range(1, 4):
        assert post(png(number), sun_azimuth=-10.0 * number).status_code == 201
        assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
    read = []

    def counted(*values: Any) -> Any:
        read.append(values)
        return current(*values)

    current = field.Current
    monkeypatch.setattr(field, "Current", counted)
    with client.app.state.runtime.database.reading() as session:  # type: ignore[attr-defined]
        (line,) = field.read_lines(session)
    assert line.surface is not None
    assert line.surface.version == 3
    assert len(read) == 1


def test_the_heliostats_page_is_traced_once_for_what_it_depends_on(
    client: TestClient, post: Post, operations: FakeOperations
):
    assert post(png(1)).status_code == 201
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201

    def traced(path: str = "/heliostats/AA39") -> int:
        before = operations.rendered
        page = client.get(path, headers={"Accept": "text/html"})
        assert 'alt="measured flux of' in page.text
        return operations.rendered - before

    assert [traced(), traced(), traced()] == [1, 0, 0]
    assert post(png(2), sun_azimuth=-30.0).status_code == 201
    assert [traced(), traced()] == [1, 0]
    assert client.post("/v1/heliostats/AA39/surfaces", json={}).status_code == 201
    assert [traced(), traced(), traced("/heliostats/AA39?version=1")] == [1, 0, 0]
