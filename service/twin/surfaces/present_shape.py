"""Photographs of a mirror's present shape: since when, and those that contradict the others.

A surface that was predicted from photographs since a time begins an epoch when it becomes active.
Until then a dated fall of the accuracy, or a study's canting since a day, is a candidate. Haze and
cameras change the forecasts of other heliostats, too, so they begin none. Soiling and drives change
neither shape nor centred images. Photographs whose sun contradicts their time are left out.

Causes of outliers are a neighbour's shadow, a cloud or another heliostat's light. The network
predicts a surface from some of the photographs. This surface explains most photographs about
equally well, and outliers far worse. Of 85 photographs of AA39 over two years, eight are outliers.
The measured mirror explains the same eight worst, and the network did not see it (``python -m
benchmarks.light --consensus``).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from datetime import time as clock
from statistics import fmean, median
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from pydantic import TypeAdapter
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.changes import find_changes
from model.metrics import flux_accuracy
from model.network.architecture import MAX_IMAGES
from model.observation import Observation
from model.plant import Heliostat
from model.plant_model import PlantModel
from model.times import format_minute
from service import store
from service.base.choices import Selection
from service.base.settings import Settings
from service.store.field_state import read_field_state
from service.store.listing import Period
from service.store.tables import (
    HeliostatRow,
    HeliostatStateRow,
    MeasurementRow,
    StudyRow,
    SurfaceRow,
)
from service.twin import model_versions
from service.twin.forecasts.aims import plant_time_zone
from service.twin.measurements import choose_diverse
from service.twin.runtime import Operations

MIN_OF_EPOCH = 5
"""Photographs of an epoch that confirm it, and that a prediction without a person needs."""

DROP = 0.05
"""Drop of accuracy [1] that makes photographs of a day worse than usual."""

MIN_OTHERS = 2
"""Photographs of other heliostats that a day of haze needs."""

_OF_A_DAY = 32  # photographs of others that are read of a day


@dataclass(frozen=True)
class AccuracyFall:
    """A fall of the accuracy of forecasts by one surface and one model.

    Attributes
    ----------
    since, until : datetime
        The last photograph before the interval of the change, and the first one after it.
    earlier, recent : float [1]
        Levels of the accuracy before and after it.
    min_drop : float [1]
        Lower limit of the drop (95 % interval).
    """

    since: datetime
    until: datetime
    earlier: float
    recent: float
    min_drop: float

    @property
    def when(self) -> str:
        """The times between which it fell, in words."""
        return f"between {format_minute(self.since)} and {format_minute(self.until)}"

    def of_field(self, levels: Mapping[str, float]) -> float:
        """What of it is a fall of the whole field [1], by ``levels`` of its accuracy by time."""
        dated = [(datetime.fromisoformat(at), level) for at, level in levels.items()]
        before = [level for at, level in dated if at <= self.since]
        after = [level for at, level in dated if at >= self.until]
        return max(0.0, fmean(before) - fmean(after)) if before and after else 0.0

    def exceeds(self, allowed: float, levels: Mapping[str, float]) -> bool:
        """Whether it surely exceeds the field's fall by more than ``allowed`` [1]."""
        return self.min_drop - self.of_field(levels) > allowed


FALL: TypeAdapter[AccuracyFall] = TypeAdapter(AccuracyFall)
"""A fall as JSON and back."""


def find_accuracy_fall(
    times: Sequence[datetime], accuracies: Sequence[float], least: float = 0.0
) -> AccuracyFall | None:
    """The last fall of accuracies (n,) [1] in order of time from which they have not recovered.

    It is of more than ``least`` [1], to what they are now.
    """
    changes = find_changes(times, accuracies)
    for change in reversed(changes):
        recent = changes[-1].after
        min_drop = change.min_drop - (recent - change.after)
        if min_drop > 0 and change.before - recent > least:
            return AccuracyFall(change.since, change.until, change.before, recent, min_drop)
    return None


# --- other heliostats
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DayOfOthers:
    """Photographs of other heliostats on a day: number, heliostats, median accuracy [1].

    ``usual`` [1] is that median less the median change from each heliostat's mean of other days.
    """

    photographs: int
    heliostats: int
    accuracy: float
    usual: float

    @property
    def drop(self) -> float:
        """How much worse they were forecast than usual [1]."""
        return self.usual - self.accuracy

    @property
    def is_worse(self) -> bool:
        """Whether they were forecast much worse than usual."""
        return self.drop >= DROP


