"""How far off a heliostat's light lands by its newest photographs, whether that grows, and whether it has moved.

What the calibration left of its own photographs is taken as it was stored; photographs that were taken since are held
against the mount that is valid now. It is worked out in the background and remembered, as accuracies are.
"""

import logging
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session, undefer

from model.errors import ModelError
from model.pointing import Reading, off_by
from model.pointing.report import moment_of
from service import store
from service.base.faults import ServiceError
from service.store import mounts
from service.store.tables import MountRow
from service.twin.book import Book
from service.twin.mounted import StoredMount, stored_mount
from service.twin.pointing import readings_of
from service.twin.runtime import Runtime

Array = NDArray[np.float64]

logger = logging.getLogger("heliotwin.service")

NEWEST = 8
"""Photographs that the pointing error is the median of, at most."""

# Photographs since the calibration that a trend takes: three in each third.
_LEAST_OF_TREND = 9

# Standard deviations that no photograph lies off unless its heliostat moved, or it is foreign; two in a row moved.
_FAR = 5.0
_IN_A_ROW = 2

# Photographs since the calibration that are looked at, the newest.
_MOST_READ = 256

# Results that are kept: the field of the largest plant several times over.
_MOST = 200_000


@dataclass(frozen=True)
class Moved:
    """That a heliostat moved between two photographs.

    ``mrad`` is what its drives' zeros stepped by where the calibration has found it (``is_calibrated``); else how far
    its light lies off since. Where photographs do not tell when they were taken, moments are those when they came, and
    ``undated`` names them.
    """

    after: datetime
    before: datetime
    mrad: float
    is_calibrated: bool
    undated: str | None = None

    @property
    def when(self) -> str:
        """Between which days, in words; where those are not known, between which photographs."""
        if self.undated is not None:
            return self.undated
        first, last = (f"{moment.day} {moment:%B %Y}" for moment in (self.after, self.before))
        if first == last:
            return f"on {first} between {self.after:%H:%M} and {self.before:%H:%M} UTC"
        for same in (f" {self.before:%B %Y}", f" {self.before:%Y}"):
            first = first.removesuffix(same)
        return f"between {first} and {last}"


@dataclass(frozen=True)
class Drifted:
    """How far the zeros of its drives went slowly from the first calibrated photograph to the last [mrad]."""

    since: datetime
    until: datetime
    mrad: float


@dataclass(frozen=True)
class Pointing:
    """What photographs say of a calibrated mount.

    Attributes
    ----------
    mount : int
        Version of the mount.
    calibrated_at : datetime
    error_mrad : float or None [mrad]
        Median angle at the mirror between forecast and measured spots, of the newest photographs since it last moved.
    photographs, since_calibration : int
        Those that this is the median of, and all that were taken since the newest calibrated one.
    trend_mrad : float or None [mrad]
        Of those since the calibration, the median of the newest third over that of the third before.
    beyond_since : datetime or None
        Since when the error is above what the settings bear.
    moved : Moved or None
        The last time.
    drifted : Drifted or None
        Where it is sure.
    """

    mount: int
    calibrated_at: datetime
    error_mrad: float | None
    photographs: int
    since_calibration: int
    trend_mrad: float | None = None
    beyond_since: datetime | None = None
    moved: Moved | None = None
    drifted: Drifted | None = None


def pointing_of(
    stored: StoredMount, kept: MountRow, newer: Sequence[Reading], undated: Collection[str], limit_mrad: float
) -> Pointing:
    """By a stored mount, with its document, and photographs that were taken later, in order of time.

    ``undated`` names photographs whose time is not known.
    """
    mount = stored.mount
    days, off = mount.days[~mount.foreign], 1e3 * mount.off[~mount.foreign]
    moved, begin = None, -np.inf
    if mount.steps:
        step = mount.steps[-1]
        begin, size = mount.days[step.after], 1e3 * float(np.linalg.norm(step.zeros))
        names = [kept.document["steps"][-1][name] for name in ("after", "before")]
        moved = Moved(moment_of(mount.days[step.before]), moment_of(begin), size, True, _undated(names, undated))
    trend = None
    if newer:
        apart, far = _forecast_errors(stored, newer)
        new_days = np.array([one.day for one in newer])
        first = int(np.nonzero(~far)[0].max(initial=-1)) + 1
        if len(newer) - first >= _IN_A_ROW:
            before = new_days[first - 1] if first else mount.days[-1]
            begin = new_days[first]
            size = float(np.median(apart[first:]))
            names = [one.name for one in newer[max(first - 1, 0) : first + 1]]
            moved = Moved(moment_of(before), moment_of(begin), size, False, _undated(names, undated))
        trend = _trend(apart)
        days, off = np.concatenate([days, new_days]), np.concatenate([off, apart])
    days, off = days[days >= begin], off[days >= begin]
    return Pointing(
        mount=kept.version,
        calibrated_at=kept.created_at,
        error_mrad=float(np.median(off[-NEWEST:])) if off.size else None,
        photographs=min(off.size, NEWEST),
        since_calibration=len(newer),
        trend_mrad=trend,
        beyond_since=_beyond_since(days, off, limit_mrad),
        moved=moved,
        drifted=_drifted(kept.document),
    )


