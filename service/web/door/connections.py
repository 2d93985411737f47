"""Connections: how many one address may hold, and how long one may be without a request's head."""

import asyncio
import ipaddress

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.base.settings import Network, Settings, is_loopback, is_within

# Seconds that a client may take for a request's head.
_HEAD_S = 20.0

# Said before anything was asked: whoever has this many connections gets no other.
_TOO_MANY = b"HTTP/1.1 503 Service Unavailable\r\nRetry-After: 5\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


def _holder(address: str) -> str:
    """Who holds connections from an address: with IPv6 a whole /64, for that is what one client is given."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:  # a socket without one
        return address
    if isinstance(found, ipaddress.IPv4Address):
        return address
    return str(found.ipv4_mapped or ipaddress.IPv6Network((found, 64), strict=False))


class Protocol(H11Protocol):
    """Ends connections whose request's head does not come in time, and those that are one address's too many.

    uvicorn has an option for neither.
    """

    head_s = _HEAD_S
    most_each = 100
    trusted: tuple[Network, ...] = ()
    _late: asyncio.TimerHandle | None = None
    _holder: str | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        """Wait for the first head from now on, unless its sender has connections enough."""
        super().connection_made(transport)
        if self._is_one_too_many():
            transport.write(_TOO_MANY)
            transport.close()
            return
        self._await_head()

    def _is_one_too_many(self) -> bool:
        """Not of this machine, nor of a proxy that is trusted: many come through there, and it has limits itself."""
        address = self.client[0] if self.client else ""
        if not address or is_loopback(address) or is_within(address, self.trusted):
            return False
        self._holder = _holder(address)
        held = [other for other in self.connections if getattr(other, "_holder", None) == self._holder]
        return len(held) > self.most_each

    def data_received(self, data: bytes) -> None:
        """Wait on where the head is not whole, and no more where it is."""
        super().data_received(data)
        if self.conn.their_state is h11.IDLE:
            self._await_head()
        else:
            self._stop_waiting()

    def connection_lost(self, exc: Exception | None) -> None:
        """There is nothing to wait for."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _await_head(self) -> None:
        if self._late is None:
            self._late = self.loop.call_later(self.head_s, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None


def protocol_of(settings: Settings) -> type[Protocol]:
    """The protocol with the bounds of these settings; uvicorn makes one of it for each connection."""
    bounds = {"most_each": settings.most_connections_each, "trusted": settings.trusted_proxies}
    return type("BoundedProtocol", (Protocol,), bounds)
