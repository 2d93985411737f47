"""Job summaries and streams of their changes, with one database query for all watchers."""

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

from service.base.errors import BusyError, TooManyError
from service.base.fields import CreatedAt, Id, State, from_row
from service.store import queue
from service.store.job_tables import JobRow
from service.twin.runtime import Runtime
from service.web.auth import security

# Interval between queries of the store [s], and the silence after which a comment keeps the
# connection open [s].
_LOOK_EVERY_S = 0.5
_COMMENT_EVERY_S = 15.0


class JobSummary(BaseModel):
    """The state of a job, without its payload and result, which may be megabytes."""

    id: Id
    kind: str = Field(description="Kind of job; `POST /v1/jobs/KIND` begins one.")
    state: State = Field(description="queued, running, then for good done, failed or cancelled.")
    progress: float = Field(description="Share that is done, 0 to 1 [1].")
    message: str = Field(description="What is being done.")
    phase: str = Field(
        description="What the job does at present; what `n_done` of `n_total` counts."
    )
    n_done: int | None = Field(description="How many are done; null: not counted.")
    n_total: int | None = Field(description="How many there are; null: not counted.")
    remaining_s: float | None = Field(
        description="Expected time to its end [s]; null where that is not known."
    )
    attempts: int = Field(description="How often it was begun.")
    cancel_requested: bool = Field(description="It ends as soon as its worker sees this.")
    reason: str | None = Field(description="Why it failed, or why it is tried again.")
    created_by: str = Field(description="Name of the key that asked for it.")
    created_at: CreatedAt
    not_before: datetime = Field(description="When it is tried next at the earliest.")
    started_at: datetime | None = Field(description="When it was last begun; null: it waits.")
    finished_at: datetime | None = Field(description="When it ended; null: it has not.")
    href: str = Field(description="Path of the whole job, with its payload and its result.")

    @property
    def has_ended(self) -> bool:
        """Whether it is done, failed or cancelled."""
        return self.state in queue.ENDED


def job_summary(row: JobRow) -> JobSummary:
    """Summarize a job."""
    return from_row(JobSummary, row, href=f"/v1/jobs/{row.id}")


@dataclass(frozen=True, eq=False)
class Watcher:
    """A client that follows job ``number``, with the name of its key."""

    number: int
    name: str
    presented: str | None


@dataclass(frozen=True)
class _News:
    """The state of a job, as it is sent to all its watchers."""

    revision: int
    has_ended: bool
    document: str


class Watchers:
    """All clients that follow jobs, limited in total and per key.

    The object belongs to one event loop: nothing else runs between two awaits. Only the query of
    the database needs a lock.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._watching: set[Watcher] = set()
        self._looking = anyio.Lock()
        self._looked_s = -inf
        self._news: dict[int, _News] = {}
        self._let_in: set[str | None] = set()
        self._thread = CapacityLimiter(
            1
        )  # separate, so that watchers get news while routes use all other threads

    @contextmanager
    def place(self, watcher: Watcher) -> Iterator[None]:
        """Register a watcher while the block runs.

        Raises
        ------
        TooManyError
            If its key already has the largest number of watchers allowed.
        BusyError
            If the service already has the largest number of watchers allowed.
        """
        settings = self._runtime.settings
        if (
            sum(other.name == watcher.name for other in self._watching)
            >= settings.max_watchers_of_key
        ):
            raise TooManyError(
                f"key {watcher.name} follows {settings.max_watchers_of_key} jobs already; end one"
                " of these streams, or ask for the list of jobs now and then"
            )
        if len(self._watching) >= settings.max_watchers:
            raise BusyError(
                "too many jobs are being followed; ask for the job itself now and then, or come"
                " again"
            )
        self._watching.add(watcher)
        self._looked_s = -inf
        try:
            yield
        finally:
            self._watching.discard(watcher)

    async def news(self, watcher: Watcher) -> _News | None:
        """The job of the watcher, at most half a second old.

        None if the job is deleted or the key is no longer valid.
        """
        async with self._looking:
            if time.monotonic() - self._looked_s >= _LOOK_EVERY_S:
                watching = tuple(self._watching)
                self._looked_s = time.monotonic()
                await to_thread.run_sync(self._look, watching, limiter=self._thread)
        return self._news.get(watcher.number) if watcher.presented in self._let_in else None

    def _look(self, watching: Sequence[Watcher]) -> None:
        """Query the jobs that are followed, and the presented keys that are still valid."""
        database, settings = self._runtime.database, self._runtime.settings
        with database.reading() as session:
            rows = queue.get_summaries(session, {watcher.number for watcher in watching})
        presented = {watcher.presented for watcher in watching}
        self._let_in = {
            key for key in presented if security.identify(database, settings, key) is not None
        }
        self._news = {row.id: self._news_of(row) for row in rows}

    def _news_of(self, row: JobRow) -> _News:
        known = self._news.get(row.id)
        if known is not None and known.revision == row.revision:
            return known
        return _News(row.revision, row.state in queue.ENDED, job_summary(row).model_dump_json())


class JobStream(EventSourceResponse):
    """Stream of server-sent events: a job after each change, numbered by revision, until it ends.

    Comments keep the connection open. The stream ends early if the service stops, the job is
    deleted or the key is withdrawn. The watcher is registered when the response is sent, so errors
    of `Watchers.place` are answered like any other error.
    """

    def __init__(
        self, watchers: Watchers, watcher: Watcher, seen: int, stopping: threading.Event
    ) -> None:
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
        while (
            not stopping.is_set() and (news := await self._watchers.news(self._watcher)) is not None
        ):
            if news.has_ended:  # even if the client claims to have seen a later event
                yield format_sse_event(data_str=news.document, event="end", id=str(news.revision))
                return
            if news.revision > seen:
                seen, quiet_since = news.revision, time.monotonic()
                yield format_sse_event(data_str=news.document, event="progress", id=str(seen))
            elif time.monotonic() - quiet_since > _COMMENT_EVERY_S:
                yield format_sse_event(comment="still here")
                quiet_since = time.monotonic()
            await anyio.sleep(_LOOK_EVERY_S)