def _undated(names: Sequence[str], undated: Collection[str]) -> str | None:
    """Between which photographs, where one of them has no time; the first may be one of the calibration's."""
    if not any(name in undated for name in names):
        return None
    return f"between photographs {names[0]} and {names[1]}" if len(names) == 2 else f"before photograph {names[0]}"


def _forecast_errors(stored: StoredMount, newer: Sequence[Reading]) -> tuple[Array, NDArray[np.bool_]]:
    """Angles (N,) [mrad] between forecast and measured spots, and which of them the mount cannot explain."""
    off = off_by(stored.heliostat, stored.mount, newer)
    motors, suns, spots = (np.array([getattr(one, name) for one in newer]) for name in ("motors", "sun", "spot"))
    days = np.array([one.day for one in newer])
    covariance = stored.mount.covariance_at(stored.heliostat, motors, suns, spots, days)
    std = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    return 1e3 * off, np.asarray(off > _FAR * std)


def _trend(off: Array) -> float | None:
    if len(off) < _LEAST_OF_TREND:
        return None
    third = len(off) // 3
    return float(np.median(off[-third:]) - np.median(off[-2 * third : -third]))


def _beyond_since(days: Array, off: Array, limit: float) -> datetime | None:
    """When the median of the newest first was above ``limit``, as it has been ever since; None where it is not."""
    begun = None
    for count in range(len(off), 0, -1):
        if np.median(off[max(0, count - NEWEST) : count]) <= limit:
            break
        begun = moment_of(days[count - 1])
    return begun


def _drifted(document: dict[str, Any]) -> Drifted | None:
    drift, at = document["drift"], document["history"]["at"]
    if not drift["is_sure"]:
        return None
    size = float(np.linalg.norm(drift["zeros_mrad"]))
    return Drifted(datetime.fromisoformat(at[0]), datetime.fromisoformat(at[-1]), size)


# --- remembered -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mounted:
    """What a heliostat's pointing error depends on.

    Its newest mount by its row's id, when that was calibrated, the row of its newest photograph, when one was last
    corrected, and the version of the plant's model.
    """

    heliostat: str
    mount: int
    calibrated_at: datetime
    newest: int | None
    corrected: datetime | None
    model: int


class PointingBook:
    """Pointing errors by what they depend on; None where a mount does not belong to its heliostat any more."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._book: Book[Mounted, Pointing | None] = Book(self._pointing, None, "pointing", _MOST)

    def look_up(self, states: Iterable[Mounted]) -> tuple[dict[str, Pointing | None], int]:
        """What is known, by heliostat, and how many are still being worked out."""
        known, missing = self._book.look_up(states)
        return {state.heliostat: pointing for state, pointing in known.items()}, missing

    def wait_for(self, state: Mounted, seconds: float = 5.0) -> Pointing | None:
        """That of one heliostat."""
        return self._book.wait_for(state, seconds)

    def close(self) -> None:
        """Stop working, and wait for what is under way."""
        self._book.close()

    def _pointing(self, state: Mounted) -> Pointing | None:
        try:
            with self._runtime.database.reading() as session:
                kept = session.get_one(MountRow, state.mount, options=[undefer(MountRow.document)])
                stored, newer, undated = _newer(session, state.heliostat, kept)
            return pointing_of(stored, kept, newer, undated, self._runtime.settings.attention_pointing_mrad)
        except (ModelError, ServiceError) as error:
            logger.info("the pointing error of heliostat %s is not known: %s", state.heliostat, error)
        return None


def _newer(session: Session, name: str, kept: MountRow) -> tuple[StoredMount, list[Reading], set[str]]:
    """The heliostat, its photographs taken after the newest that the mount was calibrated by, and undated ones."""
    row = store.get_heliostat(session, name)
    stored, at = stored_mount(session, row, kept), kept.document["history"]["at"]
    since = datetime.fromisoformat(at[-1]) + timedelta(seconds=1) if at else None  # moments are kept to the second
    rows = mounts.pointing_measurements(session, row, since)
    # What tells no time and was there already is of the calibration, whenever it came.
    rows = [one for one in rows if one.taken_at is not None or one.created_at > kept.created_at]
    readings, _ = readings_of(stored.heliostat, rows, stored.origin, stored.effects)
    newer = sorted(readings, key=lambda one: one.day)[-_MOST_READ:]
    stepped = [step[end] for step in kept.document["steps"][-1:] for end in ("after", "before")]
    return stored, newer, mounts.undated(session, row, [*stepped, *(one.name for one in newer)])
