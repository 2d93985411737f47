"""What takes long to tell: worked out once, in the background, and remembered."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from typing import Generic, TypeVar

from sqlalchemy.exc import SQLAlchemyError

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")

logger = logging.getLogger("heliotwin.service")


class Book(Generic[Key, Value]):
    """Answers by key; those that are missing are worked out by one thread, one after another, each once.

    Parameters
    ----------
    work : callable
        Makes the answer to a key. What the database refuses is tried again when it is asked for again.
    failed
        The answer where ``work`` raises anything else.
    name : str
        Of the thread.
    most : int
        Answers that are kept, the newest.
    """

    def __init__(self, work: Callable[[Key], Value], failed: Value, name: str, most: int) -> None:
        self._work, self._failed, self._name, self._most = work, failed, name, most
        self._changed = threading.Condition()
        self._known: OrderedDict[Key, Value] = OrderedDict()
        self._wanted: OrderedDict[Key, None] = OrderedDict()
        self._under_way: Key | None = None
        self._is_closed = False
        self._thread: threading.Thread | None = None

    def look_up(self, keys: Iterable[Key], seconds: float = 0.0) -> tuple[dict[Key, Value], int]:
        """What is known of the keys after so many seconds at the most, and how many are missing.

        Those are the only ones worked at from now on.
        """
        with self._changed:
            asked = list(keys)
            missing = [key for key in asked if key not in self._known]
            # What nobody asks for any more is not worth the work, and what is under way is not worth it twice.
            self._wanted = OrderedDict.fromkeys(key for key in missing if key != self._under_way)
            self._start()
            if missing and seconds:
                self._changed.wait_for(lambda: all(key in self._known for key in missing) or self._is_closed, seconds)
            known = {key: self._known[key] for key in asked if key in self._known}
            return known, len(asked) - len(known)

    def wait_for(self, key: Key, seconds: float) -> Value | None:
        """The answer to one key, next in turn; None where it is not there after so many seconds."""
        with self._changed:
            if key not in self._known and key != self._under_way:
                self._wanted[key] = None
                self._wanted.move_to_end(key, last=False)
                while len(self._wanted) > self._most:
                    self._wanted.popitem()
                self._start()
            self._changed.wait_for(lambda: key in self._known or self._is_closed, seconds)
            return self._known.get(key)

    def close(self) -> None:
        """Stop working, and wait for what is under way."""
        with self._changed:
            self._is_closed = True
            self._wanted.clear()
            thread = self._thread
            self._changed.notify_all()
        if thread is not None:
            thread.join()

    def _start(self) -> None:
        if self._wanted and not self._is_closed and self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()

    def _next(self) -> Key | None:
        with self._changed:
            self._under_way = self._wanted.popitem(last=False)[0] if self._wanted else None
            if self._under_way is None:
                self._thread = None
            return self._under_way

    def _run(self) -> None:
        while (key := self._next()) is not None:
            try:
                value = self._work(key)
            except SQLAlchemyError as error:
                logger.warning("%s: %s waits for the database: %s", self._name, key, error)
                continue
            except Exception:  # whatever it is, the one thread that there is must live for the other keys
                logger.exception("%s: %s cannot be told", self._name, key)
                value = self._failed
            with self._changed:
                self._known[key] = value
                while len(self._known) > self._most:
                    self._known.popitem(last=False)
                self._changed.notify_all()
