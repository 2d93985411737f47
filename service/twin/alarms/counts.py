"""Numbers of open alarms."""

from collections import Counter
from typing import cast

from sqlalchemy.orm import Session

from service.store import acknowledgements
from service.twin.alarms.reasons import REASONS, SEVERITIES, Reason, Severity


class AlarmCount:
    """Numbers of open alarms, which nobody has acknowledged, for the menu of every page.

    ``last`` is that of the newest `read`, which a page shows until its menu asks again.
    """

    last = 0

    def read(self, session: Session) -> dict[Severity, int]:
        """The number of open alarms of each severity."""
        counted: Counter[Severity] = Counter()
        for reason, count in acknowledgements.count_unacknowledged(session).items():
            counted[REASONS[cast(Reason, reason)].severity] += count
        self.last = counted.total()
        return {severity: counted[severity] for severity in SEVERITIES}
