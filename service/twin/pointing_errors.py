"""Pointing errors of heliostats: their size, their trend, and moves.

Photographs of the calibration are forecast by those of other days: the fit's residuals are far
smaller than errors of forecasts. Later photographs are compared with the mount that is valid now.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session, undefer

from model.changes import find_changes
from model.errors import ModelError
from model.pointing import Reading, pointing_error
from model.pointing.prediction import MIN_MEASUREMENTS
from model.pointing.report import moment_of
from model.pointing.spots import spot_covariance
from model.times import format_minute
from service import store
from service.base.errors import ServiceError
from service.store import mounts
from service.store.tables import UNLIKE_HELIOSTAT, HeliostatRow, MountRow
from service.twin.photographs.readings import load_readings
from service.twin.runtime import Runtime
from service.twin.stored_mount import StoredMount, stored_mount
from service.twin.surfaces.accuracy import result_key

Array = NDArray[np.float64]

logger = logging.getLogger("heliotwin.service")

NEWEST = 8
"""Largest number of photographs in the median that is the pointing error."""

# Photographs since the calibration that a trend needs: three in each third.
_MIN_OF_TREND = 9

# A photograph that is off by more standard deviations is foreign, or the heliostat has moved.
_FAR = 5.0

# Standard deviation of the logarithm of an angle: pi / sqrt(24) for a Rayleigh distribution.
_LOG_RAYLEIGH = 0.64

# Photographs since the calibration that are read, the newest.
_MAX_READ = 256


@dataclass(frozen=True)
class DriveStep:
    """A move of a heliostat between two photographs.

    If ``is_calibrated``, ``size_mrad`` is the step of the drives' zeros that the calibration found.
    Otherwise it is the pointing error since the move. Only photographs of known time show a move.
    """

    since: datetime
    until: datetime
    size_mrad: float
    is_calibrated: bool

    @property
    def when(self) -> str:
        """The times between which it moved, in words."""
        return f"between {format_minute(self.since)} and {format_minute(self.until)}"


@dataclass(frozen=True)
class PointingDrift:
    """Slow drift of the drives' zeros over the calibration photographs [mrad]."""

    since: datetime
    until: datetime
    size_mrad: float


@dataclass(frozen=True)
class PointingState:
    """Pointing of a calibrated mount according to photographs.

    Attributes
    ----------
    mount_version : int
        Version of the mount.
    calibrated_at : datetime
    error_mrad : float or None [mrad]
        Median angle at the mirror between forecast and measured spots, over the newest photographs
        since the last move. Those of the calibration are forecast by others. None below
        `MIN_MEASUREMENTS` photographs, or if too many contradict the mount.
    interval_mrad : pair of float or None [mrad]
        Interval of 90 % of such angles.
    photographs, since_calibration : int
        Number of photographs in this median, and number of all photographs since the calibration.
    trend_mrad : float or None [mrad]
        Median of the newest third of the photographs since the calibration, minus that of the third
        before.
    beyond_since : datetime or None
        When the error began to exceed the limit of the settings.
    moved : DriveStep or None
        The last move.
    drifted : PointingDrift or None
        Only if the drift is certain.
    """

    mount_version: int
    calibrated_at: datetime
    error_mrad: float | None
    photographs: int
    since_calibration: int
    trend_mrad: float | None = None
    beyond_since: datetime | None = None
    moved: DriveStep | None = None
    drifted: PointingDrift | None = None
    interval_mrad: tuple[float, float] | None = None


def pointing_state(
    stored: StoredMount, kept: MountRow, newer: Sequence[Reading], limit_mrad: float
) -> PointingState:
    """Pointing from a stored mount and later photographs, in order of time.

    ``kept`` is loaded with its document. Calibration photographs of unknown time do not count,
    because they may not be among the newest.
    """
    mount = stored.mount
    is_known = np.isfinite(mount.predicted) & np.isfinite(mount.days)
    days, off = mount.days[is_known], 1e3 * mount.predicted[is_known]
    moved, begin = None, -np.inf
    if mount.steps:
        step = mount.steps[-1]
        begin, size = mount.days[step.after], 1e3 * float(np.linalg.norm(step.zeros))
        moved = DriveStep(moment_of(mount.days[step.before]), moment_of(begin), size, True)
    trend, known = None, days >= begin
    days, off = days[known], off[known]
    if newer:
        apart, far = _forecast_errors(stored, newer)
        calibrated, trend = len(days), _trend(apart)
        days, off = np.concatenate([days, [one.day for one in newer]]), np.append(off, apart)
        logs = np.log(np.maximum(off, 1e-3)).tolist()
        changes = find_changes([moment_of(day) for day in days], logs, _LOG_RAYLEIGH)
        newest = changes[-1].first if changes else 0
        if changes and np.median(far[max(newest - calibrated, 0) :]) == 0:
            is_own = np.append(np.ones(calibrated, dtype=bool), ~far)  # the spots came back
            days, off, changes = days[is_own], off[is_own], []
        for change in changes:
            if change.first >= calibrated and change.max_drop < 0:
                size = float(np.median(off[change.first :]))
                moved = DriveStep(change.since, change.until, size, False)
                days, off = days[change.first :], off[change.first :]
                break
    is_enough = off.size >= MIN_MEASUREMENTS and (newer or mount.prediction is not None)
    error = float(np.median(off[-NEWEST:])) if is_enough else None
    interval, predicted = None, mount.prediction
    if predicted is not None and error is not None:  # in proportion to the newest errors
        scale = error / predicted.median
        interval = (scale * predicted.low, scale * predicted.high)
    return PointingState(
        mount_version=kept.version,
        calibrated_at=kept.created_at,
        error_mrad=error,
        photographs=min(off.size, NEWEST),
        since_calibration=len(newer),
        trend_mrad=trend,
        beyond_since=None if error is None else _beyond_since(days, off, limit_mrad),
        moved=moved,
        drifted=_drifted(kept),
        interval_mrad=interval,
    )


