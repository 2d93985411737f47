"""The progress of a job as server-sent events (the HTML standard, section 9.2)."""

import json
import threading
import time
from collections.abc import AsyncIterator

import anyio
from anyio import CapacityLimiter, to_thread
from fastapi import Response
from fastapi.responses import StreamingResponse

from service import jobs, representations
from service.runtime import Runtime

# How often the store is asked for news [s], and after how much silence a comment keeps the connection open [s].
_LOOK_EVERY_S = 0.5
_COMMENT_EVERY_S = 15.0

# Their own threads, so that many watchers do not keep the routes waiting.
_watchers = CapacityLimiter(4)


def _look(runtime: Runtime, number: int, seen: int) -> tuple[int, bool, str] | None:
    """Revision, whether the job has ended, and its state as JSON; None where nothing is newer than ``seen``."""
    with runtime.database.reading() as session:
        row = jobs.get_job(session, number)
    if row.revision <= seen:
        return None
    return row.revision, row.state in jobs.ENDED, json.dumps(representations.job(row).model_dump(mode="json"))


async def _events(runtime: Runtime, number: int, seen: int, stopping: threading.Event) -> AsyncIterator[str]:
    """The job each time it has changed, numbered by its revision, until its end; comments in between."""
    quiet_since = time.monotonic()
    yield "retry: 2000\n\n"
    while not stopping.is_set():
        news = await to_thread.run_sync(_look, runtime, number, seen, limiter=_watchers)
        if news is not None:
            seen, has_ended, document = news
            yield f"id: {seen}\nevent: {'end' if has_ended else 'progress'}\ndata: {document}\n\n"
            if has_ended:
                return
            quiet_since = time.monotonic()
        elif time.monotonic() - quiet_since > _COMMENT_EVERY_S:
            yield ": still here\n\n"
            quiet_since = time.monotonic()
        await anyio.sleep(_LOOK_EVERY_S)


def stream(runtime: Runtime, number: int, last_event_id: str | None, stopping: threading.Event) -> Response:
    """The events after ``last_event_id``; 204, which tells a browser not to come again, where the last was seen.

    Raises
    ------
    NotFoundError
    """
    is_number = last_event_id is not None and last_event_id.isascii() and last_event_id.isdecimal()
    seen = int(last_event_id[:10]) if last_event_id is not None and is_number else 0
    with runtime.database.reading() as session:
        row = jobs.get_job(session, number)
    if row.state in jobs.ENDED and row.revision <= seen:
        return Response(status_code=204)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(_events(runtime, number, seen, stopping), media_type="text/event-stream", headers=headers)
