"""Cameras, by what photographs show: changes of a target's camera, and the camera of flux images.

Changes are detected from the quality figures of photographs, and no study is needed. Another
exposure, focus or setting of the camera changes spots and sheet of all heliostats. Clouds,
distances and spots differ from photograph to photograph. Therefore medians of days are compared,
relative to how much days differ. Images without background are compared with forecasts by either
camera.
"""

import math
import threading
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from datetime import time as clock
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary
from zoneinfo import ZoneInfo

import numpy as np
from cachetools import TTLCache
from numpy.typing import NDArray
from pydantic import TypeAdapter
from sqlalchemy import Row, func, select
from sqlalchemy.orm import Session

from model.camera_choice import CameraChoice, PhotographedMirror, choose_camera
from model.frames import sun_direction
from model.plant_model import PlantModel
from service import store
from service.base.settings import Settings
from service.store.columns import now
from service.store.database import Database
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow, MeasurementRow, SurfaceRow, TargetRow
from service.twin.forecasts.aims import plant_time_zone
from service.twin.measurements import (
    Array,
    HeliostatContext,
    accepted_measurement,
    choose_diverse,
    heights_of,
    load_heliostat_context,
    to_observations,
)
from service.twin.model_versions import current_version, declares_camera
from service.twin.runtime import Runtime

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
    """Light of a photograph: the logarithm of the spot over the sheet and the cosine of incidence.

    ``day`` is the plant's.
    """

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
    row, mirror = MeasurementRow, HeliostatRow
    query = (
        select(row.heliostat_id, row.taken_at, row.kind, row.quality)
        .add_columns(row.sun_azimuth_deg, row.sun_elevation_deg, TargetRow.name, TargetRow.geometry)
        .add_columns(mirror.east_m, mirror.north_m, mirror.up_m)
        .join(TargetRow, TargetRow.id == row.target_id)
        .join(mirror, mirror.id == row.heliostat_id)
        .where(row.accepted, row.taken_at >= begin, row.taken_at < begin + timedelta(days=1))
        .order_by(row.taken_at.desc(), row.id.desc())
        .limit(_MAX_A_DAY)
    )
    found: dict[str, list[list[float]]] = defaultdict(list)
    light = []
    for one in session.execute(query):
        figures = [one.quality.get(figure) or 0.0 for figure in FIGURES]
        if min(figures) > 0:
            found[one.name].append(figures)
            if one.kind in _WITH_SHEET:
                value = math.log(figures[0] / _cosine(one))
                light.append(LightReading(one.heliostat_id, one.name, one.taken_at, day, value))
    medians = {name: np.median(np.log(figures), axis=0) for name, figures in found.items()}
    return _DayFigures(medians, light)


def _cosine(row: Row[Any]) -> float:
    """Cosine of incidence on a photograph's mirror, by its place, its target and the sun."""
    to_target = np.subtract(row.geometry["center"], (row.east_m, row.north_m, row.up_m))
    sun = sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg)
    return float(np.sqrt((1 + sun @ to_target / np.linalg.norm(to_target)) / 2))


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


KINDS = ("flux", "flux-centered")
"""Kinds of image whose background was subtracted: photographs are sRGB without a declaration."""

# Most images of a mirror and most mirrors that judge: more change little, and take long.
_IMAGES, _MIRRORS = 8, 12

# Newest photographs of a stored heliostat among which different suns are chosen.
_NEWEST = 4 * _IMAGES


class StoredMirror(NamedTuple):
    """A heliostat, its accepted images of `KINDS`, and measured heights (F, 8, 8) [m] or None."""

    twin: HeliostatContext
    rows: Sequence[MeasurementRow]
    z: Array | None


def find_camera(
    runtime: Runtime, model: PlantModel, mirrors: Iterable[StoredMirror]
) -> CameraChoice | None:
    """Choose the camera of images that were measured as linear light; None if nothing judges them.

    Mirrors with a measured surface come first, then those with the most images. Of others only
    those with a network are predicted.
    """
    with runtime.computing("choose_camera") as operations:
        known = [
            one
            for one in mirrors
            if one.z is not None or operations.has_network(one.twin.heliostat)
        ]
        known.sort(key=lambda one: (one.z is None, -len(one.rows), one.twin.row.name))
        return choose_camera(list(map(_photographed, known[:_MIRRORS])), model, operations.predict)


def find_camera_choice(session: Session) -> JobRow | None:
    """The newest finished job `camera-choices` of the current model, if it declares no camera.

    An effect that was adopted since may explain the images, such as a curve of the camera.
    """
    query = select(JobRow).where(JobRow.kind == "camera-choices", JobRow.state == "done")
    newest = session.scalar(query.order_by(JobRow.id.desc()).limit(1))
    if newest is None or newest.result is None or declares_camera(session):
        return None
    is_current = newest.result.get("model_version") == current_version(session)
    return newest if is_current else None


def _photographed(mirror: StoredMirror) -> PhotographedMirror:
    twin = mirror.twin
    evidence = [accepted_measurement(row, twin.origin) for row in mirror.rows]
    chosen = choose_diverse(to_observations(evidence, twin.heliostat), _IMAGES)
    return PhotographedMirror(twin.heliostat, chosen, mirror.z)


_IS_JUDGED = (MeasurementRow.accepted, MeasurementRow.kind.in_(KINDS))


def count_images(session: Session) -> int:
    """Number of accepted images of `KINDS` in a store."""
    return session.scalars(select(func.count(MeasurementRow.id)).where(*_IS_JUDGED)).one()


def read_mirrors(session: Session) -> list[StoredMirror]:
    """Stored heliostats with the most images of `KINDS`, those with a measured surface first."""
    row, measured = MeasurementRow, func.max(SurfaceRow.version)
    is_measured = (SurfaceRow.heliostat_id == HeliostatRow.id) & (SurfaceRow.source == "measured")
    query = (
        select(HeliostatRow, measured)
        .join(row, row.heliostat_id == HeliostatRow.id)
        .outerjoin(SurfaceRow, is_measured)
        .where(*_IS_JUDGED)
        .group_by(HeliostatRow.id)
        .order_by(measured.is_(None), func.count(row.id.distinct()).desc(), HeliostatRow.name)
    )
    mirrors = []
    for heliostat, version in session.execute(query.limit(_MIRRORS)).all():
        recent = store.recent_measurements(session, heliostat, _NEWEST)
        names = [one.identifier for one in recent if one.kind in KINDS]
        rows = store.get_measurements(session, heliostat, names, arrays=True)
        surface = None if version is None else store.get_surface(session, heliostat, version)
        twin = load_heliostat_context(session, heliostat.name)
        mirrors += [StoredMirror(twin, rows, heights_of(surface))] if rows else []
    return mirrors
