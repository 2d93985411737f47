"""Numbers of open alerts."""

import math
import threading
import time
from collections import Counter

from service.twin.alerts.acknowledging import record_history
from service.twin.alerts.alerts import list_alerts
from service.twin.alerts.field_overview import FieldOverviewCache
from service.twin.alerts.reasons import SEVERITIES, Severity
from service.twin.runtime.runtime import Runtime

# Longest time that the count in the pages' menu is reused [s].
_COUNT_HOLDS_S = 15.0


class AlertCount:
    """Numbers of open alerts, which nobody has acknowledged, for the menu of every page.

    They are cached for some seconds. Each count also records the history of alerts.
    """

    def __init__(self, runtime: Runtime, cache: FieldOverviewCache) -> None:
        self._runtime, self._cache = runtime, cache
        self._lock = threading.Lock()
        self._counted: dict[Severity, int] = dict.fromkeys(SEVERITIES, 0)
        self._counted_s = -math.inf

    def by_severity(self) -> dict[Severity, int]:
        """The number of open alerts of each severity, at most some seconds old."""
        with self._lock:
            if time.monotonic() - self._counted_s >= _COUNT_HOLDS_S:
                with self._runtime.database.reading() as session:
                    found = list_alerts(session, self._cache, self._runtime.settings)
                record_history(self._runtime, found)
                counted = Counter(
                    item.severity for item in found.alerts if item.acknowledged_by is None
                )
                self._counted = {severity: counted[severity] for severity in SEVERITIES}
                self._counted_s = time.monotonic()
            return dict(self._counted)

    def read(self) -> int:
        """The number of all open alerts."""
        return sum(self.by_severity().values())

    @property
    def last(self) -> int:
        """The number of all open alerts at the last count, without a new one."""
        return sum(self._counted.values())

    def forget(self) -> None:
        """Count again at the next read, because an alert was acknowledged."""
        with self._lock:
            self._counted_s = -math.inf
