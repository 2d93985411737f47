"""Whether the camera of a target is not what it was, by what measuring keeps of each photograph; no study is needed.

A camera that is exposed, focused or set otherwise shows spots and sheet otherwise, whatever heliostat is photographed.
Clouds, distances and spots differ from photograph to photograph, so it is medians of days that are held against each
other, by how much days differ among themselves.
"""

import threading
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from datetime import time as clock

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.base.settings import Settings
from service.store.columns import now
from service.store.tables import MeasurementRow, TargetRow

FIGURES = {
    "signal_to_background": "the spot over the sheet",
    "signal_to_noise": "the spot over the noise",
    "sheet_share": "the sheet's own pattern",
}
"""What of the quality a camera changes (`model.imaging.quality.Quality`), and what it is called."""

_WINDOW_DAYS = 90
_MOST_A_DAY = 200  # photographs of a day that are looked at, the last ones
_HOLDS_S = 6 * 3600.0  # so long the days before today are taken for what they were: few photographs are measured anew
_LEAST_SPREAD = 0.05  # no day is alike another by less than this, whatever few of them say
# 1.4826: from a median deviation to a standard one; 1.2533: a median's standard deviation over a mean's.
_OF_DEVIATION, _OF_MEDIAN = 1.4826, 1.2533

Daily = Mapping[date, NDArray[np.float64]]
"""Logarithms of `FIGURES` (3,), medians of a day."""


@dataclass(frozen=True)
class Change:
    """That from ``day`` on a figure of the photographs of a target is ``ratio`` times what it was before.

    ``certainty`` is that change over its standard deviation; ``days`` are how many days with photographs tell it,
    before and after.
    """

    target: str
    figure: str
    day: date
    ratio: float
    certainty: float
    days: tuple[int, int]


def find_change(target: str, daily: Daily, settings: Settings) -> Change | None:
    """The change that is surest, where any is as large and as sure as the settings ask, after enough days."""
    days, least = sorted(daily), settings.attention_camera_days
    values = np.array([daily[day] for day in days]).reshape(-1, len(FIGURES))
    found: list[Change] = []
    for split in range(2 * least, len(days) - least + 1):
        before, after = values[:split], values[split:]
        shift = np.median(after, axis=0) - np.median(before, axis=0)
        off = np.vstack([np.abs(part - np.median(part, axis=0)) for part in (before, after)])
        spread = np.maximum(_OF_DEVIATION * np.median(off, axis=0), _LEAST_SPREAD)
        certainty = np.abs(shift) / (_OF_MEDIAN * spread * np.sqrt(1 / len(before) + 1 / len(after)))
        for figure, by, sure in zip(FIGURES, shift.tolist(), certainty.tolist(), strict=True):
            if sure >= settings.attention_camera_certainty and abs(by) >= np.log(settings.attention_camera_ratio):
                counted = (len(before), len(after))
                found.append(Change(target, figure, days[split], float(np.exp(by)), sure, counted))
    return max(found, key=lambda change: change.certainty, default=None)


def _of_day(session: Session, day: date) -> dict[str, NDArray[np.float64]]:
    """The medians of a day by target, of what measuring kept of its last accepted photographs."""
    begin = datetime.combine(day, clock(), UTC)
    row = MeasurementRow
    query = select(TargetRow.name, row.quality).join(TargetRow, TargetRow.id == row.target_id)
    query = query.where(row.accepted, row.moment >= begin, row.moment < begin + timedelta(days=1))
    found: dict[str, list[list[float]]] = defaultdict(list)
    for name, quality in session.execute(query.order_by(row.moment.desc(), row.id.desc()).limit(_MOST_A_DAY)):
        figures = [quality.get(figure) or 0.0 for figure in FIGURES]
        if min(figures) > 0:
            found[name].append(figures)
    return {name: np.median(np.log(figures), axis=0) for name, figures in found.items()}


class CameraWatch:
    """The days of all targets, each read once in a while, today's each time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._days: dict[date, dict[str, NDArray[np.float64]]] = {}
        self._read_s = -np.inf

    def changes(self, session: Session, settings: Settings) -> list[Change]:
        """What changed, by target."""
        days = self._read(session, now().date())
        daily: dict[str, dict[date, NDArray[np.float64]]] = defaultdict(dict)
        for day, of in days.items():
            for name, medians in of.items():
                daily[name][day] = medians
        found = (find_change(name, daily[name], settings) for name in sorted(daily))
        return [change for change in found if change is not None]

    def _read(self, session: Session, today: date) -> dict[date, dict[str, NDArray[np.float64]]]:
        with self._lock:
            if time.monotonic() - self._read_s > _HOLDS_S:
                self._days, self._read_s = {}, time.monotonic()
            wanted: Sequence[date] = [today - timedelta(days=ago) for ago in range(_WINDOW_DAYS)]
            self._days = {
                day: self._days[day] if day in self._days and day < today else _of_day(session, day) for day in wanted
            }
            return self._days
