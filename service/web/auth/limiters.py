"""Limiters: token buckets for each name, fair slots for expensive work, and limits on connections.

Requests that wait for a slot hold no thread. Each address may have a number of connections. A
client must send the head of its request in time, and must read the response in time.
"""

import asyncio
import ipaddress
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import anyio
import h11
from cachetools import LRUCache
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.base.errors import BusyError
from service.base.settings import Network, Settings, address_of, is_loopback, is_within
from service.twin.slots import FairQueue

# Most buckets that are stored, so that senders of many addresses do not fill the memory.
_MAX_BUCKETS = 10_000


def sender_of(address: str) -> str:
    """Return the address that limits count by.

    An IPv6 address counts as its /64 network, because one client is assigned a whole /64.
    """
    found = address_of(address)
    if not isinstance(found, ipaddress.IPv6Address):  # a socket may have no address
        return address
    return str(found.ipv4_mapped or ipaddress.IPv6Network((found, 64), strict=False))


class RateLimiter:
    """Token buckets, one for each name.

    A bucket holds up to ``burst`` tokens and refills at ``rate_per_s`` [1/s]. A request takes one
    token. A bucket may become negative by `charge`, which no library of fixed or sliding windows
    allows. The limiter belongs to one event loop. Its methods never wait, so it needs no lock.
    """

    def __init__(
        self, rate_per_s: float, burst: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.rate_per_s = rate_per_s
        self.burst = burst
        self._clock = clock
        self._buckets: LRUCache[str, tuple[float, float]] = LRUCache(_MAX_BUCKETS)

    def wait_s(self, name: str) -> float:
        """Take a token of ``name`` and return 0, or return the waiting time [s]."""
        tokens = self._tokens(name)
        has_token = tokens >= 1
        self._buckets[name] = tokens - has_token, self._clock()
        return 0.0 if has_token else (1 - tokens) / self.rate_per_s

    def charge(self, name: str, cost: float) -> None:
        """Take ``cost`` tokens of ``name`` for a cost that is known only afterwards.

        The bucket becomes negative if it holds fewer tokens.
        """
        self._buckets[name] = self._tokens(name) - cost, self._clock()

    def _tokens(self, name: str) -> float:
        tokens, since = self._buckets.get(name, (float(self.burst), self._clock()))
        return min(float(self.burst), tokens + (self._clock() - since) * self.rate_per_s)


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


# Time that a client may take to send the head of a request [s].
_HEAD_S = 20.0

# Time in which a client must read part of a pending response [s].
_READ_S = 30.0

# Raw response to a connection above the limit of its address. It precedes any request.
_TOO_MANY = (
    b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 5\r\nConnection: close\r\nContent-Length:"
    b" 0\r\n\r\n"
)


class Protocol(H11Protocol):
    """HTTP protocol that closes slow connections, and those above the limit of an address.

    A connection is slow if the head of its request is late, or if its client does not read the
    response. uvicorn has no option for these limits.
    """

    head_s = _HEAD_S
    read_s = _READ_S
    min_bytes_per_s = 4096.0
    max_each = 100
    trusted: tuple[Network, ...] = ()
    _late: asyncio.TimerHandle | None = None
    _unread: asyncio.TimerHandle | None = None
    _holder: str | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        """Start the timeout for the first head, or refuse a connection above the limit."""
        super().connection_made(transport)
        if self._is_one_too_many():
            transport.write(_TOO_MANY)
            transport.close()
            return
        self._await_head()

    def _is_one_too_many(self) -> bool:
        """Whether the address of this connection already holds the most connections allowed.

        Loopback addresses and trusted proxies have no limit: a proxy carries many clients and
        limits them itself.
        """
        address = self.client[0] if self.client else ""
        if not address or is_loopback(address) or is_within(address, self.trusted):
            return False
        self._holder = sender_of(address)
        same = [
            other for other in self.connections if getattr(other, "_holder", None) == self._holder
        ]
        return len(same) > self.max_each

    def data_received(self, data: bytes) -> None:
        """Run the timeout while a head is incomplete."""
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._await_head()
        else:
            self._stop_waiting()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timers."""
        self._stop_waiting()
        self._stop_watching()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Require from now on that the client reads: the write buffer is full."""
        super().pause_writing()
        if self._unread is None:
            self._watch_reader()

    def resume_writing(self) -> None:
        """Stop the timer: the client has read the buffer."""
        self._stop_watching()
        super().resume_writing()

    def timeout_keep_alive_handler(self) -> None:
        """Close an idle connection.

        Unread data is dropped, because a pending write buffer would keep the connection open.
        """
        super().timeout_keep_alive_handler()
        if self.transport.get_write_buffer_size():
            self.transport.abort()

    def _watch_reader(self) -> None:
        self._unread = self.loop.call_later(
            self.read_s, self._require_reading, self.transport.get_write_buffer_size()
        )

    def _require_reading(self, before: int) -> None:
        """Abort the connection if the client has read too little of ``before`` buffered bytes."""
        self._unread = None
        if before - self.transport.get_write_buffer_size() < self.read_s * self.min_bytes_per_s:
            self.transport.abort()
        else:
            self._watch_reader()

    def _stop_watching(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _await_head(self) -> None:
        if self._late is None:
            self._late = self.loop.call_later(self.head_s, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None


def protocol_of(settings: Settings) -> type[Protocol]:
    """Create the protocol class with the limits of ``settings``.

    uvicorn makes one instance of it for each connection.
    """
    bounds = {
        "max_each": settings.max_connections_each,
        "trusted": settings.trusted_proxies,
        "min_bytes_per_s": settings.min_bytes_per_s,
    }
    return type("BoundedProtocol", (Protocol,), bounds)
