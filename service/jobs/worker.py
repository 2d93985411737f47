"""Workers: threads that take jobs, run their handlers, and end each job exactly once."""

import itertools
import logging
import math
import os
import random
import signal
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from functools import partial

from pydantic import ValidationError
from sqlalchemy.exc import OperationalError, SQLAlchemyError, StatementError
from sqlalchemy.orm import Session

from model.errors import InvalidInputError, ModelError
from service.base import monitoring, processes
from service.base.arrays import pack
from service.base.errors import ServiceError
from service.base.monitoring import (
    JOB_ATTEMPTS,
    JOB_SECONDS,
    PROCESS,
    measure_duration,
    serve_metrics,
)
from service.base.settings import Settings
from service.jobs.enqueuing import enqueue_due
from service.jobs.heartbeat import heartbeat
from service.jobs.kind import CancelRequestedError, Context, Kinds, WorkerStoppingError
from service.jobs.uploads import delete_unused_uploads
from service.store import deletion, queue
from service.store.job_tables import JobRow
from service.twin.alarms.field_updates import FieldStateWriter
from service.twin.runtime import Operations, Runtime

logger = logging.getLogger("heliotwin.jobs")

# Seconds between two deletions of old records.
_PURGE_EVERY_S = 3600.0

# Seconds that running jobs have to reach their next report when the workers stop.
_GRACE_S = 20.0


def pause_s(attempt: int, base_s: float, generator: random.Random) -> float:
    """Seconds before attempt ``attempt`` + 1.

    They double each time, with a random factor, so that not all jobs return at once.
    """
    longest: float = min(queue.LONGEST_PAUSE_S, base_s * 2 ** (attempt - 1))
    return longest * generator.uniform(0.5, 1.0)


@dataclass(frozen=True)
class _Ending:
    """The outcome of an attempt, and the function that stores it."""

    outcome: str
    write: Callable[[Session], None]


def _failed(lease: queue.Lease, reason: str) -> _Ending:
    return _Ending("failed", lambda session: queue.fail(session, lease, reason))


def _delete_old_records(runtime: Runtime) -> int:
    """Delete a batch of each kind of record that the settings do not keep; return their number."""
    settings, deleted = runtime.settings, 0
    for records, days, prune in (
        ("jobs", settings.job_retention_days, deletion.prune_jobs),
        ("plans", settings.plan_retention_days, deletion.prune_plans),
        ("forecasts", settings.forecast_retention_days, deletion.prune_forecasts),
        ("audit entries", settings.audit_retention_days, deletion.prune_audit),
    ):
        if days:
            with runtime.database.writing() as session:
                count = prune(session, timedelta(days=days))
            if count:
                logger.info("%d %s deleted that were older than %g days", count, records, days)
            deleted += count
    delete_unused_uploads(runtime)
    return deleted


def _store(context: Context, write: Callable[[Session], None]) -> None:
    """Store the outcome of a job. Retry with pauses until it succeeds or the lease is lost."""
    lease, runtime = context.lease, context.runtime
    reason = "its result cannot be stored; the worker's log has more"
    failed = partial(queue.fail, lease=lease, reason=reason)
    while True:
        # A missing database does not mean that the job hangs.
        context.alive_s = time.monotonic()
        try:
            with runtime.database.writing() as session:
                write(session)
        except OperationalError as error:
            logger.error("the end of job %d is not stored yet: %s", lease.job_id, error)
        # The database does not accept the result.
        except (StatementError, ValueError):
            logger.exception("the end of job %d cannot be stored", lease.job_id)
            if write is not failed:
                write = failed
                continue
        else:
            delete_unused_uploads(runtime)
            return
        if context.lost.is_set() or context.stopping.wait(runtime.settings.job_poll_s):
            return  # the lease expires, and another worker repeats the job


