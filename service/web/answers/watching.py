"""Jobs in short, and as they change: one look at the database for all who follow some."""

import threading
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from math import inf

import anyio
from anyio import CapacityLimiter, to_thread
from fastapi.sse import EventSourceResponse, format_sse_event
from pydantic import BaseModel, Field
from starlette.types import Receive, Scope, Send

from service.base.faults import BusyError, TooManyError
from service.base.fields import State
from service.store import queue
from service.store.job_tables import JobRow
from service.twin.runtime import Runtime
from service.web.door import security

# How often the store is asked for news [s], and after how much silence a comment keeps the connection open [s].
_LOOK_EVERY_S = 0.5
_COMMENT_EVERY_S = 15.0


class JobSummary(BaseModel):
    """A job as it stands, without what was asked and what came of it, which may be megabytes."""

    id: int
    kind: str
    state: State = Field(description="queued, running, then for good done, failed or cancelled.")
    progress: float = Field(description="Share that is done, 0 to 1 [1].")
    message: str = Field(description="What is being done.")
    attempts: int = Field(description="How often it was begun.")
    cancel_requested: bool = Field(description="It ends as soon as its worker sees this.")
    reason: str | None = Field(description="Why it failed, or why it is tried again.")
    created_by: str = Field(description="Name of the key that asked for it.")
    created_at: datetime
    not_before: datetime = Field(description="When it is tried next at the earliest.")
    started_at: datetime | None
    finished_at: datetime | None
    href: str = Field(description="Path of the whole job, with its payload and its result.")


def job_summary(row: JobRow) -> JobSummary:
    """A job in short."""
    names = JobSummary.model_fields.keys() - {"href"}
    return JobSummary(**{name: getattr(row, name) for name in names}, href=f"/v1/jobs/{row.id}")


@dataclass(frozen=True, eq=False)
class Watcher:
    """Somebody who follows a job, under this name and with this key."""

    number: int
    name: str
    presented: str | None


@dataclass(frozen=True)
class _News:
    """A job as all who follow it are told."""

    revision: int
    has_ended: bool
    document: str


class Watchers:
    """Who follows jobs: so many at a time, and so many under one name.

    For one event loop: between two waits nothing else runs, so only looking at the database needs a lock.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._watching: set[Watcher] = set()
        self._looking = anyio.Lock()
        self._looked_s = -inf
        self._news: dict[int, _News] = {}
        self._let_in: set[str | None] = set()
        self._thread = CapacityLimiter(1)  # of its own, so that routes which hold all others keep no one waiting

    @contextmanager
    def place(self, watcher: Watcher) -> Iterator[None]:
        """A place for a watcher while the block runs.

        Raises
        ------
        TooManyError
            Where its name has as many as one may have.
        BusyError
            Where there is none left.
        """
        settings = self._runtime.settings
        if sum(other.name == watcher.name for other in self._watching) >= settings.most_watchers_of_key:
            raise TooManyError(
                f"key {watcher.name} follows {settings.most_watchers_of_key} jobs already; end one of these streams, "
                "or ask for the list of jobs now and then"
            )
        if len(self._watching) >= settings.most_watchers:
            raise BusyError("too many jobs are being followed; ask for the job itself now and then, or come again")
        self._watching.add(watcher)
        self._looked_s = -inf
        try:
            yield
        finally:
            self._watching.discard(watcher)

    async def news(self, watcher: Watcher) -> _News | None:
        """The watcher's job, no older than half a second; None where it is gone, or the key does not open any more."""
        async with self._looking:
            if time.monotonic() - self._looked_s >= _LOOK_EVERY_S:
                watching = tuple(self._watching)
                self._looked_s = time.monotonic()
                self._news, self._let_in = await to_thread.run_sync(self._look, watching, limiter=self._thread)
        return self._news.get(watcher.number) if watcher.presented in self._let_in else None

    def _look(self, watching: Sequence[Watcher]) -> tuple[dict[int, _News], set[str | None]]:
        """The jobs that are followed, and the keys that still open."""
        database, settings = self._runtime.database, self._runtime.settings
        with database.reading() as session:
            rows = queue.get_summaries(session, {watcher.number for watcher in watching})
        presented = {watcher.presented for watcher in watching}
        let_in = {key for key in presented if security.identify(database, settings, key) is not None}
        return {row.id: self._told(row) for row in rows}, let_in

    def _told(self, row: JobRow) -> _News:
        known = self._news.get(row.id)
        if known is not None and known.revision == row.revision:
            return known
        return _News(row.revision, row.state in queue.ENDED, job_summary(row).model_dump_json())


class JobStream(EventSourceResponse):
    """A job each time it has changed, numbered by its revision, until its end; comments in between.

    It ends early where the service stops, the job is deleted, or the key that it was asked with is withdrawn. The
    place is taken when it is sent: what `Watchers.place` raises is answered like any other error.
    """

    def __init__(self, watchers: Watchers, watcher: Watcher, seen: int, stopping: threading.Event) -> None:
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        super().__init__(self._events(seen, stopping), headers=headers)
        self._watchers = watchers
        self._watcher = watcher

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One ASGI call."""
        with self._watchers.place(self._watcher):
            await super().__call__(scope, receive, send)

    async def _events(self, seen: int, stopping: threading.Event) -> AsyncIterator[bytes]:
        quiet_since = time.monotonic()
        yield format_sse_event(retry=2000)
        while not stopping.is_set() and (news := await self._watchers.news(self._watcher)) is not None:
            if news.revision > seen:
                seen, quiet_since = news.revision, time.monotonic()
                event = "end" if news.has_ended else "progress"
                yield format_sse_event(data_str=news.document, event=event, id=str(seen))
                if news.has_ended:
                    return
            elif time.monotonic() - quiet_since > _COMMENT_EVERY_S:
                yield format_sse_event(comment="still here")
                quiet_since = time.monotonic()
            await anyio.sleep(_LOOK_EVERY_S)
