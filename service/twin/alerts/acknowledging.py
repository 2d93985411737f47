"""Acknowledging alerts together, undoing that, and recording their history."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy.orm import Session

from service import store
from service.base.errors import ConflictError, NotFoundError
from service.store import acknowledgements
from service.store.acknowledgements import AlarmHistory
from service.store.surfaces import decisions
from service.store.tables import HeliostatRow, SurfaceRow
from service.twin.alerts.alerts import Alert, AlertList, list_alerts
from service.twin.alerts.field_overview import FieldOverviewCache
from service.twin.alerts.reasons import REASONS, Reason, Severity
from service.twin.runtime.runtime import Runtime


@dataclass(frozen=True)
class AlertFilter:
    """Which alerts are wanted; None admits all."""

    reason: Reason | None = None
    severity: int | None = None
    heliostat: str | None = None
    acknowledged: bool | None = None

    def choose(self, alerts: Iterable[Alert]) -> list[Alert]:
        """The wanted ones, in their order."""
        return [
            alert
            for alert in alerts
            if self.reason in (None, alert.reason)
            and self.severity in (None, alert.severity)
            and self.heliostat in (None, alert.heliostat)
            and self.acknowledged in (None, alert.acknowledged_by is not None)
        ]


@dataclass(frozen=True)
class AlertsTogether:
    """Alerts that are acknowledged together."""

    alerts: tuple[Alert, ...]

    @property
    def count(self) -> int:
        """The number of alerts."""
        return len(self.alerts)

    @property
    def first_at(self) -> datetime:
        """Since when the oldest alert lasts."""
        return min(alert.since for alert in self.alerts)

    @property
    def last_at(self) -> datetime:
        """Since when the newest alert lasts."""
        return max(alert.since for alert in self.alerts)

    def token_for(self, name: str) -> str:
        """Identifier of exactly these alerts, which changes if one comes, goes or changes."""
        ids = "\n".join(sorted(alert.id for alert in self.alerts))
        return f"{name}:{hashlib.sha256(ids.encode()).hexdigest()[:12]}"


@dataclass(frozen=True)
class AlertGroup(AlertsTogether):
    """Alerts of one reason."""

    reason: Reason

    @property
    def severity(self) -> Severity:
        """Severity of the reason."""
        return REASONS[self.reason].severity

    @property
    def token(self) -> str:
        """Identifier of the group with exactly these alerts."""
        return self.token_for(self.reason)


def group_alerts(alerts: Sequence[Alert]) -> list[AlertGroup]:
    """Group alerts by reason, the most urgent reason first."""
    groups = [
        AlertGroup(tuple(alert for alert in alerts if alert.reason == reason), reason)
        for reason in REASONS
    ]
    return [group for group in groups if group.alerts]


def acknowledge(
    runtime: Runtime, found: AlertList, ids: Sequence[str], actor: str, comment: str
) -> list[Alert]:
    """Acknowledge some of the alerts ``found`` as one batch; return them in the order of ``ids``.

    Raises
    ------
    NotFoundError
        If an id is not a current alert. Then none is acknowledged.
    """
    items = {item.id: item for item in found.alerts}
    missing = [number for number in ids if number not in items]
    if missing:
        raise NotFoundError(
            f"ids: {missing[0]} does not need attention, or its reason changed; see /v1/attention"
        )
    record_history(runtime, found)
    chosen = [items[number] for number in ids]
    with runtime.database.writing() as session:
        rows = acknowledgements.acknowledge(session, [item.key for item in chosen], actor, comment)
        for item in chosen:
            if item.reason == "untrusted":
                heliostat = store.get_heliostat(session, item.heliostat or "")
                surface = _flagged_surface(session, heliostat)
                decisions.acknowledge_warnings(session, heliostat, surface, actor)
    return [item.with_acknowledgement(row) for item, row in zip(chosen, rows, strict=True)]


def acknowledge_surface(
    runtime: Runtime, cache: FieldOverviewCache, name: str, version: int, actor: str, comment: str
) -> None:
    """Acknowledge the alert that a heliostat's surface is not trusted.

    Raises
    ------
    ConflictError
        If there is no such alert, or it is about another version.
    """
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, name)
        surface = store.get_surface(session, heliostat, version)
        found = list_alerts(session, cache, runtime.settings)
        is_shown = _flagged_surface(session, heliostat).id == surface.id
    alerts = AlertFilter("untrusted", heliostat=name).choose(found.alerts)
    if not (alerts and is_shown):
        raise ConflictError(
            f"heliostat {name}: surface {version} has no warnings to acknowledge; only those of"
            " the active surface can be acknowledged"
        )
    acknowledge(runtime, found, [alert.id for alert in alerts], actor, comment)


def undo_acknowledgement(runtime: Runtime, batch: int, actor: str) -> None:
    """Undo the acknowledgements of a batch. Raises the errors of `acknowledgements.undo`."""
    with runtime.database.writing() as session:
        for key in acknowledgements.undo(session, batch, actor):
            if key.reason == "untrusted":
                heliostat = store.get_heliostat(session, key.heliostat or "")
                surface = _flagged_surface(session, heliostat)
                decisions.forget_acknowledgement(session, heliostat, surface, actor)


def _flagged_surface(session: Session, heliostat: HeliostatRow) -> SurfaceRow:
    """The surface that the alert "untrusted" is about."""
    candidate = store.find_candidate(session, heliostat)
    return candidate or store.get_surface_at(session, heliostat)


def record_history(runtime: Runtime, found: AlertList) -> None:
    """Record which alerts came and went. Nothing is recorded while results are pending."""
    present = {item.key: (item.message, item.since) for item in found.alerts}
    with runtime.database.reading() as session:
        is_known = acknowledgements.open_alarms(session).keys() == present.keys()
    if not (is_known or found.pending):
        with runtime.database.writing() as session:
            acknowledgements.record_alarms(session, present)


def read_history(
    runtime: Runtime,
    cache: FieldOverviewCache,
    limit: int,
    after: int | None = None,
    wanted: AlertFilter = AlertFilter(),
) -> list[AlarmHistory]:
    """Up to ``limit`` alerts that are or were present, older than record ``after``.

    What came or went since the last record is recorded first.
    """
    with runtime.database.reading() as session:
        found = list_alerts(session, cache, runtime.settings)
    record_history(runtime, found)
    with runtime.database.reading() as session:
        return acknowledgements.list_history(session, limit, after, wanted.reason, wanted.heliostat)
