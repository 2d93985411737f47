"""Kinds of job for tests, and a worker process: ``python -m tests.service.job_kinds``."""

import os
import signal
import threading
import time
from types import SimpleNamespace
from typing import cast

from pydantic import Field
from sqlalchemy.exc import OperationalError

from model.errors import InvalidInputError
from service.base.fields import Model
from service.base.settings import Settings
from service.jobs import heartbeat, worker
from service.jobs.kind import Context, Kind, Kinds, Result
from service.store.job_tables import AuditRow
from service.twin.runtime import Operations, Runtime


class SquareIn(Model):
    """A number, and how the work on it goes."""

    value: int = 0
    steps: int = Field(
        default=0, description="Parts that are kept, each leaving a mark in the store."
    )
    pause_s: float = Field(default=0.0, description="Time that each part takes [s].")
    quiet_s: float = Field(
        default=0.0, description="Time without a report that each part pretends [s]."
    )
    by_hand: bool = Field(default=False, description="Whether each part waits for `NEXT_PART`.")
    halts_at: int | None = Field(
        default=None, description="Part where an attempt that found none done stays."
    )
    fails: int = Field(default=0, description="Attempts that end by an error.")
    dies: int = Field(default=0, description="Attempts that kill their process.")
    hangs: int = Field(default=0, description="Attempts that hang after one report.")
    refuses: bool = False
    stumbles: bool = Field(default=False, description="Each attempt fails after one part.")
    checks: bool = Field(
        default=False, description="Ask again and again whether to end, without a report."
    )
    result: str | None = Field(default=None, description="What to give in place of the square.")


WOKEN = threading.Event()
"""Set where attempts that hang shall go on."""

NEXT_PART = threading.Semaphore(0)
"""Released for each part that jobs ``by_hand`` shall do."""

LONG_S = 3600.0
"""Time since the last sign of life that hanging attempts pretend, regardless of the clock [s]."""


def square(context: Context, payload: SquareIn) -> Result:
    done = context.steps()
    attempt = _attempt(context)
    if attempt <= payload.dies:
        os.kill(os.getpid(), signal.SIGKILL)
    if attempt <= payload.fails:
        raise OperationalError("SELECT 1", {}, Exception("the secret inside"))
    if attempt <= payload.hangs:
        with context.runtime.compute_slots.slot():
            context.report(0.1, "the last word")
            context.alive_s -= LONG_S
            WOKEN.wait()
            context.report(0.2, "too late")
    if payload.refuses:
        raise InvalidInputError("value: it is refused")
    while payload.checks:
        context.check()
        time.sleep(0.02)
    for index in range(payload.steps):
        context.report(
            index / payload.steps,
            f"part {index}",
            phase="parts",
            n_done=index,
            n_total=payload.steps,
        )
        if str(index) not in done:
            _take_time(context, payload, stays=not done and index == payload.halts_at)
            with context.runtime.database.writing() as session:
                session.add(
                    AuditRow(actor=context.created_by, action="part", subject=str(index), detail={})
                )
                context.keep(session, str(index), {"by": os.getpid()})
            if payload.stumbles:
                raise OperationalError("SELECT 1", {}, Exception("the secret inside"))
    return Result(
        {"square": payload.value**2, "nan": float("nan")}
        if payload.result
        else {"square": payload.value**2}
    )


def _take_time(context: Context, payload: SquareIn, stays: bool) -> None:
    """Spend the time of one part; a part that ``stays`` ends only when its worker is stopped."""
    if stays:
        context.stopping.wait()
        context.check()
    if payload.by_hand:
        NEXT_PART.acquire()
    context.alive_s -= payload.quiet_s
    time.sleep(payload.pause_s)


def _attempt(context: Context) -> int:
    from service.store import queue

    with context.runtime.database.reading() as session:
        return queue.get_job(session, context.lease.job_id).attempts


def expected_s(payload: SquareIn, _runtime: Runtime) -> float:
    return payload.steps * payload.pause_s


TEST_KINDS: Kinds = {
    "squares": Kind("squares", SquareIn, square, "Square a number.", expected_s=expected_s)
}


def run() -> None:
    """Work at these kinds until a signal ends it."""
    heartbeat._BEATS_PER_LEASE = int(
        os.environ.get("HELIOTWIN_TEST_BEATS_PER_LEASE", heartbeat._BEATS_PER_LEASE)
    )
    worker._GRACE_S = float(os.environ.get("HELIOTWIN_TEST_GRACE_S", worker._GRACE_S))
    worker.work(
        Settings(), TEST_KINDS, cast(Operations, SimpleNamespace())
    )  # no model: it takes seconds to load


if __name__ == "__main__":
    run()
