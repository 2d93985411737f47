"""Workers: threads that take jobs, run their handlers, and see that each ends exactly once."""

import itertools
import logging
import math
import os
import random
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import partial

from pydantic import ValidationError
from sqlalchemy.exc import OperationalError, SQLAlchemyError, StatementError
from sqlalchemy.orm import Session

from model.errors import InvalidInputError, ModelError
from service.base import logs, memory, telemetry
from service.base.arrays import pack
from service.base.faults import ServiceError
from service.base.meters import JOB_ATTEMPTS, JOB_SECONDS, PROCESS, listening, timed
from service.base.settings import Settings
from service.jobs.asking import begin_due
from service.jobs.kind import CancelRequestedError, Context, Kinds, WorkerStoppingError
from service.store import queue, retention
from service.store.job_tables import JobRow
from service.twin.runtime import Operations, Runtime

logger = logging.getLogger("heliotwin.jobs")

# Seconds between two looks for jobs that are old enough to be deleted.
_PURGE_EVERY_S = 3600.0

# Seconds that jobs under way get to reach their next report when the workers are told to stop.
_GRACE_S = 20.0


def pause_s(attempt: int, base_s: float, generator: random.Random) -> float:
    """Seconds before attempt ``attempt`` + 1: doubled each time, and spread so that not all come back at once."""
    longest: float = min(queue.LONGEST_PAUSE_S, base_s * 2 ** (attempt - 1))
    return longest * generator.uniform(0.5, 1.0)


@dataclass(frozen=True)
class _Ending:
    """How an attempt ended, and what writes that."""

    outcome: str
    write: Callable[[Session], None]


def _failed(lease: queue.Lease, reason: str) -> _Ending:
    return _Ending("failed", lambda session: queue.fail(session, lease, reason))


