"""When the forecasts of the whole field became worse.

Haze, a camera and a target change the forecasts of all heliostats at once, and each by less than
its alarm needs. A day's median over the field is far surer than one heliostat's series.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import date, datetime
from statistics import median

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store.field_state import read_field_state
from service.store.tables import HeliostatStateRow, surface_measurements
from service.twin.alarms.field_overview import HeliostatOverview
from service.twin.studies.field_change import SampledPhotograph, sample_photographs
from service.twin.surfaces.present_shape import AccuracyFall, find_accuracy_fall

_A_DAY = 30  # photographs of a day that count at most
_FEWEST = 3  # photographs of a day, and heliostats
_MOST_PENDING = 0.2  # share of heliostats whose accuracies are being computed

LEAST = 0.005
"""Least fall of the field's accuracy [1] that counts."""


def are_known(lines: Sequence[HeliostatOverview]) -> bool:
    """Whether nearly all accuracies of the field are computed, by one model."""
    pending = ["accuracy" in one.pending for one in lines if one.surface is not None]
    return sum(pending) <= _MOST_PENDING * len(pending)


def read_levels(session: Session, lines: Sequence[HeliostatOverview]) -> dict[str, float]:
    """Levels of the field's accuracy [1] by day, each relative to the heliostats' medians.

    The keys are the times of the days' last photographs. While too few accuracies are known, they
    are those that were written last.
    """
    if not are_known(lines):
        return dict(read_field_state(session).levels or {})
    return levels_of(
        sample_photographs(session, a_day=_A_DAY), _relative_accuracies(session, lines)
    )


def find_field_fall(levels: Mapping[str, float]) -> AccuracyFall | None:
    """The last fall of the field's accuracy by more than `LEAST` from which it has not recovered.

    A study may correct one change and leave another: small falls, one after the other, count
    together.
    """
    dated = sorted((datetime.fromisoformat(at), level) for at, level in levels.items())
    times, values = [at for at, _ in dated], [level for _, level in dated]
    return find_accuracy_fall(times, values, LEAST)


def _relative_accuracies(session: Session, lines: Sequence[HeliostatOverview]) -> dict[int, float]:
    """Accuracies of photographs less the median of their heliostats [1], by row id.

    Photographs that surfaces were computed from do not count.
    """
    active = {
        one.id: one.surface.id for one in lines if one.surface and "accuracy" not in one.pending
    }
    of, state = surface_measurements.c, HeliostatStateRow
    used = set(session.scalars(select(of.measurement_id).where(of.surface_id.in_(active.values()))))
    found = dict[int, float]()
    query = select(state.accuracies).where(state.heliostat_id.in_(active))
    for accuracies in session.scalars(query):
        unseen = {int(k): v for k, v in (accuracies or {}).items() if int(k) not in used}
        usual = median(unseen.values()) if unseen else 0.0
        found |= {number: value - usual for number, value in unseen.items()}
    return found


def levels_of(
    photographs: Sequence[SampledPhotograph], relative: Mapping[int, float]
) -> dict[str, float]:
    """The days' medians of ``relative`` accuracies [1], which are by row id of photographs."""
    days = defaultdict[date, list[SampledPhotograph]](list)
    for one in photographs:
        if one.id in relative:
            days[one.taken_at.date()].append(one)
    return {
        max(one.taken_at for one in taken).isoformat(): median(relative[one.id] for one in taken)
        for _, taken in sorted(days.items())
        if len({one.heliostat for one in taken}) >= _FEWEST
    }
