"""Detect changes of a target's camera from the quality figures of photographs.

No study is needed. Another exposure, focus or setting of the camera changes spots and sheet of all
heliostats. Clouds, distances and spots differ from photograph to photograph. Therefore medians of
days are compared, relative to how much days differ.
"""

import math
import threading
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from datetime import time as clock
from typing import NamedTuple
from weakref import WeakKeyDictionary
from zoneinfo import ZoneInfo

import numpy as np
from cachetools import TTLCache
from numpy.typing import NDArray
from pydantic import TypeAdapter
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.base.settings import Settings
from service.store.columns import now
from service.store.database import Database
from service.store.tables import MeasurementRow, TargetRow
from service.twin.forecasts.aim_sources import plant_time_zone

FIGURES = {
    "signal_to_background": "the spot over the sheet",
    "signal_to_noise": "the spot over the noise",
    "sheet_share": "the sheet's own pattern",
}
"""Quality figures that a camera changes (`model.imaging.quality.Quality`), with labels."""

_WINDOW_DAYS = 90
_WITH_SHEET = ("raw", "cropped")  # kinds of images with the sheet's light, to compare the spot's
_MAX_A_DAY = 200  # photographs of a day that are read, the last ones
_HOLDS_S = 6 * 3600.0  # time that earlier days are cached, because few photographs are re-measured
_MIN_SPREAD = 0.05  # least spread between days, even if few days happen to agree
# 1.4826 converts a median deviation to a standard deviation. 1.2533 is the standard deviation of a
# median over that of a mean.
_OF_DEVIATION, _OF_MEDIAN = 1.4826, 1.2533


class LightReading(NamedTuple):
    """Light of a photograph: the logarithm of the spot over the sheet. ``day`` is the plant's."""

    heliostat: int
    target: str
    taken_at: datetime
    day: date
    light: float


class _DayFigures(NamedTuple):
    """Medians of a day by target, and the light of its photographs."""

    medians: dict[str, NDArray[np.float64]]
    light: list[LightReading]


Daily = Mapping[date, NDArray[np.float64]]
"""Logarithms of `FIGURES` (3,), as medians of each day."""


@dataclass(frozen=True)
class CameraChange:
    """A change of a figure in a target's photographs from ``day`` on.

    ``ratio`` is the figure after the change over that before. ``certainty`` is the change over its
    standard deviation. ``days`` counts the days with photographs before and after.
    """

    target: str
    figure: str
    day: date
    ratio: float
    certainty: float
    days: tuple[int, int]


CHANGES = TypeAdapter(list[CameraChange])
"""Camera changes as JSON and back."""


def find_camera_change(target: str, daily: Daily, settings: Settings) -> CameraChange | None:
    """The most certain change beyond the limits of the settings; None without any."""
    days, least = sorted(daily), settings.alarm_camera_days
    values = np.array([daily[day] for day in days]).reshape(-1, len(FIGURES))
    found: list[CameraChange] = []
    for split in range(2 * least, len(days) - least + 1):
        before, after = values[:split], values[split:]
        shift = np.median(after, axis=0) - np.median(before, axis=0)
        off = np.vstack([np.abs(part - np.median(part, axis=0)) for part in (before, after)])
        spread = np.maximum(_OF_DEVIATION * np.median(off, axis=0), _MIN_SPREAD)
        certainty = np.abs(shift) / (
            _OF_MEDIAN * spread * np.sqrt(1 / len(before) + 1 / len(after))
        )
        for figure, by, sure in zip(FIGURES, shift.tolist(), certainty.tolist(), strict=True):
            if sure >= settings.alarm_camera_certainty and abs(by) >= np.log(
                settings.alarm_camera_ratio
            ):
                counted = (len(before), len(after))
                found.append(
                    CameraChange(target, figure, days[split], float(np.exp(by)), sure, counted)
                )
    return max(found, key=lambda change: change.certainty, default=None)


def _of_day(session: Session, day: date, zone: str) -> _DayFigures:
    """Figures of a day in a time ``zone``, over its last accepted photographs."""
    begin = datetime.combine(day, clock(), ZoneInfo(zone))
    row = MeasurementRow
    query = select(row.heliostat_id, TargetRow.name, row.taken_at, row.kind, row.quality)
    query = query.join(TargetRow, TargetRow.id == row.target_id).where(
        row.accepted, row.taken_at >= begin, row.taken_at < begin + timedelta(days=1)
    )
    found: dict[str, list[list[float]]] = defaultdict(list)
    light = []
    for heliostat, name, taken_at, kind, quality in session.execute(
        query.order_by(row.taken_at.desc(), row.id.desc()).limit(_MAX_A_DAY)
    ):
        figures = [quality.get(figure) or 0.0 for figure in FIGURES]
        if min(figures) > 0:
            found[name].append(figures)
            if kind in _WITH_SHEET:
                light.append(LightReading(heliostat, name, taken_at, day, math.log(figures[0])))
    medians = {name: np.median(np.log(figures), axis=0) for name, figures in found.items()}
    return _DayFigures(medians, light)


class CameraReadings(NamedTuple):
    """What cameras saw: changes of themselves, and the light of heliostats."""

    changes: list[CameraChange]
    light: list[LightReading]


class CameraWatch:
    """Daily figures of all targets, cached except for the current day."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._days: TTLCache[tuple[date, str], _DayFigures] = TTLCache(2 * _WINDOW_DAYS, _HOLDS_S)

    def read(self, session: Session, settings: Settings) -> CameraReadings:
        """Camera changes in the order of target names, and the light of all days, newest first."""
        zone = plant_time_zone(session, settings.time_zone)
        days = self._read(session, now().astimezone(ZoneInfo(zone)).date(), zone)
        daily: dict[str, dict[date, NDArray[np.float64]]] = defaultdict(dict)
        for day, of in days.items():
            for name, medians in of.medians.items():
                daily[name][day] = medians
        found = (find_camera_change(name, daily[name], settings) for name in sorted(daily))
        return CameraReadings(
            [change for change in found if change is not None],
            [one for day in days.values() for one in day.light],
        )

    def _read(self, session: Session, today: date, zone: str) -> dict[date, _DayFigures]:
        days = {}
        with self._lock:
            for day in (today - timedelta(days=ago) for ago in range(_WINDOW_DAYS)):
                key = (day, zone)
                known = self._days.get(key) if day < today else None
                days[day] = self._days[key] = known or _of_day(session, day, zone)
        return days


_WATCHES: WeakKeyDictionary[Database, CameraWatch] = WeakKeyDictionary()


def camera_watch(database: Database) -> CameraWatch:
    """The process's only watch of a database, so that its days are read once."""
    return _WATCHES.setdefault(database, CameraWatch())
