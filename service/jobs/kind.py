"""What a kind of job is: its payload, its function, and the function's view of its job."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel
from sqlalchemy.orm import Session

from service.base.settings import Settings
from service.store import queue
from service.store.job_tables import JobRow
from service.twin.runtime import Runtime

# Seconds between two writes of a job's progress: what a person can follow, and little for the database.
_REPORT_EVERY_S = 0.5
Payload = TypeVar("Payload", bound=BaseModel)


class CancelRequestedError(Exception):
    """Somebody asked for the job's end."""


class WorkerStoppingError(Exception):
    """The worker was told to stop; another takes the job up."""


@dataclass(frozen=True, eq=False)
class Result:
    """What a job gives: figures that are JSON, and named arrays where there are some."""

    figures: dict[str, Any]
    arrays: Mapping[str, NDArray[np.generic]] | None = None


@dataclass(eq=False)
class Context:
    """A handler's view of its job.

    A handler calls `report` every second or so: that is where it learns, by an exception that it lets pass, that the
    job was cancelled, lost or put back; and it is its sign of life, without which it is given up in the end. What must
    happen once although the job may be started again is written in one transaction together with `keep`.
    """

    runtime: Runtime
    lease: queue.Lease
    created_by: str
    stopping: threading.Event
    cancelled: threading.Event = field(default_factory=threading.Event)
    lost: threading.Event = field(default_factory=threading.Event)
    reported_s: float = -math.inf
    alive_s: float = field(default_factory=time.monotonic)

    @property
    def silent_s(self) -> float:
        """How long ago the last sign of life was [s]."""
        return time.monotonic() - self.alive_s

    def check(self) -> None:
        """Raise `LeaseLostError`, `CancelRequestedError` or `WorkerStoppingError` where the work shall end."""
        self.alive_s = time.monotonic()
        if self.lost.is_set():
            raise queue.LeaseLostError(f"job {self.lease.job_id}")
        if self.cancelled.is_set():
            raise CancelRequestedError
        if self.stopping.is_set():
            raise WorkerStoppingError

    def report(self, progress: float, message: str = "") -> None:
        """Say how far the job is, 0 to 1, and what is being done; raises what `check` raises."""
        self.check()
        if time.monotonic() - self.reported_s < _REPORT_EVERY_S:
            return
        self.reported_s = time.monotonic()
        with self.runtime.database.writing() as session:
            if queue.report(session, self.lease, progress, message):
                self.cancelled.set()
        self.check()

    def steps(self) -> dict[str, dict[str, Any]]:
        """The parts that this or an earlier attempt has done."""
        with self.runtime.database.reading() as session:
            return queue.steps(session, self.lease.job_id)

    def keep(self, session: Session, name: str, result: dict[str, Any]) -> None:
        """Note a part as done in the transaction that did it; LeaseLostError undoes both."""
        self.alive_s = time.monotonic()
        queue.keep_step(session, self.lease, name, result)

    @contextmanager
    def keeping(self, name: str, made: Callable[[], dict[str, Any]]) -> Iterator[None]:
        """Where the job is cancelled within the block, note what that had ``made`` by then: it is not begun again."""
        try:
            yield
        except CancelRequestedError:
            with self.runtime.database.writing() as session:
                self.keep(session, name, made())
            raise


@dataclass(frozen=True)
class Kind(Generic[Payload]):
    """A kind of job: what it takes, and the function that does it.

    Where it has ``due``, workers ask that every hour: it gives None, or the Idempotency-Key of a job that is due, which
    is begun once, with nothing in its payload. Where it has ``so_far``, that makes a result of the steps that are done,
    for a job that did not come to its end. What it needs of the settings it may ``require`` before it is queued.
    """

    name: str
    payload: type[Payload]
    handler: Callable[[Context, Payload], Result]
    summary: str
    due: Callable[[Session, Settings], str | None] | None = None
    so_far: Callable[[Mapping[str, Mapping[str, Any]]], dict[str, Any]] | None = None
    require: Callable[[Settings], None] | None = None


Kinds = Mapping[str, Kind[Any]]


def result_of(kinds: Kinds, session: Session, job: JobRow) -> dict[str, Any] | None:
    """What a job gave; where it was cancelled or failed, what it had changed until then."""
    kind = kinds.get(job.kind)
    if job.result is not None or kind is None or kind.so_far is None or job.state not in ("cancelled", "failed"):
        return job.result
    return kind.so_far(queue.steps(session, job.id))
