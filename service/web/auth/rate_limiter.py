"""Rate limits: one token bucket for each name."""

import ipaddress
import time
from collections.abc import Callable

from cachetools import LRUCache

from service.base.settings import address_of

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
