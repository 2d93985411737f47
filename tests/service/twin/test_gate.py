"""The gate before the model."""

import threading

import pytest

from service.base.faults import BusyError
from service.twin.gate import Gate
from tests.service.conftest import until


def test_requests_wait_a_bounded_time_and_in_a_bounded_number():
    gate = Gate(1, most_waiting=1)
    gate.enter()
    with pytest.raises(BusyError, match="busy"):
        gate.enter(0.01)
    held = threading.Thread(target=gate.enter, args=(600.0,))
    held.start()
    until(lambda: gate._hurried == 1)
    with pytest.raises(BusyError, match="too many"):  # at once, whatever its patience
        gate.enter(600.0)
    gate.leave()
    held.join(30)
    gate.leave()
    with gate.turn(0.0):
        pass


def test_who_pauses_lets_those_first_that_wait():
    gate, seen = Gate(1), []

    def other() -> None:
        with gate.turn():
            seen.append("another")

    with gate.turn():
        thread = threading.Thread(target=other)
        thread.start()
        until(lambda: len(gate._line) == 1)
        gate.pause()
        seen.append("the study")
    thread.join(30)
    assert seen == ["another", "the study"]


def test_a_closed_gate_turns_requests_away_and_lets_jobs_in():
    gate, told = Gate(1), []

    def hurried() -> None:
        with pytest.raises(BusyError, match="stopping") as refused:
            gate.enter(600.0)
        told.append(str(refused.value))

    gate.enter()
    waiting = threading.Thread(target=hurried)
    waiting.start()
    until(lambda: gate._hurried == 1)
    gate.close()
    waiting.join(30)
    assert len(told) == 1
    gate.leave()
    with pytest.raises(BusyError, match="stopping"):
        gate.enter(1.0)
    with gate.turn():
        pass


def test_what_a_thread_that_hangs_holds_is_given_back_once():
    gate, woken = Gate(1), threading.Event()

    def hang() -> None:
        with gate.turn():
            woken.wait(30)

    thread = threading.Thread(target=hang)
    thread.start()
    until(lambda: gate._free == 0)
    assert thread.ident is not None
    gate.forget(thread.ident)
    with gate.turn(0.0):
        woken.set()
        thread.join(30)
        with pytest.raises(BusyError):
            gate.enter(0.01)
    assert gate._free == 1
