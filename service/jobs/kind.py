"""Kinds of jobs: payload, handler function, the handler's context, and names of heliostats."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from sqlalchemy import event, func, select
from sqlalchemy.orm import Session

from service import store
from service.base.arrays import pack, unpack
from service.base.errors import ConflictError, NotFoundError
from service.base.fields import Name
from service.base.settings import Settings
from service.store import queue
from service.store.job_tables import JobRow
from service.store.tables import HeliostatRow
from service.twin.runtime import Runtime

# Seconds between two writes of a job's progress: often enough for people, rare for the database.
_REPORT_EVERY_S = 0.5

# Share of a job that must be done, and seconds that must have passed, before the remaining time is
# estimated.
_MIN_SHARE, _MIN_S = 0.01, 1.0
Payload = TypeVar("Payload", bound=BaseModel)


class CancelRequestedError(Exception):
    """Somebody requested the cancellation of the job."""


class WorkerStoppingError(Exception):
    """The worker is stopping. Another one continues the job."""


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a job: JSON figures, and optional named arrays."""

    figures: Mapping[str, object]
    arrays: Mapping[str, NDArray[np.generic]] | None = None


@dataclass(eq=False)
class Context:
    """A handler's view of its job.

    A handler calls `report` about every second. There it receives an exception if the job was
    cancelled, lost or returned to the queue, and lets this exception pass. The call also shows that
    the handler is alive. Without it, the worker finally gives the job up. Effects that must happen
    only once, even if the job restarts, are written in one transaction with `keep`.
    """

    runtime: Runtime
    lease: queue.Lease
    created_by: str
    stopping: threading.Event
    cancelled: threading.Event = field(default_factory=threading.Event)
    lost: threading.Event = field(default_factory=threading.Event)
    reported_s: float = -math.inf
    alive_s: float = field(default_factory=time.monotonic)
    has_progressed: threading.Event = field(default_factory=threading.Event)  # completed a step
    expected_s: float | None = None  # duration [s], until the pace is known
    _first: tuple[float, float] | None = None  # time and share at the attempt's first report
    _phase: str = ""
    _share: float = 0.0
    _reporting: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        """Let the job also stop while it waits for a computation slot."""
        self.runtime = replace(self.runtime, check=self.check)

    @property
    def silent_s(self) -> float:
        """Time since the last sign of life [s]."""
        return time.monotonic() - self.alive_s

    def check(self) -> None:
        """Stop the work if necessary.

        Raises
        ------
        LeaseLostError
            If another worker holds the job.
        CancelRequestedError
            If the job was cancelled.
        WorkerStoppingError
            If the worker is stopping.
        """
        self.alive_s = time.monotonic()
        if self.lost.is_set():
            raise queue.LeaseLostError(f"job {self.lease.job_id}")
        if self.cancelled.is_set():
            raise CancelRequestedError
        if self.stopping.is_set():
            raise WorkerStoppingError

    def report(
        self,
        share: float,
        message: str = "",
        *,
        phase: str = "",
        n_done: int | None = None,
        n_total: int | None = None,
    ) -> None:
        """Report the completed share, 0 to 1, and the current activity. Raises the errors of
        `check`.

        ``phase`` describes the units of ``n_done`` and ``n_total``. May be called from several
        threads.
        """
        self.check()
        with self._reporting:
            if phase == self._phase and time.monotonic() - self.reported_s < _REPORT_EVERY_S:
                return
            self.reported_s, self._phase = time.monotonic(), phase
            share = self._share = max(share, self._share)  # also if more steps become known
        progress = queue.Progress(share, message, phase, n_done, n_total, self._remaining_s(share))
        with self.runtime.database.writing() as session:
            if queue.report(session, self.lease, progress):
                self.cancelled.set()
        self.check()

    def _remaining_s(self, share: float) -> float | None:
        """Expected time to the end [s] at the pace of this attempt, else by ``expected_s``."""
        at = time.monotonic()
        if self._first is None:
            self._first = at, share
        begun_s, begun_share = self._first
        if share - begun_share < _MIN_SHARE or at - begun_s < _MIN_S:
            return None if self.expected_s is None else (1 - share) * self.expected_s
        return (1 - share) * (at - begun_s) / (share - begun_share)

    def steps(self) -> dict[str, dict[str, Any]]:
        """The completed steps of this and earlier attempts."""
        with self.runtime.database.reading() as session:
            return queue.load_checkpoints(session, self.lease.job_id)

    def keep(
        self,
        session: Session,
        name: str,
        result: Mapping[str, object],
        arrays: Mapping[str, NDArray[np.generic]] | None = None,
    ) -> None:
        """Store a step as completed in its effects' transaction. LeaseLostError undoes both."""
        self.alive_s = time.monotonic()
        queue.save_checkpoint(
            session, self.lease, name, result, None if arrays is None else pack(arrays)
        )
        event.listen(session, "after_commit", lambda _: self.has_progressed.set(), once=True)

    def replace(
        self,
        session: Session,
        name: str,
        result: Mapping[str, object],
        arrays: Mapping[str, NDArray[np.generic]] | None = None,
    ) -> None:
        """Store the progress under a name, in place of an earlier one."""
        queue.delete_checkpoint(session, self.lease, name)
        self.keep(session, name, result, arrays)

    def kept_arrays(self, name: str) -> dict[str, NDArray[Any]] | None:
        """The arrays of a completed step; None if there is no such step or array."""
        with self.runtime.database.reading() as session:
            data = queue.checkpoint_arrays(session, self.lease.job_id, name)
        return None if data is None else unpack(data)

    @contextmanager
    def keeping(self, name: str, result: Callable[[], Mapping[str, object]]) -> Iterator[None]:
        """Store the partial result ``result`` if the job is cancelled in the block.

        It will not start again.
        """
        try:
            yield
        except CancelRequestedError:
            with self.runtime.database.writing() as session:
                self.keep(session, name, result())
            raise


