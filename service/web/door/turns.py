"""Turns at what is heavy: few at a time, and whoever waits holds no thread."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio

from service.base.faults import BusyError


class Turns:
    """Up to ``count`` requests at a time, up to ``most_waiting`` behind them, each for ``patience_s`` at the most.

    For one event loop.
    """

    def __init__(self, count: int = 2, most_waiting: int = 32, patience_s: float = 10.0) -> None:
        self._limiter = anyio.CapacityLimiter(count)
        self._most_waiting = most_waiting
        self._patience_s = patience_s

    @asynccontextmanager
    async def one(self) -> AsyncIterator[None]:
        """A turn; BusyError where too many are waiting, or it does not come in time."""
        waiting_now = self._limiter.statistics().tasks_waiting
        if not self._limiter.available_tokens and waiting_now >= self._most_waiting:
            raise BusyError("too many large answers are waited for; ask again as Retry-After says")
        borrower = object()  # a task may wait for its turn only once, a request's task is not always its own
        with anyio.move_on_after(self._patience_s) as waiting:
            await self._limiter.acquire_on_behalf_of(borrower)
        if waiting.cancelled_caught:
            raise BusyError("large answers are made one after the other; ask again as Retry-After says")
        try:
            yield
        finally:
            self._limiter.release_on_behalf_of(borrower)
