"""Probable common causes of alarms that began together.

Alarms of one reason that began within a day, and more often than usual, are a burst. What the store
knows of that time is evidence of its cause. Bursts with the same evidence have one cause.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from itertools import groupby
from statistics import median
from typing import Annotated

import numpy as np
from pydantic import Field, computed_field
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.times import format_minute
from service.base.settings import Settings
from service.store.acknowledgements import Key
from service.store.job_tables import JobRow
from service.store.measurements import EXCLUDED
from service.store.tables import (
    SUN_CONTRADICTS_TIME,
    HeliostatRow,
    HeliostatStateRow,
    MeasurementRow,
    ModelRow,
    TargetRow,
)
from service.twin import model_versions
from service.twin.alarms import offers
from service.twin.alarms.acknowledging import AlarmsTogether
from service.twin.alarms.alarms import Alarm, AlarmId
from service.twin.alarms.offers import Offer
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
    "fell": ("accuracy", "fell"),
}
"""Reasons of the plant, with the reasons of heliostats that may follow from them."""

_BY_MODEL: tuple[Reason, ...] = ("accuracy", "fell", "pointing", "untrusted")
_BY_JOB: dict[Reason, str] = {
    "untrusted": "predictions",
    "unlike_heliostat": "imports",
    "sun_contradicts_time": "imports",
    "times_unknown": "imports",
}
_AS_BY: dict[Reason, str] = {
    "accuracy": "haze or a camera",
    "fell": "haze or a camera",
    "moved": "a target that moved, or a clock",
    "pointing": "a target that moved, or a clock",
}
"""What affects nearly all heliostats, by the reason of their alarms."""
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
    offer: Annotated[
        Offer | None, Field(description="What to do about all of them; null: see each heliostat.")
    ] = None

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
    begins = _begins(session, opened)
    found = clocks + [
        CommonCause(burst, tuple(_evidence(session, burst, opened, settings)))
        for reason in REASONS
        for burst in find_bursts([a for a in opened if a.reason == reason and a.heliostat], begins)
    ]
    merged = []
    for evidence, causes in groupby(
        sorted(found, key=lambda one: one.evidence), key=lambda one: one.evidence
    ):
        same = list(causes)
        if evidence:
            members = [alarm for one in same for alarm in one.members]
            same = [CommonCause(members, evidence, next((o for c in same if (o := c.offer)), None))]
        merged += [one if one.offer else replace(one, offer=_offer(session, one)) for one in same]
    return sorted(merged, key=lambda one: -len(one.members))


def _begins(session: Session, alarms: Sequence[Alarm]) -> dict[Key, datetime]:
    """When changes behind alarms began at the earliest: after the last photograph before each."""
    state = HeliostatStateRow
    query = select(HeliostatRow.name, state.fall, state.pointing)
    query = query.join(state, state.heliostat_id == HeliostatRow.id)
    names = {one.heliostat for one in alarms if one.reason in ("fell", "moved") and one.heliostat}
    found = dict[tuple[str, str], object]()
    for name, fall, pointing in session.execute(query.where(HeliostatRow.name.in_(names))):
        for reason, change in (("fell", fall), ("moved", (pointing or {}).get("moved"))):
            if isinstance(change, dict):
                found[name, reason] = change["since"]
    return {
        one.key: datetime.fromisoformat(str(begin))
        for one in alarms
        if (begin := found.get((one.heliostat or "", one.reason)))
    }


def _offer(session: Session, cause: CommonCause) -> Offer | None:
    """One request for all alarms of a cause; a study if none does what is to be done."""
    reasons = set(cause.alarms)
    if reasons <= {"moved", "pointing"}:
        names = {one.heliostat for one in cause.members if one.heliostat and one.offer}
        return offers.calibrate(sorted(names)) if names else None
    if reasons & {"accuracy", "fell"} and not offers.has_seen(
        model_versions.list_studied(session), cause.last_at
    ):
        return offers.study(cause.heliostats, cause.first_at)
    return None


def _same_clocks(
    session: Session, alarms: Sequence[Alarm], settings: Settings
) -> list[CommonCause]:
    """Contradictions of sun and time that one wrong clock explains, of whatever days."""
    of = {a.heliostat: a for a in alarms if a.reason == SUN_CONTRADICTS_TIME and a.heliostat}
    row = MeasurementRow
    photograph = func.coalesce(row.external_id, row.identifier)
    query = select(HeliostatRow.name, photograph, row.identifier, row.taken_at, row.warnings)
    query = query.join(row, row.heliostat_id == HeliostatRow.id)
    is_used = func.coalesce(row.reason, "") != EXCLUDED
    names = HeliostatRow.name.in_(list(of)[:_MOST_NAMES])
    clocks = defaultdict[float, dict[tuple[str, str], tuple[str, str, datetime]]](dict)
    details = dict[float, str]()
    for name, key, number, at, warnings in session.execute(
        query.where(row.warnings.is_not(None), is_used, names).order_by(row.id)
    ):
        for one in warnings or ():
            if at is not None and (ahead := one.get("clock_ahead_h")):
                clocks[ahead][name, key] = (name, number, at)
                details[ahead] = next(iter(_clock_details([one])))
    found = []
    for ahead, taken in clocks.items():
        same = tuple({name: of[name] for name, _ in taken}.values())
        if len(same) >= _MIN_SAME_CLOCK:
            detail = details[ahead]
            others = (one for one in _evidence(session, same, alarms, settings) if one != detail)
            offer = offers.correct_times(list(taken.values()), ahead)
            found.append(CommonCause(same, (detail, *others), offer))
    return found


def _clock_details(warnings: Sequence[Mapping[str, str]] | None) -> list[str]:
    """What clocks explain the contradictions among warnings, in words."""
    found = (one for one in warnings or () if one["type"] == SUN_CONTRADICTS_TIME)
    return [said for one in found if (said := one["detail"].partition("; ")[2])]


def find_bursts(
    alarms: Sequence[Alarm], begins: Mapping[Key, datetime] | None = None
) -> list[tuple[Alarm, ...]]:
    """Find the alarms of one reason that one event explains, repeatedly the most at once.

    An alarm's change was between ``begins``, by default its ``since``, and a day after that.
    """
    bursts, begins = [], begins or {}
    rest = sorted(alarms, key=lambda alarm: alarm.since)
    while len(rest) >= MIN_ALARMS:
        first = np.array([begins.get(one.key, one.since).timestamp() for one in rest])
        last = np.array([(one.since + _WINDOW).timestamp() for one in rest])
        moments = np.sort(first)  # most intervals overlap where one of them begins
        begun = np.searchsorted(moments, moments, "right")
        moment = moments[np.argmax(begun - np.searchsorted(np.sort(last), moments))]
        is_of = (first <= moment) & (moment <= last)
        burst = [one for one, is_in in zip(rest, is_of, strict=True) if is_in]
        others = [one for one, is_in in zip(rest, is_of, strict=True) if not is_in]
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
        if (
            alarm.heliostat is None
            and reason in _CAUSED.get(alarm.reason, ())
            and before <= alarm.since <= cause.last_at
        ):
            yield f"{REASONS[alarm.reason].label.lower()}: {alarm.message}"
    if reason in _BY_MODEL:
        yield from _models(session, before, cause.last_at)
    if reason in _BY_JOB:
        yield from _jobs(session, _BY_JOB[reason], cause)
    if reason in _AS_BY:
        yield from _photographed(session, cause, _AS_BY[reason])
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


def _photographed(session: Session, cause: CommonCause, said: str) -> Iterator[str]:
    """Whether nearly all heliostats that were photographed at that time are affected."""
    row = MeasurementRow
    query = select(func.count(row.heliostat_id.distinct())).where(
        row.accepted, row.taken_at.between(cause.first_at, cause.last_at)
    )
    count, affected = session.scalar(query) or 0, len(cause.heliostats)
    if affected >= _NEARLY_ALL * count:
        yield (
            f"{affected} of {max(count, affected)} heliostats that were photographed at that time"
            f" are affected, as by {said}"
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
