"""A short-lived cache of results that many callers need and that take long to compute."""

import threading
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

from cachetools import TTLCache, cached

Value = TypeVar("Value")


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
