"""A gate before the model: a few callers at a time, first come, first served."""

import threading
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager

from service.base.faults import BusyError

STOPPING = "the service is stopping; send the same again when it is back"
"""What requests are told that a stop ends."""

MOST_WAITING = 8
"""Requests that wait for the model, each on one of the web server's threads."""


class Gate:
    """Lets ``slots`` callers in at a time, in the order in which they came.

    Who has patience, such as a job, waits as long as it takes. Who has little, such as a request, which holds one of
    the web server's threads meanwhile, waits behind up to ``most_waiting`` others of its kind and no longer than it
    says.
    """

    def __init__(self, slots: int, most_waiting: int = MOST_WAITING) -> None:
        self._free = slots
        self._most_waiting = most_waiting
        self._hurried = 0
        self._is_closed = False
        self._changed = threading.Condition()
        self._line: deque[object] = deque()
        self._held_by: Counter[int] = Counter()
        self._forgotten: Counter[int] = Counter()

    @contextmanager
    def turn(self, patience_s: float | None = None) -> Iterator[None]:
        """A slot while the block runs; BusyError where it is not had in ``patience_s`` (None: however long)."""
        self.enter(patience_s)
        try:
            yield
        finally:
            self.leave()

    def enter(self, patience_s: float | None = None) -> None:
        """Take a slot, as `turn` does."""
        ticket = object()
        with self._changed:
            self._refuse_crowds(patience_s)
            self._line.append(ticket)
            self._hurried += patience_s is not None
            try:
                if not self._changed.wait_for(lambda: self._may_enter(ticket, patience_s), patience_s):
                    raise BusyError("the model is busy; ask again as Retry-After says")
                self.refuse_closed(patience_s)
                self._free -= 1
                self._held_by[threading.get_ident()] += 1
            finally:
                self._hurried -= patience_s is not None
                self._line.remove(ticket)
                self._changed.notify_all()  # the next one may be first now

    def _refuse_crowds(self, patience_s: float | None) -> None:
        if patience_s is not None and self._hurried >= self._most_waiting:
            raise BusyError("too many requests wait for the model; ask again as Retry-After says")

    def _may_enter(self, ticket: object, patience_s: float | None) -> bool:
        return (self._free > 0 and self._line[0] is ticket) or (self._is_closed and patience_s is not None)

    def close(self) -> None:
        """Let nobody in any more who has little patience: they are told to ask again, those that wait at once."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def refuse_closed(self, patience_s: float | None) -> None:
        """BusyError for those whom `close` turned away."""
        if self._is_closed and patience_s is not None:
            raise BusyError(STOPPING)

    def leave(self) -> None:
        """Give the slot back; nothing where others have it already, because this thread was forgotten."""
        thread = threading.get_ident()
        with self._changed:
            if self._forgotten[thread]:
                self._forgotten -= Counter([thread])
                return
            self._held_by -= Counter([thread])
            self._free += 1
            self._changed.notify_all()

    def forget(self, thread: int) -> None:
        """Give back what a thread, by its identifier, holds: it hangs, and may never do that itself."""
        with self._changed:
            held = self._held_by.pop(thread, 0)
            self._forgotten[thread] += held
            self._free += held
            self._changed.notify_all()

    def pause(self) -> None:
        """Let those go first that wait by now; for whoever holds a slot for long, between two steps."""
        self.leave()
        self.enter()
