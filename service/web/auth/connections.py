"""Limits on connections: the number per address, and the time that a client may stay silent.

A client must send the head of its request in time, and must read the response in time.
"""

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.base.settings import Network, Settings, is_loopback, is_within
from service.web.auth.rate_limiter import sender_of

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
