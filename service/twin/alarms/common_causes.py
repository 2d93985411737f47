"""Probable common causes of alarms that began together.

Alarms of one reason that began within a day, and more often than usual, are a burst. What the store
knows of that time is evidence of its cause. Bursts with the same evidence have one cause.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import groupby
from statistics import median
from typing import Annotated

from pydantic import Field, computed_field
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.times import format_minute
from service.base.settings import Settings
from service.store.job_tables import JobRow
from service.store.tables import (
    SUN_CONTRADICTS_TIME,
    HeliostatRow,
    MeasurementRow,
    ModelRow,
    TargetRow,
)
from service.twin.alarms.acknowledging import AlarmsTogether
from service.twin.alarms.alarms import Alarm, AlarmId
from service.twin.alarms.reasons import REASONS, Reason

MIN_ALARMS = 5
"""Smallest number of alarms in a burst."""

_MIN_SAME_CLOCK = 3  # heliostats whose photographs one wrong clock explains
_WINDOW = timedelta(days=1)
_LEAST_RATIO = 5.0  # of a burst's alarms to those that begin on another day
_LEAST_DAYS = 30.0  # over which the other alarms are counted at least
_WINDY_M_S = 10.0
_NEARLY_ALL = 0.8
_MOST_NAMES = 1000  # heliostats whose photographs are read

_CAUSED: dict[Reason, tuple[Reason, ...]] = {
    "camera": ("accuracy", "fell", "untrusted", "unlike_heliostat"),
    "clock": ("moved", "pointing", "drift", "sun_contradicts_time"),
}
"""Reasons of the plant, with the reasons of heliostats that may follow from them."""

_BY_MODEL: tuple[Reason, ...] = ("accuracy", "fell", "pointing", "untrusted")
_BY_JOB: dict[Reason, str] = {
    "untrusted": "predictions",
    "unlike_heliostat": "imports",
    "sun_contradicts_time": "imports",
    "times_unknown": "imports",
}
_ON_ARRIVAL: tuple[Reason, ...] = ("unlike_heliostat", "sun_contradicts_time", "times_unknown")
"""Reasons that begin when a photograph arrives."""
_WHEN_TAKEN: tuple[Reason, ...] = ("accuracy", "fell", "moved", "pointing")
"""Reasons that begin when a photograph is taken."""


@dataclass(frozen=True)
class CommonCause(AlarmsTogether):
    """Alarms that probably have one cause."""

    evidence: Annotated[
        tuple[str, ...],
        Field(description="What the store knows of that time; empty if it knows nothing."),
    ]

    @computed_field
    @property
    def alarms(self) -> dict[Reason, int]:
        """Number of alarms by their reason."""
        return Counter(alarm.reason for alarm in self.members)

    @computed_field
    @property
    def heliostats(self) -> list[str]:
        """Names of the heliostats."""
        return sorted({alarm.heliostat for alarm in self.members if alarm.heliostat})

    @computed_field
    @property
    def ids(self) -> list[AlarmId]:
        """Ids of the alarms, to acknowledge them together."""
        return [alarm.id for alarm in self.members]


def find_common_causes(
    session: Session, alarms: Sequence[Alarm], settings: Settings
) -> list[CommonCause]:
    """Find bursts among ``alarms`` that nobody acknowledged, the largest first."""
    opened = [alarm for alarm in alarms if alarm.acknowledged_by is None]
    clocks = _same_clocks(session, opened, settings)
    explained = {alarm.key for one in clocks for alarm in one.members}
    opened = [alarm for alarm in opened if alarm.key not in explained]
    found = clocks + [
        CommonCause(burst, tuple(_evidence(session, burst, opened, settings)))
        for reason in REASONS
        for burst in find_bursts([a for a in opened if a.reason == reason and a.heliostat])
    ]
    merged = []
    for evidence, causes in groupby(
        sorted(found, key=lambda one: one.evidence), key=lambda one: one.evidence
    ):
        same = list(causes)
        merged += (
            [CommonCause([alarm for one in same for alarm in one.members], evidence)]
            if evidence
            else same
        )
    return sorted(merged, key=lambda one: -len(one.members))


def _same_clocks(
    session: Session, alarms: Sequence[Alarm], settings: Settings
) -> list[CommonCause]:
    """Contradictions of sun and time that one wrong clock explains, of whatever days."""
    of = {a.heliostat: a for a in alarms if a.reason == SUN_CONTRADICTS_TIME and a.heliostat}
    row = MeasurementRow
    query = select(HeliostatRow.name, row.warnings).join(row, row.heliostat_id == HeliostatRow.id)
    query = query.where(row.warnings.is_not(None), HeliostatRow.name.in_(list(of)[:_MOST_NAMES]))
    clocks: dict[str, dict[str, Alarm]] = {}
    for name, warnings in session.execute(query):
        for detail in _clock_details(warnings):
            clocks.setdefault(detail, {})[name] = of[name]
    found = []
    for detail, by_name in clocks.items():
        if len(by_name) >= _MIN_SAME_CLOCK:
            same = tuple(by_name.values())
            others = (one for one in _evidence(session, same, alarms, settings) if one != detail)
            found.append(CommonCause(same, (detail, *others)))
    return found


def _clock_details(warnings: Sequence[Mapping[str, str]] | None) -> list[str]:
    """What clocks explain the contradictions among warnings, in words."""
    found = (one for one in warnings or () if one["type"] == SUN_CONTRADICTS_TIME)
    return [said for one in found if (said := one["detail"].partition("; ")[2])]


def find_bursts(alarms: Sequence[Alarm]) -> list[tuple[Alarm, ...]]:
    """Find the alarms of one reason that began within a day, repeatedly the most at once."""
    bursts = []
    rest = sorted(alarms, key=lambda alarm: alarm.since)
    while len(rest) >= MIN_ALARMS:
        moments = [alarm.since for alarm in rest]
        ends = [bisect_right(moments, moment + _WINDOW) for moment in moments]
        start = max(range(len(rest)), key=lambda place: ends[place] - place)
        burst, others = rest[start : ends[start]], rest[:start] + rest[ends[start] :]
        span = rest[-1].since - rest[0].since
        usual = len(others) / max(span / _WINDOW, _LEAST_DAYS)
        if len(burst) < max(MIN_ALARMS, _LEAST_RATIO * usual):
            break
        bursts.append(tuple(burst))
        rest = others
    return bursts


# --- evidence
# --------------------------------------------------------------------------------------------------


def _evidence(
    session: Session, burst: tuple[Alarm, ...], alarms: Sequence[Alarm], settings: Settings
) -> Iterator[str]:
    """What the store knows of the time when a burst began, the most specific first."""
    reason, cause = burst[0].reason, CommonCause(burst, ())
    before = cause.first_at - _WINDOW
    for alarm in alarms:
        if reason in _CAUSED.get(alarm.reason, ()) and before <= alarm.since <= cause.last_at:
            yield f"{REASONS[alarm.reason].label.lower()}: {alarm.message}"
    if reason in _BY_MODEL:
        yield from _models(session, before, cause.last_at)
    if reason in _BY_JOB:
        yield from _jobs(session, _BY_JOB[reason], cause)
    if reason in ("accuracy", "fell"):
        yield from _photographed(session, cause)
    if reason in (*_ON_ARRIVAL, *_WHEN_TAKEN):
        yield from _photographs(session, reason, cause)
    if reason == "no_photograph":
        yield from _unphotographed(session, cause, settings)


def _models(session: Session, first: datetime, last: datetime) -> Iterator[str]:
    for row in session.scalars(select(ModelRow).order_by(ModelRow.number)):
        for at, verb in ((row.adopted_at, "became active"), (row.withdrawn_at, "was withdrawn")):
            if at is not None and first <= at <= last:
                yield f"version {row.number} of the model {verb} on {format_minute(at)}"


def _jobs(session: Session, kind: str, cause: CommonCause) -> Iterator[str]:
    ran = select(JobRow.id).where(
        JobRow.kind == kind,
        JobRow.started_at <= cause.last_at,
        JobRow.finished_at >= cause.first_at,
    )
    for number in session.scalars(ran.order_by(JobRow.id)):
        yield f"job {number} ({kind}) ran at that time"


def _photographed(session: Session, cause: CommonCause) -> Iterator[str]:
    """Whether nearly all heliostats that were photographed at that time are affected."""
    row = MeasurementRow
    query = select(func.count(row.heliostat_id.distinct())).where(
        row.accepted, row.taken_at.between(cause.first_at, cause.last_at)
    )
    count, affected = session.scalar(query) or 0, len(cause.heliostats)
    if affected >= _NEARLY_ALL * count:
        yield (
            f"{affected} of {max(count, affected)} heliostats that were photographed at that time"
            " are affected, as by haze or a camera"
        )


def _photographs(session: Session, reason: Reason, cause: CommonCause) -> Iterator[str]:
    """What the photographs of the burst have in common."""
    row = MeasurementRow
    moment = func.coalesce(row.taken_at, row.created_at)
    query = (
        select(TargetRow.name, row.sent_by, row.wind_speed_m_s, row.warnings)
        .join(TargetRow, TargetRow.id == row.target_id)
        .join(HeliostatRow, HeliostatRow.id == row.heliostat_id)
        .where(moment.between(cause.first_at, cause.last_at))
        .where(HeliostatRow.name.in_(cause.heliostats[:_MOST_NAMES]))
    )
    rows = session.execute(query).all()
    if reason == SUN_CONTRADICTS_TIME:
        clocks = {detail for *_, warnings in rows for detail in _clock_details(warnings)}
        if len(clocks) == 1:
            yield clocks.pop()
    targets = {target for target, *_ in rows}
    if len(targets) == 1 and session.scalar(select(func.count(TargetRow.id))) != 1:
        yield f"all photographs were taken on {targets.pop()}"
    senders = {sender for _, sender, *_ in rows}
    if reason in _ON_ARRIVAL and len(senders) == 1 and None not in senders:
        yield f"all photographs were sent by {senders.pop()}"
    winds = [wind for _, _, wind, _ in rows if wind is not None]
    if winds and median(winds) >= _WINDY_M_S:
        yield f"the wind was {median(winds):.0f} m/s"


def _unphotographed(session: Session, cause: CommonCause, settings: Settings) -> Iterator[str]:
    """Whether nobody photographed the field, or the heliostats were added together."""
    allowed = timedelta(days=settings.alarm_photograph_days)
    last = cause.last_at - allowed
    newest = session.scalar(
        select(func.max(MeasurementRow.taken_at)).where(MeasurementRow.accepted)
    )
    names = HeliostatRow.name.in_(cause.heliostats[:_MOST_NAMES])
    newest_added = session.scalar(select(func.max(HeliostatRow.created_at)).where(names))
    if newest is not None and newest <= last + _WINDOW / 24:
        yield f"no heliostat was photographed after {format_minute(newest)}"
    elif newest is None:
        yield "no photograph with a known time was ever accepted"
    if newest_added is not None and abs(newest_added - last) < _WINDOW:
        added = format_minute(newest_added)
        yield f"the heliostats were added at {added}, and not photographed since"
