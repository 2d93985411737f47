"""Which version of a surface is today's: what was decided, by whom and on what grounds, and how it is taken back."""

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import select, tuple_
from sqlalchemy.orm import Session

from service.base.faults import ConflictError
from service.store import audit
from service.store.columns import now
from service.store.rows import hold
from service.store.surfaces import find_surface_at
from service.store.tables import DecisionRow, HeliostatRow, SurfaceRow


@dataclass(frozen=True)
class Grounds:
    """Why a version is today's, or is not.

    ``before`` and ``after`` are mean flux accuracies [1] of the surface that was today's and of the one that was
    judged, on ``photographs`` photographs; None where nothing was compared.
    """

    reason: str
    before: float | None = None
    after: float | None = None
    photographs: int = 0


def _set_aside(session: Session, heliostat: HeliostatRow) -> list[int]:
    query = select(SurfaceRow.version).where(SurfaceRow.heliostat_id == heliostat.id, SurfaceRow.set_aside)
    return list(session.scalars(query.order_by(SurfaceRow.version)))


def _note(
    session: Session, heliostat: HeliostatRow, surface: SurfaceRow, taken: bool, actor: str, grounds: Grounds
) -> DecisionRow:
    """The decision as it is kept, with what was set aside until then."""
    before = find_surface_at(session, heliostat)
    row = DecisionRow(
        heliostat_id=heliostat.id,
        surface_id=surface.id,
        previous=None if before is None else before.version,
        taken=taken,
        made_by=actor,
        reason=grounds.reason,
        accuracy_before=grounds.before,
        accuracy_after=grounds.after,
        photographs=grounds.photographs,
        set_aside_before=_set_aside(session, heliostat),
    )
    session.add(row)
    action = "surface.taken" if taken else "surface.set_aside"
    about = {"version": surface.version, "previous": row.previous, "reason": grounds.reason}
    audit.record(session, actor, action, f"heliostat {heliostat.name}", **about)
    return row


def take(session: Session, heliostat: HeliostatRow, surface: SurfaceRow, actor: str, grounds: Grounds) -> DecisionRow:
    """Make a version today's: those that would go before it are set aside."""
    hold(session, HeliostatRow, heliostat.id, f"heliostat {heliostat.name}")
    row = _note(session, heliostat, surface, True, actor, grounds)
    place = tuple_(SurfaceRow.valid_from, SurfaceRow.version)
    later = select(SurfaceRow).where(SurfaceRow.heliostat_id == heliostat.id)
    for other in session.scalars(later.where(place > tuple_(surface.valid_from, surface.version))):
        other.set_aside = True
    surface.set_aside = False
    session.flush()
    return row


def keep_aside(
    session: Session, heliostat: HeliostatRow, surface: SurfaceRow, actor: str, grounds: Grounds
) -> DecisionRow:
    """Leave today's surface in its place: this version waits aside until somebody takes it."""
    row = _note(session, heliostat, surface, False, actor, grounds)
    surface.set_aside = True
    session.flush()
    return row


def undo(session: Session, heliostat: HeliostatRow, actor: str) -> DecisionRow:
    """Take `find_undoable` back: what was today's before it is so again. Undone again, it is as it was.

    Raises
    ------
    ConflictError
        Where there is none.
    """
    hold(session, HeliostatRow, heliostat.id, f"heliostat {heliostat.name}")
    last = find_undoable(session, heliostat)
    if last is None or last.previous is None:
        raise ConflictError(f"heliostat {heliostat.name}: no decision took another surface's place; choose a version")
    of_heliostat = select(SurfaceRow).where(SurfaceRow.heliostat_id == heliostat.id)
    rows = {row.version: row for row in session.scalars(of_heliostat)}
    back = _note(session, heliostat, rows[last.previous], True, actor, Grounds(f"took back: {last.reason}"[:200]))
    for version, row in rows.items():
        # What came since the decision stands as it is.
        if row.created_at <= last.made_at:
            row.set_aside = version in last.set_aside_before
    session.flush()
    return back


def see(session: Session, heliostat: HeliostatRow, surface: SurfaceRow, actor: str) -> None:
    """Note that somebody has seen that a surface is not trusted; the first who did stays.

    Raises
    ------
    ConflictError
        Where there is no doubt in it.
    """
    if not surface.doubts:
        raise ConflictError(f"heliostat {heliostat.name}: nothing is doubted of surface {surface.version}")
    if surface.seen_by is None:
        surface.seen_at, surface.seen_by = now(), actor
        audit.record(session, actor, "surface.seen", f"heliostat {heliostat.name}", version=surface.version)


def list_decisions(session: Session, heliostat: HeliostatRow, limit: int) -> Sequence[DecisionRow]:
    """The last ``limit`` decisions on a heliostat's surface, the last one first."""
    query = select(DecisionRow).where(DecisionRow.heliostat_id == heliostat.id)
    return session.scalars(query.order_by(DecisionRow.id.desc()).limit(limit)).all()


def find_undoable(session: Session, heliostat: HeliostatRow) -> DecisionRow | None:
    """The last decision that changed today's surface, whatever was set aside since; None where nothing can be undone.

    Nor can it where today's surface is not the one that it took: one that was measured came since, say.
    """
    query = select(DecisionRow).join(SurfaceRow).where(DecisionRow.heliostat_id == heliostat.id, DecisionRow.taken)
    query = query.where(DecisionRow.previous.is_not(None), DecisionRow.previous != SurfaceRow.version)
    last, today = session.scalar(query.order_by(DecisionRow.id.desc()).limit(1)), find_surface_at(session, heliostat)
    return last if last is not None and today is not None and last.surface_id == today.id else None
