"""Caches of results that many callers need and that take long to compute."""

import threading
from collections.abc import Callable, Hashable
from typing import Any, Protocol, TypeVar

from cachetools import LRUCache, TTLCache, cached

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