class Worker:
    """A worker that takes jobs one by one until it is stopped or hangs. It then calls ``on_stuck``.

    With ``only_short`` it takes only jobs that are expected to take seconds, which need not wait
    for long ones. With ``ends_if_stuck`` a hang ends all that share ``stopping``.
    """

    def __init__(
        self,
        runtime: Runtime,
        kinds: Kinds,
        name: str,
        stopping: threading.Event,
        on_stuck: Callable[[], None] = lambda: None,
        only_short: bool = False,
        *,
        ends_if_stuck: bool = False,
    ) -> None:
        self.runtime = runtime
        self.kinds = kinds
        self.name = name
        self.stopping = stopping
        self.only_short = only_short
        self._on_stuck = on_stuck
        self._ends_if_stuck = ends_if_stuck
        self._stuck = threading.Event()
        self._random = random.Random(name)
        self._purged_s = -math.inf

    def run(self) -> None:
        """Take jobs until stopped, and wait while the database does not answer."""
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
        """Delete old records from time to time, in batches, and queue periodic jobs."""
        if time.monotonic() - self._purged_s < _PURGE_EVERY_S:
            return
        deleted = _delete_old_records(self.runtime)
        enqueue_due(self.runtime, self.kinds)
        if not deleted:  # otherwise there may be more
            self._purged_s = time.monotonic()

    def work(self) -> bool:
        """Take and finish a job, and return whether there was one."""
        job = self._claim()
        if job is None:
            return False
        context = Context(self.runtime, queue.lease_of(job), job.created_by, self.stopping)
        with (
            monitoring.log_context(job=job.id, kind=job.kind),
            measure_duration(JOB_SECONDS.labels(job.kind), f"job {job.kind}"),
        ):
            logger.info("%s: job %d (%s), attempt %d", self.name, job.id, job.kind, job.attempts)
            outcome = self._attempt(context, job)
        JOB_ATTEMPTS.labels(job.kind, outcome).inc()
        return True

    def _attempt(self, context: Context, job: JobRow) -> str:
        """Run the job, store its outcome, and return the outcome's name."""
        try:
            with heartbeat(context, self.name, partial(self._return_stuck, context, job)):
                ending = self._ending(context, job)
                _store(context, ending.write)
                return ending.outcome
        except queue.LeaseLostError:
            logger.warning("%s: job %d went to another worker", self.name, job.id)
            return "lost"

    def _claim(self) -> JobRow | None:
        settings, database = self.runtime.settings, self.runtime.database
        lease_s, attempts = settings.job_lease_s, settings.job_attempts
        with database.reading() as session:
            if not queue.has_claimable(session, self.kinds, lease_s, self.only_short):
                return None
        with database.writing() as session:
            job = queue.claim(session, self.kinds, self.name, lease_s, attempts, self.only_short)
            if self.stopping.is_set():  # a job that came back since is for another process
                session.rollback()
                return None
            return job

    def _return_stuck(self, context: Context, job: JobRow) -> None:
        """End a stuck attempt, and return its job to the queue.

        The heartbeat thread calls this, because its activity does not prove that the work
        continues.
        """
        context.lost.set()
        if self._ends_if_stuck:  # before the job is back: no thread of this process takes it again
            self.stopping.set()
        reason = f"no sign of life for {self.runtime.settings.job_silence_s:g} s"
        logger.error("job %d (%s) hangs, %s in attempt %d", job.id, job.kind, reason, job.attempts)
        try:
            with self.runtime.database.writing() as session:
                self._retry_or_fail(context, job, reason).write(session)
        except queue.LeaseLostError:
            logger.warning("%s: job %d went to another worker", self.name, job.id)
        # The work may hold SQLite's lock.
        except SQLAlchemyError as error:
            logger.error("%s: job %d is left to its lease: %s", self.name, job.id, error)
        JOB_ATTEMPTS.labels(job.kind, "stuck").inc()
        self._stuck.set()
        self._on_stuck()

    def _ending(self, context: Context, job: JobRow) -> _Ending:
        """Run the handler, and return the outcome."""
        lease, kind = context.lease, self.kinds[job.kind]
        try:
            result = kind.run(context, job.payload)
            arrays = None if result.arrays is None else pack(result.arrays)
            return _Ending(
                "done", lambda session: queue.finish(session, lease, result.figures, arrays)
            )
        except queue.LeaseLostError:
            raise
        except CancelRequestedError:
            return _Ending("cancelled", lambda session: queue.stop(session, lease))
        except WorkerStoppingError:
            return _Ending("released", lambda session: queue.release(session, lease))
        except (ModelError, ServiceError) as error:  # a retry would find the same error
            return _failed(lease, str(error))
        except ValidationError:
            return _failed(lease, "its payload is not one that this version takes")
        # A handler's error must end its job, not the worker.
        except Exception as error:
            logger.exception("%s: job %d failed in attempt %d", self.name, job.id, job.attempts)
            return self._retry_or_fail(context, job, type(error).__name__)

    def _retry_or_fail(self, context: Context, job: JobRow, fault: str) -> _Ending:
        """Retry later, or fail. ``fault`` names only the error's type, and the log has the details.

        Attempts count from the last one that completed a step.
        """
        settings, lease = self.runtime.settings, context.lease
        since = job.attempts - job.attempts_before_progress
        attempts = 1 if context.has_progressed.is_set() else since
        if attempts >= settings.job_attempts:
            often = f"failed {attempts} times, the last time by {fault}"
            return _failed(lease, f"{often}; the worker's log has more of job {lease.job_id}")
        delay = pause_s(attempts, settings.job_retry_s, self._random)
        reason = f"attempt {job.attempts} failed by {fault}; tried again in {delay:.0f} s"
        return _Ending("retried", lambda session: queue.retry(session, lease, reason, delay))


