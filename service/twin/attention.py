"""What needs an operator's attention: why, since when, what to do, and who has seen it.

All of it is read from the store and the field's book when it is asked for; kept is only who acknowledged what. An item
has a ``mark`` that tells one reason from the next of its kind: as long as the mark is the same the acknowledgement
holds, and where the reason went and came back, or what it measures doubled, the mark is another.
"""

import hashlib
import math
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from datetime import time as clock
from itertools import pairwise
from typing import Literal

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.effects import CATALOGUE
from model.pointing.report import clock_in_words
from service import store
from service.base.faults import NotFoundError
from service.base.settings import Settings
from service.store import acknowledgements, decisions, queue
from service.store.columns import now
from service.store.job_tables import AcknowledgementRow, JobRow
from service.store.tables import DriftRow, HeliostatRow, MeasurementRow, ModelRow, MountRow, PlantRow, StudyRow
from service.twin import versions
from service.twin.cameras import FIGURES, Change
from service.twin.field import PATIENCE_S, Current, FieldBook, Line
from service.twin.pointing_errors import Moved, Pointing
from service.twin.runtime import Runtime

Reason = Literal[
    "queue", "camera", "clock", "moved", "pointing", "drift", "accuracy", "fell", "untrusted", "no_photograph"
]

REASONS: dict[Reason, str] = {
    "queue": "Queue stuck",
    "camera": "Camera changed",
    "clock": "Clock wrong",
    "moved": "Moved",
    "pointing": "Pointing error",
    "drift": "Drives drift",
    "accuracy": "Newest forecast poor",
    "fell": "Accuracy fell",
    "untrusted": "Surface not trusted",
    "no_photograph": "No photograph",
}
"""Every reason, the most urgent first."""

# For so long the count of a page's menu may be an earlier one [s].
_COUNT_HOLDS_S = 15.0


@dataclass(frozen=True)
class Item:
    """Something that needs attention; of the plant where it names no heliostat.

    ``photographs`` are measurements of the heliostat to look at.
    """

    reason: Reason
    heliostat: str | None
    since: datetime
    what: str
    todo: str
    mark: str
    acknowledged_by: str | None = None
    acknowledged_at: datetime | None = None
    photographs: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        """It and its reason as they are now; another where the reason changes or returns."""
        return f"{self.heliostat or 'plant'}:{self.reason}:{hashlib.sha256(self.mark.encode()).hexdigest()[:8]}"


def needs_attention(session: Session, book: FieldBook, settings: Settings) -> tuple[list[Item], int]:
    """All that does, the most urgent reason first, the newest of each first; and how many heliostats are pending."""
    field = book.read(session, PATIENCE_S)
    return of_lines(session, field.lines, settings, book.cameras.changes(session, settings)), field.pending


def of_lines(session: Session, lines: Sequence[Line], settings: Settings, cameras: Sequence[Change]) -> list[Item]:
    """The same of heliostats with their pointing errors, and of changes of cameras."""
    at = now()
    found = [*_queue(session, settings), *_camera(session), *_watched(session, cameras), *_clock(session)]
    found += [*_accuracies(session, settings), *_falls(session, settings)]
    found += _without_photograph(session, timedelta(days=settings.attention_photograph_days), at)
    for line in lines:
        found += _of_heliostat(line, settings, at)
    known = acknowledgements.acknowledged(session)
    order = {reason: place for place, reason in enumerate(REASONS)}
    items = [_with_acknowledgement(item, known) for item in found]
    return sorted(items, key=lambda item: (order[item.reason], -item.since.timestamp(), item.heliostat or ""))


def _with_acknowledgement(item: Item, known: dict[acknowledgements.Key, AcknowledgementRow]) -> Item:
    row = known.get((item.heliostat, item.reason, item.mark))
    return item if row is None else replace(item, acknowledged_by=row.made_by, acknowledged_at=row.made_at)


# --- heliostats -------------------------------------------------------------------------------------------------------


def _of_heliostat(line: Line, settings: Settings, at: datetime) -> Iterator[Item]:
    if line.surface is not None and line.surface.doubts:
        yield _untrusted(line.name, line.surface)
    if line.pointing is not None:
        yield from _pointing(line, line.pointing, settings, at)


def _untrusted(name: str, surface: Current) -> Item:
    since, photographs = surface.doubted_since or surface.valid_from, tuple(surface.suspicious or ())
    which = f"photographs {', '.join(photographs)}" if len(photographs) > 1 else f"photograph {''.join(photographs)}"
    return Item(
        "untrusted",
        name,
        since,
        "; ".join(surface.doubts or ()),
        f"look at {which if photographs else 'its photographs'}, exclude what is wrong, and predict its surface anew",
        since.isoformat(),
        surface.seen_by,
        surface.seen_at,
        photographs,
    )


