"""Slots for expensive work, shared fairly between keys.

Requests that wait hold no thread.
"""

from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio

from service.base.errors import BusyError
from service.twin.slots import FairQueue


class FairLimiter:
    """Limit of ``count`` concurrent requests, with a fair queue behind it.

    Up to ``max_waiting`` requests wait, each for at most ``timeout_s`` [s]. One key gets at most
    half of the slots and half of the queue, so others always find a place. The queue serves the
    keys in turn. The limiter belongs to one event loop: nothing else runs between two awaits.
    """

    def __init__(self, count: int = 2, max_waiting: int = 32, timeout_s: float = 10.0) -> None:
        self._free = count
        self._max_each = max(1, count // 2)
        self._max_waiting = max_waiting
        self._timeout_s = timeout_s
        self._held: Counter[str] = Counter()
        # Requests that wait. A set event means that the request has its slot.
        self._queue = FairQueue[anyio.Event]()

    @asynccontextmanager
    async def acquire(self, key: str) -> AsyncIterator[None]:
        """Hold a slot for ``key`` while the block runs.

        Raises
        ------
        BusyError
            If too many requests wait, or if no slot becomes free in time.
        """
        granted = self._request(key)
        try:
            with anyio.move_on_after(self._timeout_s):
                await granted.wait()
            if not granted.is_set():
                raise BusyError(
                    "heavy work is done one after the other; ask again as Retry-After says"
                )
            yield
        finally:
            self._release(key, granted)

    def _request(self, key: str) -> anyio.Event:
        """Request a slot. Its event is set when the slot is granted, maybe at once."""
        granted = anyio.Event()
        if self._may_have(key):
            self._grant(key, granted)
            return granted
        if (
            self._queue.count(key) >= (self._max_waiting + 1) // 2
            or len(self._queue) >= self._max_waiting
        ):
            raise BusyError("too much heavy work is waited for; ask again as Retry-After says")
        self._queue.add(key, granted)
        return granted

    def _may_have(self, key: str) -> bool:
        return self._free > 0 and self._held[key] < self._max_each

    def _grant(self, key: str, granted: anyio.Event) -> None:
        self._free -= 1
        self._held[key] += 1
        granted.set()

    def _release(self, key: str, granted: anyio.Event) -> None:
        """Release the slot, or leave the queue if the slot was never granted."""
        if granted.is_set():
            self._free += 1
            self._held[key] -= 1
            if not self._held[key]:
                del self._held[key]
            if (following := self._queue.next(self._may_have)) is not None:
                self._grant(following.caller, self._queue.serve(following.caller))
        else:
            self._queue.remove(key, granted)