def _forecast_errors(
    stored: StoredMount, newer: Sequence[Reading]
) -> tuple[Array, NDArray[np.bool_]]:
    """Angles (N,) [mrad] between forecast and measured spots, and which ones are outliers.

    An outlier is not explained by the mount's covariance.
    """
    off = pointing_error(stored.heliostat, stored.mount, newer)
    motors, suns, spots = (
        np.array([getattr(one, name) for one in newer]) for name in ("motors", "sun", "spot")
    )
    days = np.array([one.day for one in newer])
    covariance = spot_covariance(stored.mount, stored.heliostat, motors, suns, spots, days)
    std = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    return 1e3 * off, np.asarray(off > _FAR * std)


def _trend(off: Array) -> float | None:
    if len(off) < _MIN_OF_TREND:
        return None
    third = len(off) // 3
    return float(np.median(off[-third:]) - np.median(off[-2 * third : -third]))


def _beyond_since(days: Array, off: Array, limit: float) -> datetime | None:
    """When the median of the newest errors began to exceed ``limit``; None if below."""
    begun = None
    for count in range(len(off), 0, -1):
        if np.median(off[max(0, count - NEWEST) : count]) <= limit:
            break
        begun = moment_of(days[count - 1])
    return begun


def _drifted(mount: MountRow) -> PointingDrift | None:
    drift, at = mount.document["drift"], mount.document["history"]["at"]
    if not drift["is_sure"]:
        return None
    size = float(np.linalg.norm(drift["zeros_mrad"]))
    first = next(moment for moment in at if moment is not None)
    return PointingDrift(datetime.fromisoformat(first), datetime.fromisoformat(at[-1]), size)


# --- of a heliostat
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MountKey:
    """What a heliostat's pointing error depends on.

    ``mount`` and ``newest`` are the row ids of its newest mount and photograph. ``corrected`` is
    when a photograph was last corrected. ``model`` is the version of the plant's model.
    """

    heliostat: str
    mount: int
    calibrated_at: datetime
    newest: int | None
    corrected: datetime | None
    model: int

    @property
    def key(self) -> str:
        """Text of all of it but the heliostat."""
        parts = (self.mount, self.calibrated_at, self.newest, self.corrected, self.model)
        return result_key(*parts)


def find_pointing(runtime: Runtime, state: MountKey) -> PointingState | None:
    """Pointing of a heliostat; None, logged, if the mount is not valid any more."""
    try:
        with runtime.database.reading() as session:
            mount = session.get_one(MountRow, state.mount, options=[undefer(MountRow.document)])
            row = store.get_heliostat(session, state.heliostat)
            stored = stored_mount(session, row, mount)
            newer = _newer(session, row, stored, mount)
        return pointing_state(stored, mount, newer, runtime.settings.alarm_pointing_mrad)
    except (ModelError, ServiceError) as error:
        logger.info("the pointing error of heliostat %s is not known: %s", state.heliostat, error)
    return None


def _newer(
    session: Session, row: HeliostatRow, stored: StoredMount, mount: MountRow
) -> list[Reading]:
    """Photographs taken after the newest one that the mount was calibrated by."""
    at = mount.document["history"]["at"]
    newest = at[-1] if at else None
    since = (
        None if newest is None else datetime.fromisoformat(newest) + timedelta(seconds=1)
    )  # times are stored to the second
    rows = [
        one
        for one in mounts.pointing_measurements(session, row, since)
        if one.taken_at is not None and one.warning(UNLIKE_HELIOSTAT) is None
    ]
    targets = {one.name: store.target_plane(one) for one in store.list_targets(session)}
    readings, _ = load_readings(stored.heliostat, rows, stored.model, targets)
    return sorted(readings, key=lambda one: one.day)[-_MAX_READ:]