def _pointing(line: Line, pointing: Pointing, settings: Settings, at: datetime) -> Iterator[Item]:
    moved, is_new = pointing.moved, False
    if moved is not None:
        is_new = not moved.is_calibrated
        is_late = moved.undated is None and at - moved.before < timedelta(days=settings.attention_moved_days)
        if is_new or is_late:
            yield _moved(line.name, moved)
    if pointing.beyond_since is not None and pointing.error_mrad is not None and not is_new:
        metres = "" if line.pointing_m is None else f", {line.pointing_m:.2f} m on the receiver"
        yield Item(
            "pointing",
            line.name,
            pointing.beyond_since,
            f"its light lies {pointing.error_mrad:.1f} mrad off{metres}",
            "photograph it where the calibration plan says, and calibrate its mount anew",
            _mark(pointing.beyond_since, pointing.error_mrad / settings.attention_pointing_mrad),
        )
    if pointing.drifted is not None:
        drifted = pointing.drifted
        yield Item(
            "drift",
            line.name,
            drifted.since,
            f"its drives went {drifted.mrad:.1f} mrad slowly until {drifted.until:%Y-%m-%d}",
            "look at its foundation and drives, and calibrate its mount often",
            _mark(drifted.since, drifted.mrad),
        )


def _moved(name: str, moved: Moved) -> Item:
    if moved.is_calibrated:
        size, todo = f"its drives stepped by {moved.mrad:.1f} mrad", "find out why; its mount is calibrated since"
    else:
        size, todo = (
            f"its light lies {moved.mrad:.1f} mrad off since",
            "look at its drives and encoders, and calibrate its mount anew",
        )
    mark = f"{moved.after.isoformat()} {moved.before.isoformat()}"
    return Item("moved", name, moved.before, f"it moved {moved.when}: {size}", todo, mark)


def _without_photograph(session: Session, allowed: timedelta, at: datetime) -> Iterator[Item]:
    row, photograph = HeliostatRow, MeasurementRow
    taken = func.max(func.coalesce(photograph.taken_at, photograph.created_at))
    query = select(row.name, row.created_at, taken).group_by(row.id, row.name, row.created_at)
    query = query.outerjoin(photograph, (photograph.heliostat_id == row.id) & photograph.accepted)
    for name, created, last in session.execute(query.having(func.coalesce(taken, row.created_at) < at - allowed)):
        what = "none was ever accepted" if last is None else f"the last accepted one is of {last:%Y-%m-%d}"
        begun = last or created
        todo = "photograph it where the calibration plan says"
        yield Item("no_photograph", name, begun + allowed, what, todo, begun.isoformat())


def _mark(since: datetime, times: float) -> str:
    """Another one each time that a figure doubles."""
    return f"{since.isoformat()} {math.floor(math.log2(max(times, 1.0)))}"


def _accuracies(session: Session, settings: Settings) -> Iterator[Item]:
    least = settings.attention_accuracy
    query = select(HeliostatRow.name, DriftRow.accuracy, DriftRow.poor_since, DriftRow.taken_at)
    poor = query.join(DriftRow, DriftRow.heliostat_id == HeliostatRow.id).where(DriftRow.accuracy < least)
    for name, accuracy, poor_since, taken_at in session.execute(poor):
        since = poor_since or taken_at
        what = f"its newest photograph was forecast with an accuracy of {accuracy:.0%}, and {least:.0%} is the least"
        todo = "predict its surface anew; if that does not help, study the photographs"
        yield Item("accuracy", name, since, what, todo, _mark(since, (1 - accuracy) / max(1 - least, 1e-6)))


def _falls(session: Session, settings: Settings) -> Iterator[Item]:
    """Heliostats whose newest photographs were forecast worse than those before, each when it came."""
    allowed = settings.attention_accuracy_drop
    query = select(HeliostatRow.name, DriftRow).join(DriftRow, DriftRow.heliostat_id == HeliostatRow.id)
    for name, row in session.execute(query.where(DriftRow.least_drop > allowed)):
        since, drop = row.fell_since or row.taken_at, row.least_drop or 0.0
        what = (
            f"its newest photographs were forecast with an accuracy of {row.recent:.0%} in the median when they came, "
            f"{row.earlier:.0%} before; by {drop:.0%} at least, and {allowed:.0%} is allowed"
        )
        todo = "look for what changed on its mirror, and predict its surface anew"
        yield Item("fell", name, since, what, todo, _mark(since, drop / max(allowed, 1e-6)))


# --- the plant --------------------------------------------------------------------------------------------------------


def _queue(session: Session, settings: Settings) -> Iterator[Item]:
    oldest = session.execute(
        select(JobRow.id, JobRow.created_at).where(JobRow.state == "queued").order_by(JobRow.created_at).limit(1)
    ).one_or_none()
    if oldest is None or queue.clock(session) - oldest.created_at < timedelta(seconds=settings.attention_queue_s):
        return
    what, todo = f"job {oldest.id} has waited since then", "see whether a worker is alive, and what its log says"
    yield Item("queue", None, oldest.created_at, what, todo, str(oldest.id))