class Workers:
    """Worker threads of this process, with additional ones for short jobs only.

    Another thread writes the state of the field (`FieldStateWriter`).

    A thread that hangs cannot be stopped. ``on_stuck`` handles this case. Without it, another
    thread takes over the worker and its computation slots. The stuck thread keeps its memory and
    other resources until the process ends.
    """

    def __init__(
        self, runtime: Runtime, kinds: Kinds, count: int, on_stuck: Callable[[], None] | None = None
    ) -> None:
        self.stopping = threading.Event()
        self._runtime = runtime
        self._kinds = kinds
        self._lanes = [False] * count + [True] * (
            runtime.settings.short_job_workers if count else 0
        )
        self._on_stuck = on_stuck
        self._numbers = itertools.count()
        self._threads: dict[int, threading.Thread] = {}
        self._changing = threading.Lock()
        self._state: threading.Thread | None = None

    def start(self) -> None:
        """Start to take jobs."""
        for only_short in self._lanes:
            self._start_one(only_short)
        if self._lanes:
            run = partial(FieldStateWriter(self._runtime).run, self.stopping)
            self._state = threading.Thread(target=run, name="field-state", daemon=True)
            self._state.start()

    def _start_one(self, only_short: bool) -> None:
        """Start a thread, unless the workers are stopping. `stop` waits for each started thread."""
        number = next(self._numbers)
        name = f"{socket.gethostname()[:48]}-{os.getpid()}-{number}"
        on_stuck = self._on_stuck or partial(self._replace, number, only_short)
        worker = Worker(
            self._runtime,
            self._kinds,
            name,
            self.stopping,
            on_stuck,
            only_short,
            ends_if_stuck=self._on_stuck is not None,
        )
        thread = threading.Thread(target=worker.run, name=f"job-{number}", daemon=True)
        with self._changing:
            if not self.stopping.is_set():
                self._threads[number] = thread
                thread.start()

    def _replace(self, number: int, only_short: bool) -> None:
        with self._changing:
            stuck = self._threads.pop(number)
        assert stuck.ident is not None
        self._runtime.compute_slots.forget(stuck.ident)
        self._runtime.decoding_slots.forget(stuck.ident)
        self._runtime.large_image_slots.forget(stuck.ident)
        self._runtime.large_plan_slots.forget(stuck.ident)
        logger.error(
            "another thread takes the place of %s; what that one holds it keeps until a restart",
            stuck.name,
        )
        self._start_one(only_short)

    def stop(self) -> None:
        """Take no more jobs, and wait some time until running ones return to the queue.

        If a job does not report in time, another worker takes it after its lease expires.
        """
        self.stopping.set()
        self._runtime.job_came.release(max(1, len(self._lanes)))  # wakes idle workers
        with self._changing:  # no thread starts after this
            threads = [*self._threads.values(), *([self._state] if self._state else [])]
        until = time.monotonic() + _GRACE_S
        for thread in threads:
            thread.join(max(0.0, until - time.monotonic()))


def work(settings: Settings, kinds: Kinds, operations: Operations | None = None) -> None:
    """Run ``job_workers`` workers until SIGTERM or SIGINT. Running jobs return to the queue.

    If a job hangs, the process ends with exit code 1, so that its supervisor restarts it. A thread
    cannot be stopped.

    Raises
    ------
    InvalidInputError
        If ``job_workers`` is 0.
    SchemaError
        If the store's schema is not current.
    """
    if not settings.job_workers:
        raise InvalidInputError(
            "job_workers: 0 works at nothing; give --count or HELIOTWIN_JOB_WORKERS"
        )
    processes.limit_memory()
    monitoring.configure_logging(settings)
    monitoring.configure_tracing(settings, "heliotwin-worker")
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
        with serve_metrics(settings, PROCESS), processes.returning_memory():
            workers.start()
            stopping.wait()
            workers.stop()
        if stuck.is_set():
            logger.critical("a job hangs and cannot be ended: this process ends, start it again")
            logging.shutdown()
            # A normal exit would wait for threads that the job may have started.
            os._exit(1)
    finally:
        runtime.close()