def others_on(
    session: Session, heliostat: int, days: Iterable[date], zone: ZoneInfo
) -> dict[date, DayOfOthers]:
    """Compare other heliostats' accuracies on arrival of each day with their usual ones."""
    found = ((day, _others_on(session, heliostat, day, zone)) for day in days)
    return {day: of for day, of in found if of is not None}


def _others_on(session: Session, heliostat: int, day: date, zone: ZoneInfo) -> DayOfOthers | None:
    begin, end = (datetime.combine(day + timedelta(n), clock(), zone) for n in (0, 1))
    row = MeasurementRow
    is_other = (row.heliostat_id != heliostat, row.accepted, row.forecast_accuracy.is_not(None))
    is_of_day = row.taken_at.between(begin, end)
    query = select(row.heliostat_id, row.forecast_accuracy).where(*is_other, is_of_day)
    found = session.execute(query.limit(_OF_A_DAY)).all()
    if len(found) < MIN_OTHERS:
        return None
    means = select(row.heliostat_id, func.avg(row.forecast_accuracy)).group_by(row.heliostat_id)
    of = {number for number, _ in found}
    rows = session.execute(means.where(row.heliostat_id.in_(of), *is_other, ~is_of_day))
    usual = {number: mean or 0.0 for number, mean in rows}
    drops = [usual[number] - (value or 0.0) for number, value in found if number in usual]
    if not drops:
        return None
    accuracy = median(value or 0.0 for _, value in found)
    return DayOfOthers(len(found), len(of), accuracy, accuracy + median(drops))


def fell_with_others(days: Iterable[date], others: Mapping[date, DayOfOthers]) -> bool:
    """Whether others were forecast worse on at least half of the days that have photographs."""
    worse = [others[day].is_worse for day in set(days) if day in others]
    return bool(worse) and 2 * sum(worse) >= len(worse)


# --- of a heliostat
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Epoch:
    """Since when photographs show a mirror's present shape.

    Attributes
    ----------
    since : datetime
        The first photograph of it.
    said : str
        What shows it, in words.
    is_confirmed : bool
        Whether a surface from its photographs is active.
    photographs : int
        Number of its photographs.
    study : int or None
        The study that found canting since then.
    """

    since: datetime
    said: str
    is_confirmed: bool
    photographs: int
    study: int | None = None

    @property
    def missing(self) -> int:
        """Number of photographs that are missing to confirm it."""
        return 0 if self.is_confirmed else max(MIN_OF_EPOCH - self.photographs, 0)

    @property
    def needs(self) -> str:
        """How many photographs there are and how many are missing, in words."""
        count = f"{self.photographs} photograph{'' if self.photographs == 1 else 's'} since"
        return f"{count}, {self.missing} more needed" if self.missing else f"{count} show it"


def current_epoch(session: Session, heliostat: HeliostatRow, settings: Settings) -> Epoch | None:
    """The newest epoch of a mirror, a candidate or confirmed; None if it never changed."""
    active = store.find_surface_at(session, heliostat)
    begun = None if active is None else active.epoch_since
    zone = ZoneInfo(plant_time_zone(session, settings.time_zone))
    candidates = [_of_fall(session, heliostat, settings, zone), _of_study(session, heliostat, zone)]
    newest = max(
        (one for one in candidates if one is not None and (begun is None or one.since > begun)),
        key=lambda one: one.since,
        default=None,
    )
    if newest is not None or begun is None:
        return newest
    assert active is not None
    said = f"version {active.version} is active, from photographs since {format_minute(begun)}"
    return Epoch(begun, said, True, _count(session, heliostat, begun))


def waiting_epochs(session: Session, settings: Settings) -> dict[str, Epoch]:
    """Candidate epochs of heliostats that need more photographs, by name."""
    fallen = select(HeliostatStateRow.heliostat_id).where(HeliostatStateRow.fall.is_not(None))
    query = select(HeliostatRow).where(HeliostatRow.id.in_(fallen)).order_by(HeliostatRow.name)
    found = {row.name: current_epoch(session, row, settings) for row in session.scalars(query)}
    return {name: one for name, one in found.items() if one is not None and one.missing}


def _of_fall(
    session: Session, heliostat: HeliostatRow, settings: Settings, zone: ZoneInfo
) -> Epoch | None:
    fall = read_fall(session, heliostat.id, settings)
    if fall is None:
        return None
    rows = store.recent_measurements(session, heliostat, _OF_A_DAY, fall.until)
    days = {row.taken_at.astimezone(zone).date() for row in rows if row.taken_at is not None}
    if fell_with_others(days, others_on(session, heliostat.id, days, zone)):
        return None
    said = (
        f"its accuracy by one surface fell {fall.when}, from {fall.earlier:.1%} to"
        f" {fall.recent:.1%}, and that of others did not"
    )
    return Epoch(fall.until, said, False, len(rows))


