"""Worker thread that writes the state of heliostats, and the alarms.

Several workers of one store share the work. Each writes alarms only if no other has written them
since it read the store, so that older data never replace newer ones.
"""

import logging
import random
import threading
import time
from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import NamedTuple

from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.base.settings import Settings
from service.store import acknowledgements, field_state
from service.store.acknowledgements import Key
from service.store.columns import EPOCH, now
from service.store.field_state import apply_pointing_limit, lock_field_state, save_states
from service.store.job_tables import AlarmRow, JobRow
from service.store.tables import DecisionRow, MeasurementRow, ModelRow, MountRow, SurfaceRow
from service.twin.alarms.alarms import RECORDED, Alarm, compute_alarms, find_ended_accuracies
from service.twin.alarms.field_fall import are_known, read_levels
from service.twin.alarms.field_overview import (
    LARGE,
    HeliostatOverview,
    compute_results,
    read_marks,
    read_summaries,
)
from service.twin.runtime import Runtime
from service.twin.studies.cameras import CHANGES, CameraChange, camera_watch
from service.twin.studies.field_change import EffectWatch

logger = logging.getLogger("heliotwin.jobs")

# Time after which alarms are computed again although nothing was stored, because some go by the
# clock, and shortest time of computing results before they are written [s].
_AGAIN_S = 30.0
_BATCH_S = 1.0
# Rest after an update, in times of how long it took: in a stream of photographs something is always
# due, and requests share the processor.
_REST = 3.0
# Longest time between the time of a row and the commit that shows it.
_COMMIT = timedelta(minutes=1)
# Reasons that depend on results which may be pending.
_BY_RESULT = {"moved": "pointing", "pointing": "pointing", "drift": "pointing", "fell": "accuracy"}
# Reasons that the next photograph ends, rather than a decision.
_BY_PHOTOGRAPH = ("accuracy", "fell", "dimmed", "no_photograph")


class _Reading(NamedTuple):
    """What the store held ``at`` a time: heliostats, and the alarms that follow."""

    revision: int
    at: datetime
    marks: str
    lines: list[HeliostatOverview]
    cameras: list[CameraChange]
    levels: dict[str, float]
    alarms: list[Alarm]

    @property
    def pending(self) -> list[HeliostatOverview]:
        """Heliostats with pending results."""
        return [line for line in self.lines if line.pending]


class _Levels(NamedTuple):
    """Levels of the field's accuracy [1] by time, after so many writes of heliostats' states."""

    states: int
    by_day: dict[str, float]


