"""Acknowledging alarms together, and undoing that."""

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated

from pydantic import Field, computed_field
from sqlalchemy.orm import Session

from service import store
from service.base.errors import ConflictError, NotFoundError
from service.base.fields import Model, Name
from service.store import acknowledgements, decisions
from service.store.columns import now
from service.store.job_tables import AcknowledgementRow
from service.store.rows import lock_heliostat
from service.store.tables import HeliostatRow, SurfaceRow
from service.twin.alarms.alarms import Alarm, AlarmList, find_untrusted, untrusted_fingerprint
from service.twin.alarms.field_overview import read_summaries
from service.twin.alarms.reasons import REASONS, Reason, Severity
from service.twin.runtime import Runtime


class AlarmFilter(Model):
    """Which alarms are wanted; None admits all."""

    reason: Reason | None = Field(default=None, description="Only this reason.")
    severity: int | None = Field(
        default=None, ge=1, le=3, description="Only this severity: 1, 2 or 3."
    )
    heliostat: Name | None = Field(default=None, description="Only this heliostat.")
    acknowledged: bool | None = Field(
        default=None, description="Only alarms that are, or are not, acknowledged."
    )

    def choose(self, alarms: Iterable[Alarm]) -> list[Alarm]:
        """The wanted ones, in their order."""
        return [
            alarm
            for alarm in alarms
            if self.reason in (None, alarm.reason)
            and self.severity in (None, alarm.severity)
            and self.heliostat in (None, alarm.heliostat)
            and self.acknowledged in (None, alarm.acknowledged_by is not None)
        ]


@dataclass(frozen=True)
class AlarmsTogether:
    """Alarms that are acknowledged together."""

    members: Annotated[Sequence[Alarm], Field(exclude=True)]

    @property
    def count(self) -> int:
        """The number of alarms."""
        return len(self.members)

    @computed_field
    @property
    def first_at(self) -> datetime:
        """When it began."""
        return min(alarm.since for alarm in self.members)

    @computed_field
    @property
    def last_at(self) -> datetime:
        """When the newest of them began."""
        return max(alarm.since for alarm in self.members)

    @property
    def kind(self) -> str:
        """What they have in common: a cause, or a reason."""
        return "cause"

    @property
    def token(self) -> str:
        """Identifier of exactly these alarms, which changes if one comes, goes or changes."""
        ids = "\n".join(sorted(alarm.id for alarm in self.members))
        return f"{self.kind}:{hashlib.sha256(ids.encode()).hexdigest()[:12]}"


@dataclass(frozen=True)
class AlarmGroup(AlarmsTogether):
    """Alarms of one reason."""

    reason: Reason

    @property
    def severity(self) -> Severity:
        """Severity of the reason."""
        return REASONS[self.reason].severity

    @property
    def kind(self) -> str:
        """The reason."""
        return self.reason


def group_alarms(alarms: Sequence[Alarm]) -> list[AlarmGroup]:
    """Group alarms by reason, the most urgent reason first."""
    groups = [
        AlarmGroup([alarm for alarm in alarms if alarm.reason == reason], reason)
        for reason in REASONS
    ]
    return [group for group in groups if group.members]


def acknowledge(
    runtime: Runtime, found: AlarmList, ids: Sequence[str], actor: str, comment: str
) -> list[Alarm]:
    """Acknowledge some of the alarms ``found`` as one batch; return them in the order of ``ids``.

    Raises
    ------
    NotFoundError
        If an id is not a current alarm. Then none is acknowledged.
    """
    items = {item.id: item for item in found.alarms}
    missing = [number for number in ids if number not in items]
    if missing:
        raise NotFoundError(
            f"ids: {missing[0]} is not an alarm, or its reason changed; see /v1/alarms"
        )
    chosen = [items[number] for number in ids]

    def write(session: Session) -> list[AcknowledgementRow]:
        rows = acknowledgements.acknowledge(session, [item.key for item in chosen], actor, comment)
        for key in (item.key for item in chosen if item.reason == "untrusted"):
            for heliostat, surface in _untrusted(session, key):
                decisions.acknowledge_warnings(session, heliostat, surface, actor)
        return rows

    rows = runtime.database.run_in_transaction(write)
    return [item.with_acknowledgement(row) for item, row in zip(chosen, rows, strict=True)]


def acknowledge_surface(
    runtime: Runtime, name: str, version: int, actor: str, comment: str
) -> None:
    """Acknowledge the alarm that a heliostat's surface is not trusted.

    Raises
    ------
    ConflictError
        If there is no such alarm, or it is about another version.
    """

    def write(session: Session) -> None:
        heliostat = store.get_heliostat(session, name)
        lock_heliostat(session, heliostat)
        surface = store.get_surface(session, heliostat, version)
        (line,) = read_summaries(session, heliostat.id)
        alarm = find_untrusted(line, now())
        if alarm is None or _flagged_surface(session, heliostat).id != surface.id:
            raise ConflictError(
                f"heliostat {name}: surface {version} has no warnings to acknowledge; only those"
                " of the active surface can be acknowledged"
            )
        acknowledgements.acknowledge(session, [alarm.key], actor, comment)
        decisions.acknowledge_warnings(session, heliostat, surface, actor)

    runtime.database.run_in_transaction(write)


def undo_acknowledgement(runtime: Runtime, batch: int, actor: str) -> None:
    """Undo the acknowledgements of a batch. Raises the errors of `acknowledgements.undo`."""

    def write(session: Session) -> None:
        for key in acknowledgements.undo(session, batch, actor):
            if key.reason == "untrusted":
                for heliostat, surface in _untrusted(session, key):
                    decisions.forget_acknowledgement(session, heliostat, surface, actor)

    runtime.database.run_in_transaction(write)


def _untrusted(
    session: Session, key: acknowledgements.Key
) -> Iterator[tuple[HeliostatRow, SurfaceRow]]:
    """The surface versions that an alarm "untrusted" is about, which have the same warnings."""
    heliostat = store.get_heliostat(session, key.heliostat or "")
    lock_heliostat(session, heliostat)
    for surface in store.list_surfaces(session, heliostat, None):
        if surface.warnings and untrusted_fingerprint(surface) == key.fingerprint:
            yield heliostat, surface


def _flagged_surface(session: Session, heliostat: HeliostatRow) -> SurfaceRow:
    """The surface that the alarm "untrusted" is about."""
    candidate = store.find_candidate(session, heliostat)
    return candidate or store.get_surface_at(session, heliostat)
