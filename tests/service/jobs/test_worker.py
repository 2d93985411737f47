"""The queue: each job ends exactly once, also if workers die, race, fail or are stopped."""

import itertools
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import URL, select, update
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from service.base.errors import ConflictError, TooManyError
from service.base.settings import Settings
from service.jobs import heartbeat
from service.jobs.enqueuing import enqueue
from service.jobs.kinds.predictions import EACH_S
from service.jobs.worker import Worker, Workers, pause_s
from service.store import queue
from service.store.database import Database
from service.store.job_tables import AuditRow, JobRow
from service.twin.runtime import Runtime
from service.twin.slots import ComputeSlots
from tests.forked import ForkedProcess, forked_process
from tests.service import job_kinds, real
from tests.service.conftest import FakeOperations
from tests.service.job_kinds import NEXT_PART, TEST_KINDS, WOKEN, SquareIn
from tests.waiting import WAIT_LIMIT_S, child_process, until

ROOT = Path(__file__).parents[3]
KINDS = ("squares",)


@pytest.fixture
def runtime(store_url: URL, tmp_path: Path, operations: FakeOperations) -> Iterator[Runtime]:
    settings = Settings(
        data_dir=tmp_path / "data",
        database_url=store_url.render_as_string(hide_password=False).replace("+psycopg", ""),
        # No thread has to renew it in time on a busy machine; `expire` ends it.
        job_lease_s=600.0,
        job_poll_s=0.05,
        job_retry_s=0.05,
    )
    opened = Runtime.from_settings(settings, operations)
    yield opened
    opened.close()


def ask(runtime: Runtime, **payload: Any) -> int:
    with runtime.database.writing() as session:
        return queue.add_job(session, "squares", payload, "tester")[0].id


def ask_kind(runtime: Runtime, **payload: Any) -> int:
    """Enqueue a job as a request does, by its kind; its payload decides whether it is short."""
    return enqueue(runtime, TEST_KINDS["squares"], SquareIn(**payload), "tester").row.id


def look(runtime: Runtime, number: int) -> JobRow:
    with runtime.database.reading() as session:
        return queue.get_job(session, number, arrays=True)


def marks(runtime: Runtime) -> list[str]:
    """The marks that parts of jobs left in the store."""
    with runtime.database.reading() as session:
        return sorted(session.scalars(select(AuditRow.subject).where(AuditRow.action == "part")))


def ended(runtime: Runtime, number: int) -> JobRow:
    until(lambda: look(runtime, number).state in queue.ENDED)
    return look(runtime, number)


@contextmanager
def working(runtime: Runtime, count: int = 1) -> Iterator[Workers]:
    workers = Workers(runtime, TEST_KINDS, count)
    workers.start()
    try:
        yield workers
    finally:
        workers.stop()


def job_threads() -> list[threading.Thread]:
    """The threads that work at jobs; their hearts have other names."""
    return [thread for thread in threading.enumerate() if thread.name.startswith("job-")]


def claim(
    database: Database, worker: str = "w", lease_s: float = 60.0, attempts: int = 3
) -> JobRow | None:
    with database.writing() as session:
        return queue.claim(session, KINDS, worker, lease_s, attempts)


def expire(database: Database) -> None:
    """Let all leases run out, as after a long silence."""
    with database.writing() as session:
        session.execute(
            update(JobRow).values(lease_until=queue.database_time(session) - timedelta(seconds=1))
        )


# --- the queue
# --------------------------------------------------------------------------------------------------


def test_oldest_job_is_taken_first_and_only_once(runtime: Runtime):
    first, second = ask(runtime), ask(runtime)
    taken = [claim(runtime.database) for _ in range(3)]
    assert [None if row is None else row.id for row in taken] == [first, second, None]


def test_other_kinds_are_left_alone(runtime: Runtime):
    with runtime.database.writing() as session:
        queue.add_job(session, "triangles", {}, "tester")
    assert claim(runtime.database) is None