class FieldStateWriter:
    """Writer of the state of heliostats whose data changed, and of the alarms."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime, self._effects = runtime, EffectWatch(runtime)
        self._watch = camera_watch(runtime.database)
        self._marks, self._written_s = "", -_AGAIN_S
        self._levels: _Levels | None = None
        self._has_limit, self.is_large = False, False
        self._rest_s = 0.0

    def run(self, stopping: threading.Event) -> None:
        """Write what changed until ``stopping``."""
        while not stopping.is_set():
            self._rest_s = self._runtime.settings.job_poll_s
            try:
                if self.is_due():
                    self.update(stopping)
            except SQLAlchemyError as error:
                logger.warning("the state of the field waits for the database: %s", error)
            except Exception:  # other data may be free of the fault
                logger.exception("the state of the field cannot be computed")
            stopping.wait(self._rest_s)

    def is_due(self) -> bool:
        """Whether something was stored since the last update, or that was long ago."""
        if time.monotonic() - self._written_s >= _AGAIN_S:
            return True
        with self._runtime.database.reading() as session:
            return read_marks(session) != self._marks

    def update(self, stopping: threading.Event | None = None) -> int:
        """Write alarms, then some of the pending results; return the number of those before."""
        begun_s = time.monotonic()
        if not self._has_limit:
            self._runtime.database.run_in_transaction(
                lambda session: apply_pointing_limit(
                    session, self._runtime.settings.alarm_pointing_mrad
                )
            )
            self._has_limit = True
        reading = self._read()
        self._runtime.database.run_in_transaction(
            lambda session: _write(session, reading, self._runtime.settings)
        )
        self.is_large, took_s = len(reading.lines) > LARGE, time.monotonic() - begun_s
        pending = [] if self._is_measuring() else reading.pending
        done = self._compute(pending, max(_BATCH_S, 3 * took_s), stopping or threading.Event())
        self._marks, self._written_s = "" if pending else reading.marks, time.monotonic()
        worked_s = self._written_s - begun_s
        self._rest_s = 0.0 if done < len(pending) else max(self._rest_s, _REST * worked_s)
        return len(pending)

    def _is_measuring(self) -> bool:
        """Whether photographs are measured again: a series by two cameras would seem to fall."""
        running = select(JobRow.id).where(JobRow.kind == "measurements", JobRow.state == "running")
        with self._runtime.database.reading() as session:
            return session.scalar(running.limit(1)) is not None

    def _read(self) -> _Reading:
        settings, effects = self._runtime.settings, self._effects.read()
        with self._runtime.database.reading() as session:
            field, at, marks = (field_state.read_field_state(session), now(), read_marks(session))
            lines, cameras = read_summaries(session), self._watch.read(session, settings)
            if self._levels is None or self._levels.states != field.states:
                self._levels = _Levels(field.states, read_levels(session, lines))
            levels = self._levels.by_day
            alarms = compute_alarms(session, lines, settings, cameras, effects, levels)
        return _Reading(field.revision, at, marks, lines, cameras.changes, levels, alarms)

    def _compute(
        self, pending: Sequence[HeliostatOverview], seconds: float, stopping: threading.Event
    ) -> int:
        """Compute and write results for some ``seconds``, in an order unlike other workers'.

        Returns the number of heliostats.
        """
        begun_s, found = time.monotonic(), dict[int, dict[str, object]]()
        for line in random.sample(pending, len(pending)):
            if stopping.is_set() or time.monotonic() - begun_s > seconds:
                break
            found[line.id] = compute_results(self._runtime, line)
        if found:
            self._runtime.database.run_in_transaction(lambda session: save_states(session, found))
        return len(found)


# --- what is written
# --------------------------------------------------------------------------------------------------


def _write(session: Session, reading: _Reading, settings: Settings) -> None:
    """Write the alarms of a reading, unless another worker has written alarms since."""
    field = lock_field_state(session)
    if field.revision != reading.revision:
        return
    before = field.computed_at - _COMMIT if field.revision else EPOCH
    ended = _ended_accuracies(session, settings, before)
    ends: dict[tuple[str | None, str, datetime], datetime] = {
        (alarm.heliostat, alarm.reason, alarm.since): at for alarm, at in ended
    }
    lines = {line.name: line for line in reading.lines}

    def ended_at(key: Key, row: AlarmRow) -> datetime | None:
        line = lines.get(key.heliostat or "")
        if line is not None and _BY_RESULT.get(key.reason) in line.pending:
            return None
        if line is None and key.reason == "fell" and not are_known(reading.lines):
            return None
        if (at := ends.get((key.heliostat, key.reason, row.since))) is not None:
            return at
        if line is None:
            at = _plant_changed_at(session, row, before)
        else:
            at = _heliostat_changed_at(session, line, row, before)
        return max(row.since, at or reading.at)

    present = {alarm.key: _columns(alarm) for alarm in reading.alarms}
    new = acknowledgements.record_alarms(session, present, ended_at)
    for alarm in reading.alarms:  # a surface may be imported with its acknowledgement
        if alarm.acknowledged_by is not None and alarm.key in new:
            acknowledgements.acknowledge(session, [alarm.key], alarm.acknowledged_by, "")
    brief = ((alarm.key, _columns(alarm) | {"ended_at": at}) for alarm, at in ended)
    acknowledgements.record_ended(session, brief)
    field.revision, field.computed_at, field.marks = field.revision + 1, reading.at, reading.marks
    field.pending = len(reading.pending)
    field.levels = reading.levels
    field.cameras = CHANGES.dump_python(reading.cameras, mode="json")


def _columns(alarm: Alarm) -> dict[str, object]:
    """What is recorded of an alarm in addition to its key."""
    return {name: getattr(alarm, name) for name in RECORDED if name not in Key._fields}


def _ended_accuracies(
    session: Session, settings: Settings, before: datetime
) -> list[tuple[Alarm, datetime]]:
    present = acknowledgements.open_alarms(session)
    open_since = {
        name: row.since for name, row, _ in present if name is not None and row.reason == "accuracy"
    }
    return list(find_ended_accuracies(session, settings, before, open_since))


def _heliostat_changed_at(
    session: Session, line: HeliostatOverview, row: AlarmRow, before: datetime
) -> datetime | None:
    """When data of a heliostat changed that came after ``before``: the photograph's time, or the
    decision's.
    """
    photograph = MeasurementRow
    taken = session.scalar(
        select(func.max(photograph.taken_at)).where(
            photograph.heliostat_id == line.id, photograph.created_at > before
        )
    )
    decided = [
        session.scalar(select(func.max(table.created_at)).where(table.heliostat_id == line.id))
        for table in (DecisionRow, SurfaceRow, MountRow)
    ]
    changes = [at for at in (*decided, line.corrected) if at is not None and at > before]
    if taken is not None and (row.reason in _BY_PHOTOGRAPH or not changes):
        return taken
    return max(changes, default=None)


def _plant_changed_at(session: Session, row: AlarmRow, before: datetime) -> datetime | None:
    """When a job, a mount or the model changed after ``before``."""
    if row.reason == "queue":
        return session.scalar(select(JobRow.attempted_at).where(JobRow.id == int(row.fingerprint)))
    columns = (JobRow.finished_at, MountRow.created_at, ModelRow.adopted_at, ModelRow.withdrawn_at)
    newest = [session.scalar(select(func.max(column))) for column in columns]
    return max((at for at in newest if at is not None and at > before), default=None)
