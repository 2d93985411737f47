"""Workers: threads that take jobs, run their handlers, and see that each ends exactly once."""

import logging
import math
import os
import random
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from sqlalchemy.exc import OperationalError, SQLAlchemyError, StatementError
from sqlalchemy.orm import Session

from model.errors import InvalidInputError, ModelError
from service import jobs, logs, telemetry
from service.arrays import pack
from service.faults import ServiceError
from service.meters import JOB_ATTEMPTS, JOB_SECONDS, PROCESS, timed
from service.metrics import listening
from service.runtime import Operations, Runtime
from service.settings import Settings
from service.tables import JobRow

logger = logging.getLogger("heliotwin.jobs")

# Seconds between two writes of a job's progress: what a person can follow, and little for the database.
_REPORT_EVERY_S = 0.5
# Seconds between two looks for jobs that are old enough to be deleted.
_PURGE_EVERY_S = 3600.0
# Seconds that jobs under way get to reach their next report when the workers are told to stop.
_GRACE_S = 20.0

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
    job was cancelled, lost or put back. What must happen once although the job may be started again is written in one
    transaction together with `keep`.
    """

    runtime: Runtime
    lease: jobs.Lease
    created_by: str
    stopping: threading.Event
    cancelled: threading.Event = field(default_factory=threading.Event)
    lost: threading.Event = field(default_factory=threading.Event)
    reported_s: float = -math.inf

    def check(self) -> None:
        """Raise `LeaseLostError`, `CancelRequestedError` or `WorkerStoppingError` where the work shall end."""
        if self.lost.is_set():
            raise jobs.LeaseLostError(f"job {self.lease.job_id}")
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
            if jobs.report(session, self.lease, progress, message):
                self.cancelled.set()
        self.check()

    def steps(self) -> dict[str, dict[str, Any]]:
        """The parts that this or an earlier attempt has done."""
        with self.runtime.database.reading() as session:
            return jobs.steps(session, self.lease.job_id)

    def keep(self, session: Session, name: str, result: dict[str, Any]) -> None:
        """Note a part as done in the transaction that did it; LeaseLostError undoes both."""
        jobs.keep_step(session, self.lease, name, result)


@dataclass(frozen=True)
class Kind(Generic[Payload]):
    """A kind of job: what it takes, and the function that does it."""

    name: str
    payload: type[Payload]
    handler: Callable[[Context, Payload], Result]
    summary: str


Kinds = Mapping[str, Kind[Any]]


def pause_s(attempt: int, base_s: float, generator: random.Random) -> float:
    """Seconds before attempt ``attempt`` + 1: doubled each time, and spread so that not all come back at once."""
    longest: float = min(jobs.LONGEST_PAUSE_S, base_s * 2 ** (attempt - 1))
    return longest * generator.uniform(0.5, 1.0)


@dataclass(frozen=True)
class _Ending:
    """How an attempt ended, and what writes that."""

    outcome: str
    write: Callable[[Session], None]


def _failed(lease: jobs.Lease, reason: str) -> _Ending:
    return _Ending("failed", lambda session: jobs.fail(session, lease, reason))


class Worker:
    """Takes one job after the other until it is told to stop."""

    def __init__(self, runtime: Runtime, kinds: Kinds, name: str, stopping: threading.Event) -> None:
        self.runtime = runtime
        self.kinds = kinds
        self.name = name
        self.stopping = stopping
        self._random = random.Random(name)
        self._purged_s = -math.inf

    def run(self) -> None:
        """Work; a database that is away is waited for."""
        while not self.stopping.is_set():
            try:
                self._purge()
                worked = self.work()
            except SQLAlchemyError as error:
                logger.error("%s: the database does not answer: %s", self.name, error)
                worked = False
            if not worked:
                self.runtime.job_came.acquire(timeout=self.runtime.settings.job_poll_s)

    def _purge(self) -> None:
        """Delete old jobs, now and then, a few at a time."""
        settings = self.runtime.settings
        if not settings.job_retention_days or time.monotonic() - self._purged_s < _PURGE_EVERY_S:
            return
        with self.runtime.database.writing() as session:
            count = jobs.purge(session, timedelta(days=settings.job_retention_days))
        if count:
            logger.info("%s: %d jobs deleted that ended %g days ago", self.name, count, settings.job_retention_days)
            return  # there may be more
        self._purged_s = time.monotonic()

    def work(self) -> bool:
        """Take a job, if there is one, and bring it to an end; whether there was one."""
        job = self._claim()
        if job is None:
            return False
        context = Context(self.runtime, jobs.lease_of(job), job.created_by, self.stopping)
        with logs.bound(job=job.id, kind=job.kind), timed(JOB_SECONDS.labels(job.kind), f"job {job.kind}"):
            logger.info("%s: job %d (%s), attempt %d", self.name, job.id, job.kind, job.attempts)
            outcome = self._attempt(context, job)
        JOB_ATTEMPTS.labels(job.kind, outcome).inc()
        return True

    def _attempt(self, context: Context, job: JobRow) -> str:
        """Work at the job, store how that ended, and name it."""
        try:
            with self._heart(context):
                ending = self._ending(context, job)
                self._store(context, ending.write)
                return ending.outcome
        except jobs.LeaseLostError:
            logger.warning("%s: job %d went to another worker", self.name, job.id)
            return "lost"

    def _claim(self) -> JobRow | None:
        settings, database = self.runtime.settings, self.runtime.database
        with database.reading() as session:
            if not jobs.has_claimable(session, self.kinds, settings.job_lease_s):
                return None
        with database.writing() as session:
            return jobs.claim(session, self.kinds, self.name, settings.job_lease_s, settings.job_attempts)

    @contextmanager
    def _heart(self, context: Context) -> Iterator[None]:
        """Renew the lease from a thread of its own, until the block ends."""
        ended = threading.Event()
        thread = threading.Thread(target=self._beat, args=(context, ended), name=f"{self.name}-heart", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _beat(self, context: Context, ended: threading.Event) -> None:
        lease_s = self.runtime.settings.job_lease_s
        while not ended.wait(lease_s / 3):
            try:
                with self.runtime.database.writing() as session:
                    if jobs.renew(session, context.lease, lease_s):
                        context.cancelled.set()
            except jobs.LeaseLostError:
                context.lost.set()
                return
            except SQLAlchemyError as error:  # the next beat may succeed before the lease runs out
                logger.warning("%s: no heartbeat of job %d: %s", self.name, context.lease.job_id, error)

    def _ending(self, context: Context, job: JobRow) -> _Ending:
        """Run the handler; how that ended."""
        lease, kind = context.lease, self.kinds[job.kind]
        try:
            result = kind.handler(context, kind.payload.model_validate(job.payload))
            arrays = None if result.arrays is None else pack(result.arrays)
            return _Ending("done", lambda session: jobs.finish(session, lease, result.figures, arrays))
        except jobs.LeaseLostError:
            raise
        except CancelRequestedError:
            return _Ending("cancelled", lambda session: jobs.stop(session, lease))
        except WorkerStoppingError:
            return _Ending("released", lambda session: jobs.release(session, lease))
        except (ModelError, ServiceError) as error:  # trying again would find the same
            return _failed(lease, str(error))
        except ValidationError:
            return _failed(lease, "its payload is not one that this version takes")
        except Exception as error:  # a handler's fault must end with its job, not with the worker
            logger.exception("%s: job %d failed in attempt %d", self.name, job.id, job.attempts)
            return self._after_fault(lease, job.attempts, error)

    def _after_fault(self, lease: jobs.Lease, attempts: int, error: Exception) -> _Ending:
        """Try again later, or give up; the reason names the fault's type only, the log has the rest."""
        settings, fault = self.runtime.settings, type(error).__name__
        if attempts >= settings.job_attempts:
            return _failed(
                lease,
                f"failed {attempts} times, the last time by {fault}; the worker's log has more of job {lease.job_id}",
            )
        delay = pause_s(attempts, settings.job_retry_s, self._random)
        reason = f"attempt {attempts} failed by {fault}; tried again in {delay:.0f} s"
        return _Ending("retried", lambda session: jobs.retry(session, lease, reason, delay))

    def _store(self, context: Context, write: Callable[[Session], None]) -> None:
        """Write how the job ended; while the database is away, again and again until the lease is lost."""
        while True:
            try:
                with self.runtime.database.writing() as session:
                    write(session)
                return
            except OperationalError as error:
                logger.error("%s: the end of job %d is not stored yet: %s", self.name, context.lease.job_id, error)
                if self.stopping.wait(self.runtime.settings.job_poll_s):
                    return  # the lease runs out, and another worker does it again
            except (StatementError, ValueError):  # a result that the database does not take
                logger.exception("%s: the end of job %d cannot be stored", self.name, context.lease.job_id)
                reason = "its result cannot be stored; the worker's log has more"
                write = partial(jobs.fail, lease=context.lease, reason=reason)