def read_fall(session: Session, heliostat: int, settings: Settings) -> AccuracyFall | None:
    """The fall that a worker found, if it surely exceeds the field's by the limit of settings."""
    state, levels = session.get(HeliostatStateRow, heliostat), read_field_state(session).levels
    fall = None if state is None or state.fall is None else FALL.validate_python(state.fall)
    if fall is None or not fall.exceeds(settings.alarm_accuracy_drop, levels or {}):
        return None
    return fall


def _of_study(session: Session, heliostat: HeliostatRow, zone: ZoneInfo) -> Epoch | None:
    """Canting of this heliostat since a day, by the newest study if it is not adopted."""
    query = select(StudyRow.id, StudyRow.report["effects"]).order_by(StudyRow.id.desc()).limit(1)
    study = session.execute(query).one_or_none()
    if study is None or model_versions.find_adopted(session, study[0]) is not None:
        return None
    day = _canting_since(study[1] or (), heliostat.name)
    if day is None:
        return None
    since = datetime.combine(day, clock(), zone)
    said = f"study {study[0]} found its facets canted since {day:%Y-%m-%d}"
    return Epoch(since, said, False, _count(session, heliostat, since), study[0])


def _canting_since(effects: Iterable[Mapping[str, Any]], heliostat: str) -> date | None:
    """The day since when a study's canting acts on a heliostat, if it still does."""
    for effect in effects:
        scope = effect.get("scope") or {}
        is_of = heliostat in (scope.get("heliostats") or ())
        if effect["name"] == "facet_canting" and is_of and scope.get("kind") == "since":
            return None if scope.get("until") else date.fromisoformat(scope["since"])
    return None


def _count(session: Session, heliostat: HeliostatRow, since: datetime) -> int:
    return len(store.recent_measurements(session, heliostat, 2 * MIN_OF_EPOCH, since))


def epoch_of(
    session: Session, heliostat: HeliostatRow, surface: SurfaceRow | store.NewSurface | None
) -> Period:
    """The epoch of a surface version or new surface, which ends where the next one begins."""
    since = None if surface is None else surface.epoch_since
    return Period(since, store.next_epoch(session, heliostat, since))


# --- photographs that contradict the others
# --------------------------------------------------------------------------------------------------


# Fewer photographs cannot outvote a wrong one.
_FEWEST = 6
_DEVIATIONS = 3.0
# Least excess of an outlier's misfit [flux accuracy], because clean images almost agree.
_LEAST = 0.05


def reject_outliers(
    operations: Operations,
    heliostat: Heliostat,
    observations: Sequence[Observation],
    model: PlantModel,
) -> Selection[Observation]:
    """Remove outliers from observations; the others are in order of time, unknown times first.

    Of mirrors without a network none is removed: their refinement excludes images itself.
    """
    observations = sorted(observations, key=_time)
    if len(observations) < _FEWEST or not operations.has_network(heliostat):
        return Selection(observations, {})
    glance = operations.predict(heliostat, choose_diverse(observations, MAX_IMAGES), model)
    images = operations.render(heliostat, observations, glance.z, model).clip(min=0)
    misfits = [
        1 - flux_accuracy(o.flux, image) for o, image in zip(observations, images, strict=True)
    ]
    undated = sum(o.taken_at is None for o in observations)
    apart, usual = list_outliers(misfits, undated), float(np.median(misfits))
    reasons = {
        observations[row].identifier: (
            f"contradicts the others: it differs by {misfits[row]:.2f} from what they show"
            f" together, they by {usual:.2f}; a shadow, a cloud or another heliostat's light may"
            " lie on it"
        )
        for row in apart
    }
    return Selection([o for row, o in enumerate(observations) if row not in apart], reasons)


def _time(observation: Observation) -> float:
    taken = observation.taken_at
    return -np.inf if taken is None else taken.timestamp()


def list_outliers(misfits: Sequence[float], undated: int = 0) -> list[int]:
    """Indices of misfits that exceed the median by three robust deviations (median, MAD).

    The misfits are in order of time. If all of the last ones are outliers, they are not listed,
    because the mirror may have changed. The first ``undated`` have no order in time and never count
    as the last.
    """
    values = np.asarray(misfits)
    above = values - np.median(values)
    apart = above > max(_LEAST, _DEVIATIONS * 1.4826 * float(np.median(np.abs(above))))
    settled = max(np.flatnonzero(~apart)[-1] + 1, undated)
    return [int(row) for row in np.flatnonzero(apart[:settled])]
