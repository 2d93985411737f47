"""Heartbeats: a thread that renews a job's lease while the job runs."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from sqlalchemy.exc import SQLAlchemyError

from service.base.processes import in_background
from service.jobs.kind import Context
from service.store import queue

logger = logging.getLogger("heliotwin.jobs")

# Heartbeats per lease. Each heartbeat renews the lease and checks the job.
_BEATS_PER_LEASE = 3


def heartbeat(
    context: Context, name: str, on_silence: Callable[[], None]
) -> AbstractContextManager[None]:
    """Renew the lease of a job in another thread until the block ends.

    ``name`` is the worker's. If the work shows no sign of life for ``job_silence_s``, the thread
    calls ``on_silence`` and ends.
    """
    return in_background(lambda ended: _beat(context, ended, on_silence), f"{name}-heart")


def _beat(context: Context, ended: threading.Event, on_silence: Callable[[], None]) -> None:
    settings = context.runtime.settings
    beat_s = min(settings.job_lease_s, settings.job_silence_s) / _BEATS_PER_LEASE
    renewed_s = time.monotonic()
    while not ended.wait(min(beat_s, settings.job_poll_s)):
        if context.silent_s > settings.job_silence_s:
            on_silence()
            return
        if context.lost.is_set():
            continue
        if time.monotonic() - renewed_s >= beat_s:
            _check(context, _renew)
            renewed_s = time.monotonic()
        elif not context.cancelled.is_set():
            _check(context, _is_cancelled)


def _check(context: Context, is_cancelled: Callable[[Context], bool]) -> None:
    """Find out from the database whether the job was cancelled or lost."""
    try:
        if is_cancelled(context):
            context.cancelled.set()
    # The next heartbeat may succeed before the lease expires.
    except queue.LeaseLostError:
        context.lost.set()
    except SQLAlchemyError as error:
        logger.warning("no heartbeat of job %d: %s", context.lease.job_id, error)


def _renew(context: Context) -> bool:
    with context.runtime.database.writing() as session:
        return queue.renew(session, context.lease, context.runtime.settings.job_lease_s)


def _is_cancelled(context: Context) -> bool:
    """Whether cancellation was requested. Called often and without a lock."""
    with context.runtime.database.reading() as session:
        return queue.is_cancelled(session, context.lease)
