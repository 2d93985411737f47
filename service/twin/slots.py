"""Compute slots: a few callers use the model at a time, in fair order.

The limiters of no library serve callers in turn.
"""

import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Generic, NamedTuple, TypeVar

from service.base.errors import BusyError

STOPPING = "the service is stopping; send the same again when it is back"
"""Error message for requests that a stop of the service ends."""

_CHECK_EVERY_S = 0.25
"""Interval at which a waiting caller's check is called [s]."""

MAX_WAITING = 8
"""Requests that may wait for the model, each in a thread of the web server."""


class ComputeSlots:
    """Slots that are shared fairly between API keys.

    Keys take turns, and the callers of a key are served in the order of arrival. All jobs together
    count as one key. A caller without a timeout, such as a job, waits as long as needed. A request
    occupies one of the web server's threads while it waits. Therefore it waits no longer than its
    timeout, and only ``max_waiting`` requests wait at a time.
    """

    def __init__(self, slots: int, max_waiting: int = MAX_WAITING) -> None:
        self._free = slots
        self._max_waiting = max_waiting
        self._n_requests_waiting = 0
        self._is_closed = False
        self._changed = threading.Condition()
        self._queue = FairQueue[object]()
        self._held_by: Counter[int] = Counter()
        self._released: Counter[int] = Counter()

    @contextmanager
    def slot(
        self, timeout_s: float | None = None, check: Callable[[], None] | None = None
    ) -> Iterator[None]:
        """Hold a slot while the block runs.

        Raises BusyError if no slot is free within ``timeout_s``; None is without limit. During the
        wait, ``check`` is called repeatedly. An exception that it raises ends the wait.
        """
        self.enter(timeout_s, check)
        try:
            yield
        finally:
            self.leave()

    def enter(
        self, timeout_s: float | None = None, check: Callable[[], None] | None = None
    ) -> None:
        """Take a slot, as `slot` does."""
        ticket, caller = object(), CALLER.get()
        with self._changed:
            if timeout_s is not None and self._n_requests_waiting >= self._max_waiting:
                raise BusyError(
                    "too many requests wait for the model; ask again as Retry-After says"
                )
            self._queue.add(caller, ticket)
            self._n_requests_waiting += timeout_s is not None
            has_entered = False
            try:
                if not self._wait(lambda: self._may_enter(ticket, timeout_s), timeout_s, check):
                    raise BusyError("the model is busy; ask again as Retry-After says")
                self.refuse_closed(timeout_s)
                self._queue.serve(caller)
                self._free -= 1
                self._held_by[threading.get_ident()] += 1
                has_entered = True
            finally:
                self._n_requests_waiting -= timeout_s is not None
                if not has_entered:
                    self._queue.remove(caller, ticket)
                self._changed.notify_all()  # another caller may be next now

    def _wait(
        self, ready: Callable[[], bool], timeout_s: float | None, check: Callable[[], None] | None
    ) -> bool:
        """Wait until ``ready``; return False at the timeout.

        With a ``check`` there is no timeout, and an exception of ``check`` ends the wait.
        """
        if check is None:
            return self._changed.wait_for(ready, timeout_s)
        while not self._changed.wait_for(ready, _CHECK_EVERY_S):
            check()
        return True

    def _may_enter(self, ticket: object, timeout_s: float | None) -> bool:
        following = self._queue.next()
        is_next = following is not None and following.ticket is ticket
        return (self._free > 0 and is_next) or (self._is_closed and timeout_s is not None)

    def close(self) -> None:
        """Refuse callers with a timeout from now on, those that wait included."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def refuse_closed(self, timeout_s: float | None) -> None:
        """Raise BusyError for callers that `close` refuses."""
        if self._is_closed and timeout_s is not None:
            raise BusyError(STOPPING)

    def leave(self) -> None:
        """Release the slot, unless `forget` has released it for this thread."""
        thread = threading.get_ident()
        with self._changed:
            if self._released[thread]:
                self._released -= Counter([thread])
                return
            self._held_by -= Counter([thread])
            self._free += 1
            self._changed.notify_all()

    def forget(self, thread: int) -> None:
        """Release all slots of a thread that hangs, by its identifier."""
        with self._changed:
            n_held = self._held_by.pop(thread, 0)
            self._released[thread] += n_held
            self._free += n_held
            self._changed.notify_all()

    def pause(self, check: Callable[[], None] | None = None) -> None:
        """Let waiting callers go first, between two steps of a long computation."""
        self.leave()
        try:
            self.enter(check=check)
        except BaseException:
            with self._changed:  # the caller's `slot` block must not release it a second time
                self._released[threading.get_ident()] += 1
            raise


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