def _camera(session: Session) -> Iterator[Item]:
    """A study's change of the camera that nobody adopted, and the last time that another camera was declared."""
    study = session.execute(
        select(StudyRow.id, StudyRow.created_at, StudyRow.report["effects"]).order_by(StudyRow.id.desc()).limit(1)
    ).one_or_none()
    if study is not None and versions.find_adopted(session, study.id) is None:
        for effect in study[2] or ():
            scope = effect.get("scope") or {}
            if scope.get("kind") == "since" and CATALOGUE[effect["name"]].stage == "image":
                name, day = effect["name"], scope["since"]
                yield Item(
                    "camera",
                    None,
                    datetime.fromisoformat(f"{day}T00:00:00+00:00"),
                    f"study {study.id} found {name.replace('_', ' ')} in photographs from {day} on",
                    f"read study {study.id}, and adopt it or declare the camera anew",
                    f"{name} {day}",
                )
    declared = _declared_anew(session)
    if declared is not None:
        yield Item(
            "camera",
            None,
            declared.adopted_at,
            f"version {declared.number} of the model declared another camera; photographs from before it stay measured "
            "as they were",
            "measure the stored photographs anew (POST /v1/jobs/measurements), and predict surfaces anew",
            f"version {declared.number}",
        )


def _watched(session: Session, cameras: Sequence[Change]) -> Iterator[Item]:
    """What photographs show by themselves, until a camera is declared anew."""
    declared = _declared_anew(session) if cameras else None
    for change in cameras:
        since = datetime.combine(change.day, clock(), UTC)
        if declared is None or since > declared.adopted_at:
            way, times = "up" if change.ratio > 1 else "down", f"{change.ratio:.2f} times what it was"
            yield Item(
                "camera",
                None,
                since,
                f"on {change.target} {FIGURES[change.figure]} is {times}, in the median of "
                f"{change.days[1]} days against {change.days[0]} before, from photographs of {change.day} on",
                "look at the camera's exposure, focus and lens; study the photographs, or declare the camera anew",
                f"{change.target} {change.figure} {way} {change.day:%Y-%m}",
            )


def _clock(session: Session) -> Iterator[Item]:
    """What the newest calibration found of the clock."""
    newest = select(MountRow.document["clock"]).order_by(MountRow.created_at.desc(), MountRow.id.desc()).limit(1)
    clock = session.scalar(newest)
    if clock is not None:
        yield Item(
            "clock",
            None,
            datetime.fromisoformat(f"{clock['since']}T00:00:00+00:00"),
            clock_in_words(clock),
            "set the clock that suns are computed by; correct the suns of photographs since then, and calibrate anew",
            f"{clock['since']} {'slow' if clock['minutes'] > 0 else 'fast'}",
        )


def _declared_anew(session: Session) -> ModelRow | None:
    """The newest version of the model whose cameras are others than those of the one before it."""
    plant, rows = session.get(PlantRow, 1), [row for row in versions.list_models(session) if row.withdrawn_at is None]
    declared = [None if plant is None else plant.declared, *(row.declared for row in rows)]
    cameras = [(document or {}).get("cameras") for document in declared]
    changed = [row for row, (old, new) in zip(rows, pairwise(cameras), strict=True) if old != new]
    return changed[-1] if changed else None


# --- acknowledging ----------------------------------------------------------------------------------------------------


def acknowledge(runtime: Runtime, book: FieldBook, ids: Sequence[str], actor: str) -> list[Item]:
    """Note that ``actor`` has seen items, by their ids; they as they stand then, in that order.

    Raises
    ------
    NotFoundError
        Where one is not, or not any more, what needs attention; then none is acknowledged.
    """
    with runtime.database.reading() as session:
        items = {item.id: item for item in needs_attention(session, book, runtime.settings)[0]}
    missing = [number for number in ids if number not in items]
    if missing:
        raise NotFoundError(f"ids: {missing[0]} does not need attention, or its reason changed; see /v1/attention")
    with runtime.database.writing() as session:
        return [_acknowledge(session, items[number], actor) for number in ids]


def _acknowledge(session: Session, item: Item, actor: str) -> Item:
    heliostat = None if item.heliostat is None else store.get_heliostat(session, item.heliostat)
    if heliostat is not None and item.reason == "untrusted":
        surface = store.get_surface_at(session, heliostat)
        decisions.see(session, heliostat, surface, actor)
        return replace(item, acknowledged_by=surface.seen_by, acknowledged_at=surface.seen_at)
    row = acknowledgements.acknowledge(session, heliostat, item.reason, item.mark, actor)
    return replace(item, acknowledged_by=row.made_by, acknowledged_at=row.made_at)


class AttentionCount:
    """How many items nobody has acknowledged, for the menu of every page: counted now and then only."""

    def __init__(self, runtime: Runtime, book: FieldBook) -> None:
        self._runtime, self._book = runtime, book
        self._lock = threading.Lock()
        self._counted, self._counted_s = 0, -math.inf

    def read(self) -> int:
        """The count of some seconds ago at most."""
        with self._lock:
            if time.monotonic() - self._counted_s >= _COUNT_HOLDS_S:
                with self._runtime.database.reading() as session:
                    items, _ = needs_attention(session, self._book, self._runtime.settings)
                self._counted = sum(item.acknowledged_by is None for item in items)
                self._counted_s = time.monotonic()
            return self._counted

    def forget(self) -> None:
        """Count anew when it is asked for next: something was acknowledged."""
        with self._lock:
            self._counted_s = -math.inf