class Worker:
    """Takes one job after the other until it is told to stop, or hangs; ``on_stuck`` is told then."""

    def __init__(
        self,
        runtime: Runtime,
        kinds: Kinds,
        name: str,
        stopping: threading.Event,
        on_stuck: Callable[[], None] = lambda: None,
    ) -> None:
        self.runtime = runtime
        self.kinds = kinds
        self.name = name
        self.stopping = stopping
        self._on_stuck = on_stuck
        self._stuck = threading.Event()
        self._random = random.Random(name)
        self._purged_s = -math.inf

    def run(self) -> None:
        """Work; a database that is away is waited for."""
        while not (self.stopping.is_set() or self._stuck.is_set()):
            try:
                self._purge()
                worked = self.work()
            except SQLAlchemyError as error:
                logger.error("%s: the database does not answer: %s", self.name, error)
                worked = False
            if not worked:
                self.runtime.job_came.acquire(timeout=self.runtime.settings.job_poll_s)

    def _purge(self) -> None:
        """Delete what is kept for a time only, now and then, a few rows at a time, and begin jobs that are due."""
        if time.monotonic() - self._purged_s < _PURGE_EVERY_S:
            return
        settings, deleted = self.runtime.settings, 0
        for what, days, purge in (
            ("jobs", settings.job_retention_days, retention.prune_jobs),
            ("forecasts", settings.forecast_retention_days, retention.prune_forecasts),
            ("audit entries", settings.audit_retention_days, retention.prune_audit),
        ):
            if days:
                with self.runtime.database.writing() as session:
                    count = purge(session, timedelta(days=days))
                if count:
                    logger.info("%s: %d %s deleted that were older than %g days", self.name, count, what, days)
                deleted += count
        begin_due(self.runtime, self.kinds)
        if not deleted:  # else there may be more
            self._purged_s = time.monotonic()

    def work(self) -> bool:
        """Take a job, if there is one, and bring it to an end; whether there was one."""
        job = self._claim()
        if job is None:
            return False
        context = Context(self.runtime, queue.lease_of(job), job.created_by, self.stopping)
        with logs.bound(job=job.id, kind=job.kind), timed(JOB_SECONDS.labels(job.kind), f"job {job.kind}"):
            logger.info("%s: job %d (%s), attempt %d", self.name, job.id, job.kind, job.attempts)
            outcome = self._attempt(context, job)
        JOB_ATTEMPTS.labels(job.kind, outcome).inc()
        return True

    def _attempt(self, context: Context, job: JobRow) -> str:
        """Work at the job, store how that ended, and name it."""
        try:
            with self._heart(context, job):
                ending = self._ending(context, job)
                self._store(context, ending.write)
                return ending.outcome
        except queue.LeaseLostError:
            logger.warning("%s: job %d went to another worker", self.name, job.id)
            return "lost"

    def _claim(self) -> JobRow | None:
        settings, database = self.runtime.settings, self.runtime.database
        with database.reading() as session:
            if not queue.has_claimable(session, self.kinds, settings.job_lease_s):
                return None
        with database.writing() as session:
            return queue.claim(session, self.kinds, self.name, settings.job_lease_s, settings.job_attempts)

    @contextmanager
    def _heart(self, context: Context, job: JobRow) -> Iterator[None]:
        """Renew the lease from a thread of its own, until the block ends or the work in it gives no sign of life."""
        ended = threading.Event()
        arguments = (context, job, ended)
        thread = threading.Thread(target=self._beat, args=arguments, name=f"{self.name}-heart", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _beat(self, context: Context, job: JobRow, ended: threading.Event) -> None:
        settings = self.runtime.settings
        while not ended.wait(min(settings.job_lease_s, settings.job_silence_s) / 3):
            if context.silent_s > settings.job_silence_s:
                self._give_up(context, job)
                return
            if not context.lost.is_set():
                self._renew(context)

    def _renew(self, context: Context) -> None:
        lease_s = self.runtime.settings.job_lease_s
        try:
            with self.runtime.database.writing() as session:
                if queue.renew(session, context.lease, lease_s):
                    context.cancelled.set()
        except queue.LeaseLostError:
            context.lost.set()
        except SQLAlchemyError as error:  # the next beat may succeed before the lease runs out
            logger.warning("%s: no heartbeat of job %d: %s", self.name, context.lease.job_id, error)

    def _give_up(self, context: Context, job: JobRow) -> None:
        """End the attempt from outside: that this thread lives proves nothing of the one that works."""
        context.lost.set()
        why = f"no sign of life for {self.runtime.settings.job_silence_s:g} s"
        logger.error("%s: job %d (%s) hangs, %s in attempt %d", self.name, job.id, job.kind, why, job.attempts)
        try:
            with self.runtime.database.writing() as session:
                self._again(context.lease, job.attempts, why).write(session)
        except queue.LeaseLostError:
            logger.warning("%s: job %d went to another worker", self.name, job.id)
        except SQLAlchemyError as error:  # the work may hold SQLite's lock
            logger.error("%s: job %d is left to its lease: %s", self.name, job.id, error)
        JOB_ATTEMPTS.labels(job.kind, "stuck").inc()
        self._stuck.set()
        self._on_stuck()

    def _ending(self, context: Context, job: JobRow) -> _Ending:
        """Run the handler; how that ended."""
        lease, kind = context.lease, self.kinds[job.kind]
        try:
            result = kind.handler(context, kind.payload.model_validate(job.payload))
            arrays = None if result.arrays is None else pack(result.arrays)
            return _Ending("done", lambda session: queue.finish(session, lease, result.figures, arrays))
        except queue.LeaseLostError:
            raise
        except CancelRequestedError:
            return _Ending("cancelled", lambda session: queue.stop(session, lease))
        except WorkerStoppingError:
            return _Ending("released", lambda session: queue.release(session, lease))
        except (ModelError, ServiceError) as error:  # trying again would find the same
            return _failed(lease, str(error))
        except ValidationError:
            return _failed(lease, "its payload is not one that this version takes")
        except Exception as error:  # a handler's fault must end with its job, not with the worker
            logger.exception("%s: job %d failed in attempt %d", self.name, job.id, job.attempts)
            return self._again(lease, job.attempts, type(error).__name__)

    def _again(self, lease: queue.Lease, attempts: int, fault: str) -> _Ending:
        """Try again later, or give up; ``fault`` names no more than its type, the log has the rest."""
        settings = self.runtime.settings
        if attempts >= settings.job_attempts:
            return _failed(
                lease,
                f"failed {attempts} times, the last time by {fault}; the worker's log has more of job {lease.job_id}",
            )
        delay = pause_s(attempts, settings.job_retry_s, self._random)
        reason = f"attempt {attempts} failed by {fault}; tried again in {delay:.0f} s"
        return _Ending("retried", lambda session: queue.retry(session, lease, reason, delay))

    def _store(self, context: Context, write: Callable[[Session], None]) -> None:
        """Write how the job ended; while that cannot be, again and again, with pauses, until the lease is lost."""
        reason = "its result cannot be stored; the worker's log has more"
        failed = partial(queue.fail, lease=context.lease, reason=reason)
        while True:
            context.alive_s = time.monotonic()  # a database that is away makes nothing hang
            try:
                with self.runtime.database.writing() as session:
                    write(session)
                return
            except OperationalError as error:
                logger.error("%s: the end of job %d is not stored yet: %s", self.name, context.lease.job_id, error)
            except (StatementError, ValueError):  # a result that the database does not take
                logger.exception("%s: the end of job %d cannot be stored", self.name, context.lease.job_id)
                if write is not failed:
                    write = failed
                    continue
            if context.lost.is_set() or self.stopping.wait(self.runtime.settings.job_poll_s):
                return  # the lease runs out, and another worker does it again


class Workers:
    """Some workers as threads of this process.

    A thread that hangs cannot be ended. ``on_stuck`` is told of it; without that another thread takes its place, also
    before the model, and it keeps its memory and whatever else it holds until the process ends.
    """

    def __init__(self, runtime: Runtime, kinds: Kinds, count: int, on_stuck: Callable[[], None] | None = None) -> None:
        self.stopping = threading.Event()
        self._runtime = runtime
        self._kinds = kinds
        self._count = count
        self._on_stuck = on_stuck
        self._numbers = itertools.count()
        self._threads: dict[int, threading.Thread] = {}

    def start(self) -> None:
        """Begin to take jobs."""
        for _ in range(self._count):
            self._start_one()

    def _start_one(self) -> None:
        number = next(self._numbers)
        name = f"{socket.gethostname()[:48]}-{os.getpid()}-{number}"
        on_stuck = self._on_stuck or partial(self._replace, number)
        worker = Worker(self._runtime, self._kinds, name, self.stopping, on_stuck)
        self._threads[number] = threading.Thread(target=worker.run, name=f"job-{number}", daemon=True)
        self._threads[number].start()

    def _replace(self, number: int) -> None:
        stuck = self._threads.pop(number)
        assert stuck.ident is not None
        self._runtime.gate.forget(stuck.ident)
        logger.error("another thread takes the place of %s; what that one holds it keeps until a restart", stuck.name)
        self._start_one()

    def stop(self) -> None:
        """Take no more jobs and wait a while for those under way to be put back.

        One that does not report in time is left to its lease.
        """
        self.stopping.set()
        self._runtime.job_came.release(max(1, self._count))  # wakes those that wait for work
        until = time.monotonic() + _GRACE_S
        for thread in list(self._threads.values()):
            thread.join(max(0.0, until - time.monotonic()))


def work(settings: Settings, kinds: Kinds, operations: Operations | None = None) -> None:
    """Work at the store's jobs, ``job_workers`` at a time, until SIGTERM or SIGINT; one under way is put back.

    Where a job hangs the process ends by exit code 1, so that its supervisor starts it again: a thread cannot be ended.

    Raises
    ------
    InvalidInputError
        Where ``job_workers`` is 0.
    SchemaError
        Where nobody migrated the store.
    """
    if not settings.job_workers:
        raise InvalidInputError("job_workers: 0 works at nothing; give --count or HELIOTWIN_JOB_WORKERS")
    memory.limit()
    logs.set_up(settings)
    telemetry.set_up(settings, "heliotwin-worker")
    stopping, stuck = threading.Event(), threading.Event()

    def on_stuck() -> None:
        stuck.set()
        stopping.set()

    runtime = Runtime.from_settings(settings, operations)
    try:
        runtime.database.require_current()
        workers = Workers(runtime, kinds, settings.job_workers, on_stuck)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: stopping.set())
        with listening(settings, PROCESS):
            workers.start()
            stopping.wait()
            workers.stop()
        if stuck.is_set():
            logger.critical("a job hangs and cannot be ended: this process ends, start it again")
            logging.shutdown()
            os._exit(1)  # an ordinary end would wait for threads that the job may have started
    finally:
        runtime.close()