class Workers:
    """Some workers as threads of this process."""

    def __init__(self, runtime: Runtime, kinds: Kinds, count: int) -> None:
        self.stopping = threading.Event()
        self._runtime = runtime
        name = f"{socket.gethostname()[:48]}-{os.getpid()}"
        self._threads = [
            threading.Thread(
                target=Worker(runtime, kinds, f"{name}-{number}", self.stopping).run, name=f"job-{number}", daemon=True
            )
            for number in range(count)
        ]

    def start(self) -> None:
        """Begin to take jobs."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Take no more jobs and wait a while for those under way to be put back.

        One that does not report in time is left to its lease.
        """
        self.stopping.set()
        self._runtime.job_came.release(max(1, len(self._threads)))  # wakes those that wait for work
        until = time.monotonic() + _GRACE_S
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))


def work(settings: Settings, kinds: Kinds, operations: Operations | None = None) -> None:
    """Work at the store's jobs, ``job_workers`` at a time, until SIGTERM or SIGINT; one under way is put back.

    Raises
    ------
    InvalidInputError
        Where ``job_workers`` is 0.
    SchemaError
        Where nobody migrated the store.
    """
    if not settings.job_workers:
        raise InvalidInputError("job_workers: 0 works at nothing; give --count or HELIOTWIN_JOB_WORKERS")
    logs.set_up(settings)
    telemetry.set_up(settings, "heliotwin-worker")
    runtime = Runtime.from_settings(settings, operations)
    try:
        runtime.database.require_current()
        workers, stopping = Workers(runtime, kinds, settings.job_workers), threading.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: stopping.set())
        with listening(settings, PROCESS):
            workers.start()
            stopping.wait()
            workers.stop()
    finally:
        runtime.close()
