"""How often somebody may ask: a token bucket for each."""

import time
from collections import OrderedDict
from collections.abc import Callable

# Buckets that are kept; the one unused for longest goes first.
_MOST = 10_000


class Buckets:
    """Each name has a bucket of ``burst`` tokens that fills at ``rate_per_s``; a request takes one, and may owe more.

    For one event loop: nothing here waits, so nothing needs a lock.
    """

    def __init__(self, rate_per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate_per_s = rate_per_s
        self.burst = burst
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, name: str) -> float:
        """Take a token of ``name``: 0 where there was one, else the seconds until there is."""
        tokens = self._tokens(name)
        has_one = tokens >= 1
        self._put(name, tokens - 1 if has_one else tokens)
        return 0.0 if has_one else (1 - tokens) / self.rate_per_s

    def charge(self, name: str, cost: float) -> None:
        """Take ``cost`` tokens of ``name`` for what is known only afterwards; where there are less it owes them."""
        self._put(name, self._tokens(name) - cost)

    def _tokens(self, name: str) -> float:
        tokens, since = self._buckets.get(name, (float(self.burst), self._clock()))
        return min(float(self.burst), tokens + (self._clock() - since) * self.rate_per_s)

    def _put(self, name: str, tokens: float) -> None:
        self._buckets[name] = (tokens, self._clock())
        self._buckets.move_to_end(name)
        if len(self._buckets) > _MOST:
            self._buckets.popitem(last=False)
