"""Compute slots."""

import threading

import pytest

from service.base.errors import BusyError
from service.twin.slots import ComputeSlots, as_caller
from tests.service.conftest import until
from tests.waiting import WAIT_LIMIT_S


def test_requests_wait_a_bounded_time_and_in_a_bounded_number():
    slots = ComputeSlots(1, max_waiting=1)
    slots.enter()
    with pytest.raises(BusyError, match="busy"):
        slots.enter(0.01)
    held = threading.Thread(target=slots.enter, args=(600.0,))
    held.start()
    until(lambda: slots._n_requests_waiting == 1)
    with pytest.raises(BusyError, match="too many"):  # at once, whatever its patience
        slots.enter(600.0)
    slots.leave()
    held.join(WAIT_LIMIT_S)
    slots.leave()
    with slots.slot(0.0):
        pass


def test_who_pauses_lets_those_first_that_wait():
    slots, seen = ComputeSlots(1), []

    def other() -> None:
        with slots.slot():
            seen.append("another")

    with slots.slot():
        thread = threading.Thread(target=other)
        thread.start()
        until(lambda: len(slots._queue) == 1)
        slots.pause()
        seen.append("the study")
    thread.join(WAIT_LIMIT_S)
    assert seen == ["another", "the study"]


def test_closed_slots_turn_requests_away_and_lets_jobs_in():
    slots, refusals = ComputeSlots(1), []

    def hurried() -> None:
        with pytest.raises(BusyError, match="stopping") as refused:
            slots.enter(600.0)
        refusals.append(str(refused.value))

    slots.enter()
    waiting = threading.Thread(target=hurried)
    waiting.start()
    until(lambda: slots._n_requests_waiting == 1)
    slots.close()
    waiting.join(WAIT_LIMIT_S)
    assert len(refusals) == 1
    slots.leave()
    with pytest.raises(BusyError, match="stopping"):
        slots.enter(1.0)
    with slots.slot():
        pass


def test_what_a_thread_that_hangs_holds_is_given_back_once():
    slots, woken = ComputeSlots(1), threading.Event()

    def hang() -> None:
        with slots.slot():
            woken.wait(WAIT_LIMIT_S)

    thread = threading.Thread(target=hang)
    thread.start()
    until(lambda: slots._free == 0)
    assert thread.ident is not None
    slots.forget(thread.ident)
    with slots.slot(0.0):
        woken.set()
        thread.join(WAIT_LIMIT_S)
        with pytest.raises(BusyError):
            slots.enter(0.01)
    assert slots._free == 1


def _served(slots: ComputeSlots, callers: list[str]) -> list[str]:
    """The order in which callers are let in that came in this order, while the only
    slot was held.
    """
    order: list[str] = []
    slots.enter()

    def use(caller: str) -> None:
        with as_caller(caller), slots.slot(600.0):
            order.append(caller)

    threads = [threading.Thread(target=use, args=(caller,)) for caller in callers]
    for count, thread in enumerate(threads, 1):
        thread.start()
        until(lambda count=count: len(slots._queue) == count)  # type: ignore[misc]
    slots.leave()
    for thread in threads:
        thread.join(30)
    return order


def test_keys_are_served_one_after_the_other():
    """First come, first served: a victim waited for all that a greedy key had sent."""
    sent = ["greedy"] * 5 + ["victim", "other", "victim"]
    assert _served(ComputeSlots(1), sent) == [
        "greedy",
        "victim",
        "other",
        "greedy",
        "victim",
        "greedy",
        "greedy",
        "greedy",
    ]


def test_jobs_are_one_caller_among_the_keys():
    assert _served(ComputeSlots(1), ["", "", "", "reader"]) == ["", "reader", "", ""]


def test_who_gives_up_leaves_its_key_s_place_to_the_next():
    slots, order = ComputeSlots(1), []
    slots.enter()
    with as_caller("hasty"), pytest.raises(BusyError):
        slots.enter(0.01)
    assert len(slots._queue) == 0

    def use() -> None:
        with as_caller("hasty"), slots.slot(600.0):
            order.append("hasty")

    thread = threading.Thread(target=use)
    thread.start()
    until(lambda: len(slots._queue) == 1)
    slots.leave()
    thread.join(30)
    assert order == ["hasty"]


def test_cancelled_pause_releases_its_slot_once():
    slots, running = ComputeSlots(1), threading.Event()

    def other() -> None:
        with slots.slot():
            running.set()
            until(lambda: cancelled)

    cancelled: list[str] = []

    def cancel() -> None:
        if running.is_set():
            cancelled.append("cancelled")
            raise KeyboardInterrupt

    def cancelled_study() -> None:
        with slots.slot():
            thread.start()
            until(lambda: len(slots._queue) == 1)
            slots.pause(cancel)

    thread = threading.Thread(target=other)
    with pytest.raises(KeyboardInterrupt):
        cancelled_study()
    thread.join(WAIT_LIMIT_S)
    with slots.slot(0.0), pytest.raises(BusyError):
        slots.enter(0.0)
