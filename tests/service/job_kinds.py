"""Kinds of job for tests; a process of its own works at them: ``python -m tests.service.job_kinds``."""

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
from service.jobs.kind import Context, Kind, Kinds, Result
from service.jobs.worker import work
from service.store.job_tables import AuditRow
from service.twin.runtime import Operations


class SquareIn(Model):
    """A number, and how the work on it goes."""

    value: int = 0
    steps: int = Field(default=0, description="Parts that are kept, each leaving a mark in the store.")
    pause_s: float = Field(default=0.0, description="Time that each part takes [s].")
    fails: int = Field(default=0, description="Attempts that end by an error.")
    dies: int = Field(default=0, description="Attempts that kill their process.")
    hangs: int = Field(default=0, description="Attempts that hang, having told of themselves once.")
    refuses: bool = False
    result: str | None = Field(default=None, description="What to give in place of the square.")


WOKEN = threading.Event()
"""Set where attempts that hang shall go on."""


def square(context: Context, payload: SquareIn) -> Result:
    done = context.steps()
    attempt = _attempt(context)
    if attempt <= payload.dies:
        os.kill(os.getpid(), signal.SIGKILL)
    if attempt <= payload.fails:
        raise OperationalError("SELECT 1", {}, Exception("the secret inside"))
    if attempt <= payload.hangs:
        with context.runtime.gate.turn():
            context.report(0.1, "the last word")
            WOKEN.wait()
            context.report(0.2, "too late")
    if payload.refuses:
        raise InvalidInputError("value: it is refused")
    for index in range(payload.steps):
        context.report(index / payload.steps, f"part {index}")
        if str(index) not in done:
            time.sleep(payload.pause_s)
            with context.runtime.database.writing() as session:
                session.add(AuditRow(actor=context.created_by, action="part", subject=str(index), detail={}))
                context.keep(session, str(index), {"by": os.getpid()})
    return Result({"square": payload.value**2, "nan": float("nan")} if payload.result else {"square": payload.value**2})


def _attempt(context: Context) -> int:
    from service.store import queue

    with context.runtime.database.reading() as session:
        return queue.get_job(session, context.lease.job_id).attempts


TEST_KINDS: Kinds = {"squares": Kind("squares", SquareIn, square, "Square a number.")}


if __name__ == "__main__":
    work(Settings(), TEST_KINDS, cast(Operations, SimpleNamespace()))  # no model: it takes seconds to load
