"""Results of the last seconds."""

import threading

import pytest

from service.twin.caches import RecentResults
from tests.service.conftest import until


def test_result_is_computed_once_for_all_who_ask_at_the_same_time():
    recent, computed, go = RecentResults(600.0), [], threading.Event()

    def make() -> int:
        computed.append(1)
        go.wait(30)
        return len(computed)

    found: list[int] = []
    threads = [
        threading.Thread(target=lambda: found.append(recent.get("key", make))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    until(lambda: bool(computed))
    go.set()
    for thread in threads:
        thread.join(30)
    assert found == [1] * 4
    assert recent.get("another", lambda: "x") == "x"


def test_old_results_and_errors_are_not_kept():
    recent = RecentResults(0.0)
    assert [recent.get("key", lambda number=number: number) for number in range(3)] == [0, 1, 2]  # type: ignore[misc]
    kept = RecentResults(600.0)
    with pytest.raises(ZeroDivisionError):
        kept.get("key", lambda: 1 // 0)
    assert kept.get("key", lambda: 1) == 1
