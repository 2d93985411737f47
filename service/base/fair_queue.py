"""A fair queue: callers are served in turn, which the limiters of no library do."""

from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Generic, NamedTuple, TypeVar

Ticket = TypeVar("Ticket")

CALLER: ContextVar[str] = ContextVar("caller", default="")
"""Name of the key of the current request; empty in jobs."""


@contextmanager
def as_caller(name: str) -> Iterator[None]:
    """Set `CALLER` to the key ``name`` in a block."""
    token = CALLER.set(name)
    try:
        yield
    finally:
        CALLER.reset(token)


class Waiting(NamedTuple, Generic[Ticket]):
    """A caller and its first ticket."""

    caller: str
    ticket: Ticket


class FairQueue(Generic[Ticket]):
    """A queue of tickets. The next ticket is from the caller that was served longest ago.

    It is not thread-safe: users must lock it.
    """

    def __init__(self) -> None:
        self._lines: OrderedDict[str, deque[Ticket]] = OrderedDict()

    def __len__(self) -> int:
        """The number of waiting tickets."""
        return sum(map(len, self._lines.values()))

    def count(self, caller: str) -> int:
        """The number of a caller's waiting tickets."""
        return len(self._lines.get(caller, ()))

    def add(self, caller: str, ticket: Ticket) -> None:
        """Add a ticket behind the others of its caller."""
        self._lines.setdefault(caller, deque()).append(ticket)

    def remove(self, caller: str, ticket: Ticket) -> None:
        """Remove a ticket whose caller no longer waits for it. The caller's rank is unchanged."""
        self._lines[caller].remove(ticket)
        self._drop_if_empty(caller)

    def next(self, may: Callable[[str], bool] = lambda caller: True) -> Waiting[Ticket] | None:
        """The next ticket among callers that ``may`` be served; None if there is none.

        The ticket remains in the queue.
        """
        return next(
            (Waiting(caller, line[0]) for caller, line in self._lines.items() if may(caller)), None
        )

    def serve(self, caller: str) -> Ticket:
        """Remove and return a caller's first ticket. The caller then has the last rank."""
        ticket = self._lines[caller].popleft()
        self._lines.move_to_end(caller)
        self._drop_if_empty(caller)
        return ticket

    def _drop_if_empty(self, caller: str) -> None:
        if not self._lines[caller]:
            del self._lines[caller]
