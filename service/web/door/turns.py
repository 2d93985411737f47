"""Turns at what is heavy: few at a time, shared fairly between keys, and whoever waits holds no thread."""

from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio

from service.base.faults import BusyError


class Turns:
    """Up to ``count`` requests at a time, up to ``most_waiting`` behind them, each for ``patience_s`` at the most.

    One key has at most half of the turns and of the places to wait, so that there is always room for another; those
    that wait are served one key after the other. For one event loop: between two awaits nothing else happens.
    """

    def __init__(self, count: int = 2, most_waiting: int = 32, patience_s: float = 10.0) -> None:
        self._free = count
        self._most_each = max(1, count // 2)
        self._most_waiting = most_waiting
        self._patience_s = patience_s
        self._taken: Counter[str] = Counter()
        # Who waits, by key, the key that was served longest ago first; whose event is set has a turn.
        self._lines: OrderedDict[str, deque[anyio.Event]] = OrderedDict()

    @asynccontextmanager
    async def one(self, who: str) -> AsyncIterator[None]:
        """A turn for the key ``who``; BusyError where too many are waiting, or it does not come in time."""
        turn = self._ask(who)
        try:
            with anyio.move_on_after(self._patience_s):
                await turn.wait()
            if not turn.is_set():
                raise BusyError("heavy work is done one after the other; ask again as Retry-After says")
            yield
        finally:
            self._end(who, turn)

    def _ask(self, who: str) -> anyio.Event:
        """The event that says that the turn has come: at once where there is one."""
        turn, line = anyio.Event(), self._lines.get(who, ())
        if self._may_go(who):
            self._go(who, turn)
            return turn
        if len(line) >= (self._most_waiting + 1) // 2 or sum(map(len, self._lines.values())) >= self._most_waiting:
            raise BusyError("too much heavy work is waited for; ask again as Retry-After says")
        self._lines.setdefault(who, deque()).append(turn)
        return turn

    def _may_go(self, who: str) -> bool:
        return self._free > 0 and self._taken[who] < self._most_each

    def _go(self, who: str, turn: anyio.Event) -> None:
        self._free -= 1
        self._taken[who] += 1
        turn.set()

    def _end(self, who: str, turn: anyio.Event) -> None:
        """Give a turn, or the place of one that did not come, back."""
        if turn.is_set():
            self._free += 1
            self._taken[who] -= 1
            if not self._taken[who]:
                del self._taken[who]
            self._serve()
        else:
            self._lines[who].remove(turn)
            self._drop_if_empty(who)

    def _serve(self) -> None:
        """The turn that is free now to the first key in line that may have one, which is the last from then on."""
        who = next(filter(self._may_go, self._lines), None)
        if who is not None:
            self._go(who, self._lines[who].popleft())
            self._lines.move_to_end(who)
            self._drop_if_empty(who)

    def _drop_if_empty(self, who: str) -> None:
        if not self._lines[who]:
            del self._lines[who]
