"""Numbers of open alarms."""

import math
import threading
import time
from collections import Counter

from service.twin.alarms.acknowledging import record_history
from service.twin.alarms.alarms import find_alarms
from service.twin.alarms.field_overview import FieldOverviewCache
from service.twin.alarms.reasons import SEVERITIES, Severity
from service.twin.runtime.background_cache import BackgroundCache
from service.twin.runtime.runtime import Runtime

# Longest time that the count in the pages' menu is reused [s].
_COUNT_HOLDS_S = 15.0
# Longest time that the home page of a large field waits for a count [s].
_QUICK_S = 0.3


class AlarmCount:
    """Numbers of open alarms, which nobody has acknowledged, for the menu of every page.

    They are cached for some seconds. Each count also records the history of alarms.
    """

    def __init__(self, runtime: Runtime, cache: FieldOverviewCache) -> None:
        self._runtime, self._cache = runtime, cache
        self._lock = threading.Lock()
        self._counted: dict[Severity, int] = dict.fromkeys(SEVERITIES, 0)
        self._counted_s = -math.inf
        self._number = 0  # of counts so far
        self._background: BackgroundCache[int, dict[Severity, int] | None] = BackgroundCache(
            lambda _: self.by_severity(), None, "alarms", 1
        )

    def close(self) -> None:
        """Stop the background work."""
        self._background.close()

    def at_once(self) -> dict[Severity, int] | None:
        """The numbers of the last count, for a large field; None before the first.

        Another count that is due begins in the background, and is waited for briefly.
        """
        if not self._number:
            return None
        if time.monotonic() - self._counted_s >= _COUNT_HOLDS_S:
            self.begin(_QUICK_S)
        return dict(self._counted)

    def begin(self, seconds: float = 0.0) -> None:
        """Begin a count in the background, and wait for it at most ``seconds``."""
        self._background.wait_for(self._number, seconds)

    def by_severity(self) -> dict[Severity, int]:
        """The number of open alarms of each severity, at most some seconds old."""
        with self._lock:
            if time.monotonic() - self._counted_s >= _COUNT_HOLDS_S:
                with self._runtime.database.reading() as session:
                    found = find_alarms(session, self._cache, self._runtime.settings)
                record_history(self._runtime, found)
                counted = Counter(
                    item.severity for item in found.alarms if item.acknowledged_by is None
                )
                self._counted = {severity: counted[severity] for severity in SEVERITIES}
                self._counted_s = time.monotonic()
                self._number += 1
            return dict(self._counted)

    def read(self) -> int:
        """The number of all open alarms."""
        return sum(self.by_severity().values())

    @property
    def last(self) -> int:
        """The number of all open alarms at the last count, without a new one."""
        return sum(self._counted.values())

    def forget(self) -> None:
        """Count again at the next read, because an alarm was acknowledged."""
        with self._lock:
            self._counted_s = -math.inf
