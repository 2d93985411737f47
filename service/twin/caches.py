"""Caches of results that take long to compute: for many callers, or made in the background."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, Protocol, TypeVar

from cachetools import FIFOCache, LRUCache, TTLCache, cached
from sqlalchemy.exc import SQLAlchemyError

Value = TypeVar("Value")


class Sized(Protocol):
    """A value that knows its size."""

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""


SizedValue = TypeVar("SizedValue", bound=Sized)


class RecentResults:
    """A cache of up to ``most`` results, each for ``seconds``.

    Concurrent callers of the same key wait for one computation.
    """

    def __init__(self, seconds: float, most: int = 16) -> None:
        @cached(TTLCache(most, seconds), key=lambda key, make: key, condition=threading.Condition())
        def result(key: Hashable, make: Callable[[], Any]) -> Any:
            return make()

        self._result = result

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The recent result of ``make`` for ``key``. Exceptions are raised and not cached."""
        found: Value = self._result(key, make)
        return found


class LargeResults:
    """A cache of the last results, up to ``most`` bytes in all.

    Larger results are computed and not cached. Concurrent callers of the same key wait for one
    computation.
    """

    def __init__(self, most: int) -> None:
        cache = LRUCache[Hashable, Any](most, getsizeof=lambda value: value.nbytes)

        @cached(cache, key=lambda key, make: key, condition=threading.Condition())
        def result(key: Hashable, make: Callable[[], Any]) -> Any:
            return make()

        self._result = result

    def get(self, key: Hashable, make: Callable[[], SizedValue]) -> SizedValue:
        """The cached result of ``make`` for ``key``. Exceptions are raised and not cached."""
        found: SizedValue = self._result(key, make)
        return found


Key = TypeVar("Key", bound=Hashable)

logger = logging.getLogger("heliotwin.service")


class BackgroundCache(Generic[Key, Value]):
    """Cache of results by key; one thread computes missing ones, each once.

    Parameters
    ----------
    work : callable
        Computes the result of a key. After a database error it is called again at the next request.
    failed
        Result if ``work`` raises any other error.
    name : str
        Name of the thread.
    most : int
        Largest number of results to keep, the newest ones.
    """

    def __init__(self, work: Callable[[Key], Value], failed: Value, name: str, most: int) -> None:
        self._work, self._failed, self._name, self._most = work, failed, name, most
        self._changed = threading.Condition()
        self._known: FIFOCache[Key, Value] = FIFOCache(most)
        self._wanted: OrderedDict[Key, None] = OrderedDict()
        self._under_way: Key | None = None
        self._is_closed = False
        self._thread: threading.Thread | None = None

    def wait_for(self, key: Key, seconds: float) -> Value | None:
        """The result of one key, computed next; None if not ready after ``seconds``."""
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
        """Stop the background work and wait for the current computation."""
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
            except Exception:  # the only thread must survive for the other keys
                logger.exception("%s: %s cannot be computed", self._name, key)
                value = self._failed
            with self._changed:
                self._known[key] = value
                self._changed.notify_all()