def test_job_that_another_holds_is_skipped_without_waiting(runtime: Runtime):
    """On PostgreSQL two claims at a time take different jobs; on SQLite the second waits for the
    first.
    """
    numbers = {ask(runtime) for _ in range(20)}
    found: list[int] = []

    def take() -> None:
        while (row := claim(runtime.database)) is not None:
            found.append(row.id)

    threads = [threading.Thread(target=take) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(found) == sorted(numbers)


def test_late_worker_writes_nothing(runtime: Runtime):
    """Its lease ran out and another has the job: neither result, progress, part nor heartbeat is
    taken from it.
    """
    number = ask(runtime)
    late = claim(runtime.database, "late")
    assert late is not None
    old = queue.lease_of(late)
    expire(runtime.database)
    fresh = claim(runtime.database, "fresh")
    assert fresh is not None
    writes: list[Callable[[Any], Any]] = [
        lambda session: queue.finish(session, old, {"of": "late"}),
        lambda session: queue.report(session, old, queue.Progress(0.5, "late")),
        lambda session: queue.renew(session, old, 60),
        lambda session: queue.save_checkpoint(session, old, "part", {}),
        lambda session: queue.fail(session, old, "late"),
        lambda session: queue.stop(session, old),
        lambda session: queue.retry(session, old, "late", 0),
        lambda session: queue.release(session, old),
    ]
    for write in writes:
        with pytest.raises(queue.LeaseLostError), runtime.database.writing() as session:
            write(session)
    with runtime.database.writing() as session:
        queue.finish(session, queue.lease_of(fresh), {"of": "fresh"})
    row = look(runtime, number)
    assert (row.state, row.result, row.attempts, row.worker) == (
        "done",
        {"of": "fresh"},
        2,
        "fresh",
    )


def test_renewed_lease_is_kept(runtime: Runtime):
    ask(runtime)
    row = claim(runtime.database)
    assert row is not None
    expire(runtime.database)
    with runtime.database.writing() as session:
        assert queue.renew(session, queue.lease_of(row), 60) is False
    assert claim(runtime.database) is None


def test_job_that_loses_its_workers_ends_failed(runtime: Runtime):
    number = ask(runtime)
    for attempt in range(3):
        assert claim(runtime.database, f"w{attempt}") is not None
        expire(runtime.database)
    assert claim(runtime.database) is None
    row = look(runtime, number)
    assert (row.state, row.reason) == ("failed", "its worker was lost 3 times, the last one w2")
    assert row.finished_at is not None


def test_same_idempotency_key_is_the_same_job(runtime: Runtime):
    def add(payload: dict[str, Any], sender: str = "a") -> tuple[int, bool]:
        with runtime.database.writing() as session:
            row, is_new = queue.add_job(session, "squares", payload, sender, "key-1")
            return row.id, is_new

    first, is_new = add({"value": 1})
    assert is_new
    assert add({"value": 1}) == (first, False)
    assert add({"value": 1}, "b") != (first, False)
    with pytest.raises(InvalidInputError, match=f"job {first}"):
        add({"value": 2})


def test_racing_requests_with_one_key_make_one_job(runtime: Runtime):
    numbers: list[int] = []

    def add() -> None:
        with runtime.database.writing() as session:
            numbers.append(queue.add_job(session, "squares", {}, "a", "key-1")[0].id)

    threads = [threading.Thread(target=add) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(numbers) == 6
    assert len(set(numbers)) == 1


def test_queue_has_a_bound_in_total_and_for_each_key(runtime: Runtime):
    bounds = queue.QueueBounds(queued=3, queued_of_key=2)

    def add(key: str) -> None:
        queue.add_job(session, "squares", {}, key, bounds=bounds)

    with runtime.database.writing() as session:
        add("greedy")
        add("greedy")
        with pytest.raises(TooManyError, match="2 jobs of key greedy are waiting"):
            add("greedy")
        add("victim")
        with pytest.raises(TooManyError, match="3 jobs are waiting"):
            add("another")


def test_keys_take_turns_independent_of_their_queued_jobs(runtime: Runtime):
    """A thousand jobs of one key shut all others out: the oldest job of all was taken first."""
    with runtime.database.writing() as session:
        for key in ["greedy"] * 5 + ["victim"] * 2 + ["other"]:
            queue.add_job(session, "squares", {}, key)
    taken = [row.created_by for _ in range(8) if (row := claim(runtime.database)) is not None]
    assert taken == ["greedy", "victim", "other", "greedy", "victim", "greedy", "greedy", "greedy"]


def test_worker_for_short_jobs_leaves_the_long_ones_alone(runtime: Runtime):
    ask(runtime)
    with runtime.database.writing() as session:
        short = queue.add_job(session, "squares", {}, "tester", is_short=True)[0].id
    with runtime.database.writing() as session:
        assert queue.has_claimable(session, KINDS, 60.0, only_short=True)
        row = queue.claim(session, KINDS, "w", 60.0, 3, only_short=True)
        assert row is not None
        assert row.id == short
        assert not queue.has_claimable(session, KINDS, 60.0, only_short=True)


def test_short_job_does_not_wait_for_a_long_one(runtime: Runtime):
    """0.5 s of work waited 41 s behind a job that took as long."""
    long = ask_kind(runtime, value=2, steps=1000, pause_s=0.05)
    with working(runtime):
        until(lambda: len(marks(runtime)) >= 1)
        short = ask_kind(runtime, value=3)
        assert ended(runtime, short).result == {"square": 9}
        assert look(runtime, long).state == "running"
        cancel(runtime, long)


def test_attempts_count_again_from_each_part_that_was_done(runtime: Runtime):
    """Each attempt does one part and fails: with three attempts in all, a job of six parts never
    came to its end.
    """
    number = ask(runtime, value=4, steps=6, stumbles=True)
    with working(runtime):
        row = ended(runtime, number)
    assert (row.state, row.result, row.attempts) == ("done", {"square": 16}, 7)
    assert marks(runtime) == [str(part) for part in range(6)]


def test_lost_workers_count_again_from_each_part_that_was_done(runtime: Runtime):
    number = ask(runtime)
    for part in range(5):
        row = claim(runtime.database, attempts=2)
        assert row is not None
        with runtime.database.writing() as session:
            queue.save_checkpoint(session, queue.lease_of(row), str(part), {})
        expire(runtime.database)
    assert claim(runtime.database, attempts=2) is not None
    expire(runtime.database)
    assert claim(runtime.database, attempts=2) is None
    assert look(runtime, number).reason == "its worker was lost 2 times, the last one w"


def test_job_reports_phase_counts_and_remaining_time(runtime: Runtime):
    number = ask(runtime, steps=1000, pause_s=0.05)
    with working(runtime):
        until(lambda: bool(look(runtime, number).n_done))
        row = look(runtime, number)
        cancel(runtime, number)
        ended(runtime, number)
    assert (row.phase, row.n_total) == ("parts", 1000)
    assert row.n_done is not None
    assert row.n_done > 0
    assert row.progress == pytest.approx(row.n_done / 1000)
    assert row.remaining_s is not None
    assert row.remaining_s > 0
    assert look(runtime, number).remaining_s is None


@pytest.mark.full
def test_prediction_reports_its_phases_and_an_estimate_from_the_beginning(
    real_client: TestClient, monkeypatch: pytest.MonkeyPatch
):
    seen: list[queue.Progress] = []

    def note(session: Any, lease: Any, progress: queue.Progress) -> bool:
        seen.append(progress)
        return False

    monkeypatch.setattr("service.jobs.kind.queue.report", note)
    real.run_job(real_client, "/v1/jobs/predictions", heliostats=["AC43"], images=2)
    phases = list(dict.fromkeys(one.phase for one in seen))
    assert (phases[0], *phases[-2:]) == (
        "reading photographs",
        "comparing with the active surface",
        "storing",
    )
    shares = [one.share for one in seen]
    assert shares == sorted(shares)
    assert shares[-1] < 1
    assert seen[0].remaining_s == pytest.approx(EACH_S["network"])


def test_job_that_only_checks_whether_it_shall_end_learns_soon_that_it_was_cancelled(
    runtime: Runtime,
):
    """It learned that every ten seconds, by its heartbeat: 62 s passed until a refinement ended."""
    patient = replace(runtime, settings=runtime.settings.model_copy(update={"job_lease_s": 3600.0}))
    number = ask(patient, checks=True)
    with working(patient):
        until(lambda: look(patient, number).state == "running")
        cancel(patient, number)
        assert ended(patient, number).state == "cancelled"


def test_pause_doubles_is_spread_and_bounded():
    generator = random.Random(0)
    for attempt, longest in ((1, 5), (2, 10), (3, 20), (20, 600)):
        pauses = [pause_s(attempt, 5.0, generator) for _ in range(100)]
        assert longest / 2 <= min(pauses) < max(pauses) <= longest
        assert len(set(pauses)) > 90


# --- cancelling
# --------------------------------------------------------------------------------------------------


def cancel(runtime: Runtime, number: int) -> str:
    with runtime.database.writing() as session:
        return queue.cancel(session, number).state


def test_waiting_job_is_cancelled_at_once(runtime: Runtime):
    number = ask(runtime)
    assert cancel(runtime, number) == "cancelled"
    assert cancel(runtime, number) == "cancelled"
    assert claim(runtime.database) is None


def test_running_job_ends_at_its_next_report(runtime: Runtime):
    number = ask(runtime, steps=1000, pause_s=0.05)
    with working(runtime):
        until(lambda: len(marks(runtime)) >= 2)
        assert cancel(runtime, number) == "running"
        row = ended(runtime, number)
    assert (row.state, row.result) == ("cancelled", None)
    assert len(marks(runtime)) < 1000


def test_job_whose_worker_died_can_be_cancelled(runtime: Runtime):
    number = ask(runtime)
    claim(runtime.database)
    assert cancel(runtime, number) == "running"
    expire(runtime.database)
    assert claim(runtime.database) is None
    assert look(runtime, number).state == "cancelled"


def test_job_that_has_ended_cannot_be_cancelled(runtime: Runtime):
    number = ask(runtime, value=3)
    with working(runtime):
        assert ended(runtime, number).result == {"square": 9}
    with pytest.raises(ConflictError, match="done"):
        cancel(runtime, number)


# --- workers
# --------------------------------------------------------------------------------------------------


@pytest.mark.full
def test_racing_workers_do_every_job_once(runtime: Runtime):
    numbers = [ask(runtime, value=value, steps=1) for value in range(40)]
    with working(runtime, 2), working(runtime, 2):
        for number in numbers:
            ended(runtime, number)
    rows = [look(runtime, number) for number in numbers]
    assert [row.result for row in rows] == [{"square": value**2} for value in range(40)]
    assert {row.attempts for row in rows} == {1}
    assert len(marks(runtime)) == 40


def test_fault_is_tried_again_and_its_reason_forgotten(runtime: Runtime):
    number = ask(runtime, value=4, fails=2)
    with working(runtime):
        row = ended(runtime, number)
    assert (row.state, row.result, row.attempts, row.reason) == ("done", {"square": 16}, 3, None)


def test_fault_that_stays_fails_the_job_and_shows_nothing_of_the_inside(runtime: Runtime):
    poison, healthy = ask(runtime, fails=99), ask(runtime, value=2)
    with working(runtime):
        row = ended(runtime, poison)
        assert ended(runtime, healthy).state == "done"
    assert (row.state, row.attempts) == ("failed", 3)
    assert row.reason is not None
    assert row.reason.startswith("failed 3 times, the last time by OperationalError;")
    assert "secret" not in row.reason


def test_wrong_input_fails_at_once(runtime: Runtime):
    number = ask(runtime, refuses=True)
    with working(runtime):
        row = ended(runtime, number)
    assert (row.state, row.attempts, row.reason) == ("failed", 1, "value: it is refused")


def test_payload_of_another_version_fails(runtime: Runtime):
    number = ask(runtime, unknown=1)
    with working(runtime):
        row = ended(runtime, number)
    assert (row.state, row.attempts) == ("failed", 1)
    assert "payload" in (row.reason or "")


def test_result_that_cannot_be_stored_fails_the_job(runtime: Runtime):
    """NaN is no JSON: PostgreSQL refuses it, and the worker lives on. SQLite keeps text, so it
    takes it.
    """
    number, healthy = ask(runtime, result="nan"), ask(runtime, value=2)
    with working(runtime):
        row = ended(runtime, number)
        assert ended(runtime, healthy).state == "done"
    if runtime.database.url.get_backend_name() == "postgresql":
        assert (row.state, row.reason) == (
            "failed",
            "its result cannot be stored; the worker's log has more",
        )


def test_heartbeat_keeps_a_job_that_outlasts_its_lease(
    runtime: Runtime, monkeypatch: pytest.MonkeyPatch
):
    """The store's clock goes on by half a lease with each heartbeat, while another worker looks for
    work.
    """
    late, renewals, clock, renew = timedelta(), itertools.count(), queue.database_time, queue.renew

    def beat(session: Session, lease: queue.Lease, lease_s: float) -> bool:
        nonlocal late
        is_cancelled = renew(session, lease, lease_s)
        if next(renewals) < 6:
            late += timedelta(seconds=lease_s / 2)
            NEXT_PART.release()
        return is_cancelled

    monkeypatch.setattr(queue, "database_time", lambda session: clock(session) + late)
    monkeypatch.setattr(queue, "renew", beat)
    monkeypatch.setattr(heartbeat, "_BEATS_PER_LEASE", 6000)
    number = ask(runtime, steps=6, by_hand=True)
    with working(runtime, 2):
        row = ended(runtime, number)
    assert (row.state, row.attempts) == ("done", 1)
    assert late == timedelta(seconds=3 * runtime.settings.job_lease_s)


@pytest.fixture
def impatient(runtime: Runtime, monkeypatch: pytest.MonkeyPatch) -> Iterator[Runtime]:
    """A runtime whose worker abandons jobs without a sign of life for ten minutes.

    Jobs that hang pretend that their last sign of life was an hour ago. The worker checks them
    several times a second. At the end they continue.
    """
    monkeypatch.setattr(heartbeat, "_BEATS_PER_LEASE", 3000)
    changed = {"job_silence_s": 600.0}
    yield replace(
        runtime, settings=runtime.settings.model_copy(update=changed), compute_slots=ComputeSlots(1)
    )
    WOKEN.set()
    until(lambda: not job_threads())
    WOKEN.clear()


def test_hanging_job_is_stopped_and_its_worker_replaced(impatient: Runtime):
    """The heart beats on, which is no sign of life; the place before the model is free again, and
    stays one.
    """
    once, always, healthy = (
        ask(impatient, value=3, hangs=1),
        ask(impatient, hangs=99),
        ask(impatient, value=2),
    )
    with working(impatient):
        rows = [ended(impatient, number) for number in (once, healthy, always)]
        WOKEN.set()
    assert [(row.state, row.result, row.attempts) for row in rows] == [
        ("done", {"square": 9}, 2),
        ("done", {"square": 4}, 1),
        ("failed", None, 3),
    ]
    assert (rows[2].reason or "").startswith(
        "failed 3 times, the last time by no sign of life for 600 s;"
    )
    until(lambda: not job_threads())
    assert impatient.compute_slots._free == 1  # those that woke gave nothing back twice
    assert look(impatient, always).state == "failed"


def test_workers_stop_while_one_of_them_is_being_replaced(
    impatient: Runtime, monkeypatch: pytest.MonkeyPatch
):
    """Stopping waits for the thread that is about to begin; it was an error to wait for one that
    had not begun.
    """
    begins, go, start = threading.Event(), threading.Event(), threading.Thread.start

    def start_late(thread: threading.Thread) -> None:
        if thread.name == "job-2":  # job-1 does short jobs only
            begins.set()
            go.wait(WAIT_LIMIT_S)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_late)
    ask(impatient, hangs=1)
    workers = Workers(impatient, TEST_KINDS, 1)
    workers.start()
    until(begins.is_set)
    with ThreadPoolExecutor(1) as pool:
        stopping = pool.submit(workers.stop)
        done, _ = wait([stopping], timeout=1.0)
        go.set()
        assert not done, stopping.exception()
        stopping.result(WAIT_LIMIT_S)
    WOKEN.set()
    until(lambda: not job_threads())


@pytest.mark.full
def test_job_that_reports_is_never_stopped_as_hanging(impatient: Runtime):
    number = ask(impatient, value=5, steps=8, pause_s=0.4, quiet_s=300.0)
    with working(impatient):
        row = ended(impatient, number)
    assert (row.state, row.attempts) == ("done", 1)


def test_stopped_worker_puts_its_job_back(runtime: Runtime):
    number = ask(runtime, value=5, steps=4, halts_at=1)
    with working(runtime):
        until(lambda: len(marks(runtime)) >= 1)
    row = look(runtime, number)
    assert (row.state, row.attempts, row.lease_token) == ("queued", 0, None)
    with working(runtime):
        assert ended(runtime, number).result == {"square": 25}
    assert marks(runtime) == ["0", "1", "2", "3"]


def away_twice(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The database does not answer the first two calls of this function of
    `service.store.queue`.
    """
    real, calls = getattr(queue, name), itertools.count(1)

    def fails_twice(*arguments: Any) -> Any:
        if next(calls) <= 2:
            raise OperationalError("SELECT 1", {}, Exception("away"))
        return real(*arguments)

    monkeypatch.setattr(queue, name, fails_twice)


def test_an_end_that_cannot_be_stored_at_all_is_tried_with_pauses_until_the_worker_stops(
    runtime: Runtime, monkeypatch: pytest.MonkeyPatch
):
    tries: list[float] = []

    def never(*_: Any, **__: Any) -> None:
        tries.append(time.monotonic())
        raise ValueError("no")

    monkeypatch.setattr(queue, "finish", never)
    monkeypatch.setattr(queue, "fail", never)
    number = ask(runtime, value=6)
    with working(runtime):
        until(lambda: len(tries) >= 6)
    assert not job_threads()  # it ends although nothing could be stored
    assert len(tries) <= 2 + (tries[-1] - tries[0]) / runtime.settings.job_poll_s
    assert look(runtime, number).state == "running"  # its lease will run out


def test_worker_outlives_a_database_that_is_away(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    number = ask(runtime, value=6)
    away_twice(monkeypatch, "has_claimable")
    with working(runtime):
        assert ended(runtime, number).state == "done"


def test_end_is_stored_when_the_database_is_back(runtime: Runtime, monkeypatch: pytest.MonkeyPatch):
    number = ask(runtime, value=7)
    away_twice(monkeypatch, "finish")
    assert Worker(runtime, TEST_KINDS, "w", threading.Event()).work()
    row = look(runtime, number)
    assert (row.state, row.attempts, row.result) == ("done", 1, {"square": 49})


# --- processes
# --------------------------------------------------------------------------------------------------


def environment(runtime: Runtime) -> dict[str, str]:
    """Environment of a worker that is a separate process."""
    settings = runtime.settings
    return os.environ | {
        "HELIOTWIN_DATA_DIR": str(settings.data_dir),
        "HELIOTWIN_DATABASE_URL": str(settings.database_url),
        "HELIOTWIN_JOB_LEASE_S": str(settings.job_lease_s),
        "HELIOTWIN_JOB_POLL_S": "0.05",
    }


def process(runtime: Runtime) -> AbstractContextManager[ForkedProcess]:
    """A worker as a separate process."""
    return forked_process(job_kinds.run, environment(runtime))


@pytest.mark.full
def test_job_of_a_killed_process_is_finished_by_another(runtime: Runtime):
    number = ask(runtime, value=9, steps=8, halts_at=2)
    with process(runtime) as first:
        until(lambda: len(marks(runtime)) >= 2)
        first.send_signal(signal.SIGKILL)
        first.wait()
    assert look(runtime, number).state == "running"
    expire(runtime.database)
    with working(runtime):
        row = ended(runtime, number)
    assert (row.state, row.result, row.attempts) == ("done", {"square": 81}, 2)
    # Each part left its mark once: those of the killed process were not done again.
    assert marks(runtime) == [str(part) for part in range(8)]
    with runtime.database.reading() as session:
        workers = {step["by"] for step in queue.load_checkpoints(session, number).values()}
    assert workers == {first.pid, os.getpid()}


@pytest.mark.full
def test_poison_that_kills_its_process_ends_failed(runtime: Runtime):
    number = ask(runtime, dies=99)
    for _ in range(3):
        with process(runtime) as victim:
            assert victim.wait(WAIT_LIMIT_S) == -signal.SIGKILL
        expire(runtime.database)
    with working(runtime):
        row = ended(runtime, number)
    assert row.state == "failed"
    assert (row.reason or "").startswith("its worker was lost 3 times")


@pytest.mark.full
def test_stopped_process_puts_its_job_back(runtime: Runtime):
    number = ask(runtime, steps=2, halts_at=1)
    with process(runtime) as running:
        until(lambda: len(marks(runtime)) >= 1)
        running.send_signal(signal.SIGTERM)
        assert running.wait(WAIT_LIMIT_S) == 0
    row = look(runtime, number)
    assert (row.state, row.attempts) == ("queued", 0)


@pytest.mark.full
def test_process_whose_job_hangs_ends_with_a_clear_word(runtime: Runtime):
    """What hangs cannot be ended but with its process; the other job is put back, and the next
    process does both.
    """
    hanging, other = ask(runtime, value=3, hangs=1), ask(runtime, value=2, steps=1, halts_at=0)
    few = {
        "HELIOTWIN_JOB_SILENCE_S": "600",
        "HELIOTWIN_JOB_WORKERS": "2",
        "HELIOTWIN_JOB_RETRY_S": "0",
        "HELIOTWIN_TEST_BEATS_PER_LEASE": "300",
        "HELIOTWIN_TEST_GRACE_S": "5",
    }
    command = [sys.executable, "-m", job_kinds.__name__]
    with child_process(
        command, cwd=ROOT, env=environment(runtime) | few, stderr=subprocess.PIPE
    ) as first:
        _, log = first.communicate(timeout=WAIT_LIMIT_S)
        assert first.returncode == 1
    assert b"hangs, no sign of life for 600 s in attempt 1" in log
    assert b"this process ends, start it again" in log
    row = look(runtime, hanging)
    assert (row.state, row.attempts) == ("queued", 1)
    assert "no sign of life for 600 s" in (row.reason or "")
    assert (look(runtime, other).state, look(runtime, other).attempts) == ("queued", 0)
    cancel(runtime, other)
    with working(runtime):
        assert ended(runtime, hanging).result == {"square": 9}
