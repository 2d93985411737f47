"""Measure the states of mirrors in operation by photographs: lost light, and pointing errors.

A heliostat may send less light than before, compared with the others on the same days. The light of
a photograph per cosine of incidence depends on the heliostat, on the day (haze, exposure) and on
what changed on the mirror. Medians of heliostats and of days are removed in turn (Tukey 1977,
*Exploratory Data Analysis*, chapter 11), so that a change of one heliostat is left.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from model.changes import find_changes
from model.times import format_minute
from service import store
from service.twin.alarms.field_overview import HeliostatOverview, read_summaries, with_pointing
from service.twin.forecasts.mirror_states import (
    AS_DECLARED,
    CLEANLINESS_RANGE,
    MRAD_RANGE,
    Estimate,
    MirrorStates,
)
from service.twin.forecasts.requests import ForecastIn
from service.twin.pointing_errors import PointingState
from service.twin.runtime import Runtime
from service.twin.studies.cameras import CameraWatch, LightReading, camera_watch

Array = NDArray[np.float64]

_ROUNDS = 3  # of medians of heliostats and of days
_MIN_HELIOSTATS = 3  # of which one can be compared with the others


@dataclass(frozen=True)
class LostLight:
    """Light that a heliostat lost, compared with the others.

    Attributes
    ----------
    heliostat : int
        Its row id.
    target : str
    before, since : datetime
        The last photograph before the interval of the change, and the first one after it.
    share, min_share, max_share : float [1]
        Lost share of the light, and the ends of its 95 % interval.
    photographs : int
        With less light.
    """

    heliostat: int
    target: str
    before: datetime
    since: datetime
    share: float
    min_share: float
    max_share: float
    photographs: int

    @property
    def when(self) -> str:
        """The times between which it lost light, in words."""
        return f"a time between {format_minute(self.before)} and {format_minute(self.since)}"


def find_lost_light(readings: Iterable[LightReading], allowed: float) -> list[LostLight]:
    """Heliostats whose newest photographs surely lost more than the ``allowed`` share of light."""
    by_target: dict[str, list[LightReading]] = defaultdict(list)
    for reading in readings:
        by_target[reading.target].append(reading)
    limit, found = -math.log1p(-allowed), []
    for some in by_target.values():
        of_heliostat: dict[int, list[tuple[datetime, float]]] = defaultdict(list)
        for reading, left in zip(some, _without_days(some).tolist(), strict=True):
            of_heliostat[reading.heliostat].append((reading.taken_at, left))
        if len(of_heliostat) < _MIN_HELIOSTATS:
            continue
        for heliostat, dated in of_heliostat.items():
            lost = _lost(heliostat, some[0].target, sorted(dated), limit)
            if lost is not None:
                found.append(lost)
    return found


def _without_days(readings: list[LightReading]) -> Array:
    """Light (N,) of a target's photographs, without the typical light of each day."""
    light = np.array([one.light for one in readings])
    left = light.copy()
    day_part = np.zeros_like(light)
    for _ in range(_ROUNDS):
        left -= _medians(readings, left, lambda one: one.heliostat)
        part = _medians(readings, left, lambda one: one.day)
        left -= part
        day_part += part
    return np.asarray(light - day_part)


def _medians(
    readings: list[LightReading], values: Array, key: Callable[[LightReading], Hashable]
) -> Array:
    """For each of N readings the median of the ``values`` (N,) with the same key."""
    places: dict[Hashable, list[int]] = defaultdict(list)
    for place, reading in enumerate(readings):
        places[key(reading)].append(place)
    medians = np.empty_like(values)
    for some in places.values():
        medians[some] = np.median(values[some])
    return medians


def _lost(
    heliostat: int, target: str, dated: list[tuple[datetime, float]], limit: float
) -> LostLight | None:
    """The light that was lost, by times and light in order of time; None if less than allowed."""
    values = np.array([value for _, value in dated])
    if all(_lost_at_most(values, count) <= limit for count in (2, 5)):
        return None  # most end here, without a search
    changes = find_changes([at for at, _ in dated], values.tolist())
    if not changes or changes[-1].min_drop <= limit:
        return None
    change = changes[-1]
    drops = (change.before - change.after, change.min_drop, change.max_drop)
    share, least, most = (-math.expm1(-drop) for drop in drops)
    count = len(dated) - change.first
    return LostLight(heliostat, target, change.since, change.until, share, least, most, count)


def _lost_at_most(values: Array, count: int) -> float:
    """Median of the earlier light minus that of the newest photographs."""
    return (
        float(np.median(values[:-count]) - np.median(values[-count:]))
        if len(values) > count
        else 0.0
    )


# Lost share of the light above which a mirror counts as dimmed. Less is not distinct from haze.
_MIN_LOSS = 0.05
# Median of a Rayleigh distribution, in standard deviations per axis.
_MEDIAN = math.sqrt(2 * math.log(2))


def read_mirror_states(runtime: Runtime, names: Sequence[str]) -> MirrorStates:
    """Measure the present states of heliostats; no session should be open."""
    settings, wanted, watch = runtime.settings, set(names), CameraWatch()
    with runtime.database.reading() as session:
        only = None
        if len(names) == 1:  # at each forecast of a heliostat: earlier days are cached
            only = store.get_heliostat(session, names[0]).id
            watch = camera_watch(runtime.database)
        lines = [line for line in read_summaries(session, only) if line.name in wanted]
        light = watch.read(session, settings).light
    lines = [with_pointing(runtime, line) for line in lines]
    return measure_states(lines, light, settings.default_pointing_error_mrad)


def read_requested_states(runtime: Runtime, request: ForecastIn) -> MirrorStates:
    """The states in which a request asks for its mirror: measured, or as declared."""
    is_measured = request.measured_states and request.surface != "ideal"
    return read_mirror_states(runtime, [request.heliostat]) if is_measured else AS_DECLARED


def measure_states(
    lines: Sequence[HeliostatOverview], light: Sequence[LightReading], default_mrad: float = 0.0
) -> MirrorStates:
    """Measure the states of heliostats by their pointing and the light of all photographs."""
    lost = sorted(find_lost_light(light, _MIN_LOSS), key=lambda one: one.photographs)
    name_of = {line.id: line.name for line in lines}
    cleanliness = {
        name_of[one.heliostat]: Estimate(
            _left(one.share), (_left(one.max_share), _left(one.min_share))
        )
        for one in lost
        if one.heliostat in name_of
    }
    errors = {line.name: predicted_pointing_error(line.pointing) for line in lines}
    pointing = {name: error for name, error in errors.items() if error is not None}
    return MirrorStates(cleanliness, pointing, default_mrad)


def _left(share: float) -> float:
    """What a lost share of the light leaves."""
    return float(np.clip(1 - share, *CLEANLINESS_RANGE))


def predicted_pointing_error(state: PointingState | None) -> Estimate | None:
    """Standard deviation per axis [mrad] of a heliostat's beam by photographs.

    None if its mount was not calibrated, or too few photographs say how well it predicts spots.
    Angles of two axes have a Rayleigh distribution.
    """
    if state is None or state.error_mrad is None:
        return None
    sigma, freedom = state.error_mrad / _MEDIAN, 2 * state.photographs
    ends = (sigma * math.sqrt(freedom / chi2.ppf(p, freedom)) for p in (0.975, 0.025))
    value, low, high = (min(one, MRAD_RANGE[1]) for one in (sigma, *ends))
    return Estimate(value, (low, high))