@dataclass(frozen=True)
class Kind(Generic[Payload]):
    """A kind of job: its payload and its handler.

    Optional functions:

    - ``due``: workers call it every hour. It returns None, or the Idempotency-Key of a due job.
      Such a job starts once, with an empty payload.
    - ``so_far`` makes a result of the completed steps, for a job that did not finish.
    - ``details`` names the step with the part of the result that only the whole job shows.
    - ``require`` checks the payload against settings and store before a job is queued.
    - ``existing`` returns the job of a payload that has only one, None if it has none yet. It locks
      out others that would queue it.
    - ``expected_s`` estimates the duration [s] from the payload and what is stored. A kind without
      it counts as long.
    """

    name: str
    payload: type[Payload]
    handler: Callable[[Context, Payload], Result]
    summary: str
    due: Callable[[Session, Settings], str | None] | None = None
    so_far: Callable[[Mapping[str, Mapping[str, Any]]], Mapping[str, object]] | None = None
    details: str | None = None
    require: Callable[[Payload, Runtime], object] | None = None
    existing: Callable[[Session, Payload, Settings], JobRow | None] | None = None
    expected_s: Callable[[Payload, Runtime], float] | None = None

    def run(self, context: Context, document: Mapping[str, Any]) -> Result:
        """Do a job with the payload in ``document``."""
        payload = self.payload.model_validate(document)
        if self.expected_s is not None:
            context.expected_s = self.expected_s(payload, context.runtime)
        return self.handler(context, payload)


Kinds = Mapping[str, Kind[Any]]


def result_of(kinds: Kinds, session: Session, job: JobRow) -> Mapping[str, Any] | None:
    """The result of a job. For a cancelled or failed one, what it changed until then."""
    kind = kinds.get(job.kind)
    if kind is not None and kind.details is not None and job.result is not None:
        return {**job.result, **queue.load_checkpoints(session, job.id).get(kind.details, {})}
    if (
        job.result is not None
        or kind is None
        or kind.so_far is None
        or job.state not in ("cancelled", "failed")
    ):
        return job.result
    return kind.so_far(queue.load_checkpoints(session, job.id))


Heliostats = Annotated[
    list[Name] | None,
    Field(min_length=1, max_length=20_000, description="Names of heliostats; all without it."),
]

MAX_PIXELS = 10_000_000
"""Maximum number of pixels of a plan's maps over all times: 40 MB for each kind of map."""


def chosen_names(runtime: Runtime, names: Sequence[str] | None) -> list[str]:
    """The requested heliostats without duplicates; all stored ones if ``names`` is None."""
    if names is not None:
        return list(dict.fromkeys(names))
    with runtime.database.reading() as session:
        return list(session.scalars(select(HeliostatRow.name).order_by(HeliostatRow.name)))


def count_chosen(runtime: Runtime, names: Sequence[str] | None) -> int:
    """The number of requested heliostats; that of all stored ones if ``names`` is None."""
    if names is not None:
        return len(names)
    with runtime.database.reading() as session:
        return session.scalars(select(func.count()).select_from(HeliostatRow)).one()


def require_some(n_successful: int, skipped: dict[str, str]) -> None:
    """Raise ConflictError with the first reason if ``n_successful`` is 0."""
    if not n_successful:
        name, reason = next(iter(skipped.items()), ("the store", "it holds no heliostat"))
        raise ConflictError(
            f"nothing could be done for any of {len(skipped)} heliostats; {name}: {reason}"
        )


_HELIOSTATS = ("heliostats", "aim_points_m", "aim_offsets_m")
"""Payload fields that name heliostats, in a list or as keys."""
_LISTED = 5
"""Maximum number of unknown names that an error lists."""


def require_stored(session: Session, payload: Mapping[str, Any]) -> None:
    """Check that the heliostats and the target that a job's payload names are stored.

    Raises
    ------
    NotFoundError
        With the field and the first unknown names, or the job that is no plan of aims.
    ConflictError
        If the plan of aims is not done, or aims at another target.
    """
    for place in _HELIOSTATS:
        names = dict.fromkeys(payload.get(place) or ())
        known = set(session.scalars(select(HeliostatRow.name).where(HeliostatRow.name.in_(names))))
        if unknown := [name for name in names if name not in known]:
            more = f" and {len(unknown) - _LISTED} more" if len(unknown) > _LISTED else ""
            listed = f"{', '.join(unknown[:_LISTED])}{more}"
            raise NotFoundError(f"{place}: {listed} not found; GET /v1/heliostats lists the names")
    if (target := payload.get("target")) is not None:
        store.get_target_or_receiver(session, target)
    if (number := payload.get("aim_plan")) is not None:
        _require_aim_plan(session, number, target)


def _require_aim_plan(session: Session, number: int, target: object) -> None:
    """Check that a job is a finished plan of aims on the same target."""
    row = session.get(JobRow, number)
    if row is None or row.kind != "aim-plans":
        raise NotFoundError(f"aim_plan: job {number} is no plan of aims; GET /v1/jobs lists them")
    if row.state != "done":
        raise ConflictError(f"aim_plan: job {number} is {row.state}; wait until it is done")
    if row.payload.get("target") != target:
        raise ConflictError(
            f"aim_plan: job {number} aims at {row.payload.get('target') or 'a separate receiver'}"
            f", not at {target}; give a plan of the same target"
        )
