"""Reasons of alarms: their labels and severities, and numbers of open alarms by severity."""

from collections import Counter
from typing import Annotated, Literal, NamedTuple, cast

from pydantic import Field
from sqlalchemy.orm import Session

from service.store import acknowledgements

Reason = Literal[
    "queue",
    "aims_outdated",
    "clock",
    "camera",
    "camera_undeclared",
    "effect_ended",
    "moved",
    "pointing",
    "accuracy",
    "fell",
    "dimmed",
    "untrusted",
    "unlike_heliostat",
    "sun_contradicts_time",
    "study_undecided",
    "drift",
    "no_photograph",
    "times_unknown",
]

Severity = Literal[1, 2, 3]

ReasonOf = Annotated[Reason, Field(description="What kind of alarm it is.")]
SeverityOf = Annotated[
    Severity, Field(description="By the reason: 1 act now, 2 act today, 3 when there is time.")
]
HeliostatOrPlant = Annotated[str | None, Field(description="null: the plant as a whole.")]
CountByReason = Annotated[dict[Reason, int], Field(description="Number of alarms by their reason.")]

SEVERITIES: dict[Severity, str] = {1: "Act now", 2: "Act today", 3: "When there is time"}
"""All severities with their labels, the most urgent first."""


class ReasonProperties(NamedTuple):
    """Label and severity of a reason."""

    label: str
    severity: Severity


REASONS: dict[Reason, ReasonProperties] = {
    "queue": ReasonProperties("Queue stuck", 1),
    "aims_outdated": ReasonProperties("Aims outdated", 1),
    "clock": ReasonProperties("Clock wrong", 1),
    "camera": ReasonProperties("Camera changed", 2),
    "camera_undeclared": ReasonProperties("Camera not declared", 2),
    "effect_ended": ReasonProperties("Effect ended", 2),
    "moved": ReasonProperties("Moved", 2),
    "pointing": ReasonProperties("Pointing error", 2),
    "accuracy": ReasonProperties("Newest forecast poor", 2),
    "fell": ReasonProperties("Accuracy fell", 2),
    "dimmed": ReasonProperties("Less light", 2),
    "untrusted": ReasonProperties("Surface not trusted", 2),
    "unlike_heliostat": ReasonProperties("Unlike its heliostat", 2),
    "sun_contradicts_time": ReasonProperties("Sun contradicts time", 2),
    "study_undecided": ReasonProperties("Study undecided", 2),
    "drift": ReasonProperties("Drives drift", 3),
    "no_photograph": ReasonProperties("No photograph", 3),
    "times_unknown": ReasonProperties("Times unknown", 3),
}
"""All reasons, the most urgent first."""


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
