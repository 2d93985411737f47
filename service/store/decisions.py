"""Decisions which surface version is active: who made them, why, and how to undo them."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.base.errors import ConflictError
from service.store import audit
from service.store.columns import EPOCH, now
from service.store.listing import NEWEST_FIRST, select_after
from service.store.plant import get_heliostat
from service.store.rows import lock_heliostat
from service.store.surface_versions import find_surface_at, get_surface
from service.store.tables import DecisionRow, HeliostatRow, SurfaceRow


@dataclass(frozen=True)
class Justification:
    """Why a version became active, or did not.

    ``before`` and ``after`` are mean flux accuracies [1] of the active surface and of the new one,
    on ``photographs`` photographs. They are None if nothing was compared.
    """

    reason: str
    before: float | None = None
    after: float | None = None
    photographs: int = 0

    @property
    def gain(self) -> float:
        """Gain of accuracy [1]; zero if nothing was compared."""
        return 0.0 if self.before is None or self.after is None else self.after - self.before


def _candidate_ids(session: Session, heliostat: HeliostatRow) -> list[int]:
    query = select(SurfaceRow.version).where(
        SurfaceRow.heliostat_id == heliostat.id, SurfaceRow.is_candidate
    )
    return list(session.scalars(query.order_by(SurfaceRow.version)))


def _record(
    session: Session,
    heliostat: HeliostatRow,
    surface: SurfaceRow,
    became_active: bool,
    actor: str,
    grounds: Justification,
) -> DecisionRow:
    """Store a decision, with the candidates until then."""
    before = find_surface_at(session, heliostat)
    row = DecisionRow(
        heliostat_id=heliostat.id,
        surface_id=surface.id,
        previous=None if before is None else before.version,
        became_active=became_active,
        created_by=actor,
        reason=grounds.reason,
        accuracy_before=grounds.before,
        accuracy_after=grounds.after,
        photographs=grounds.photographs,
        candidates_before=_candidate_ids(session, heliostat),
    )
    session.add(row)
    action = "surface.promoted" if became_active else "surface.rejected"
    about = {"version": surface.version, "previous": row.previous, "reason": grounds.reason}
    audit.record(session, actor, action, f"heliostat {heliostat.name}", **about)
    return row


def _sort_key(row: SurfaceRow) -> tuple[datetime, int]:
    """Sort key of a version, in the order of
    `service.store.surface_versions.newest_first`.
    """
    return row.valid_from or EPOCH, row.version


def apply_decision(
    session: Session,
    heliostat: HeliostatRow,
    surface: SurfaceRow,
    became_active: bool,
    actor: str,
    grounds: Justification,
) -> DecisionRow:
    """Make a version active, or a candidate until somebody promotes it.

    Versions that would take precedence over a new active one become candidates.
    """
    lock_heliostat(session, heliostat)
    row = _record(session, heliostat, surface, became_active, actor, grounds)
    if became_active:
        of_heliostat = select(SurfaceRow).where(SurfaceRow.heliostat_id == heliostat.id)
        for other in session.scalars(of_heliostat):
            other.is_candidate = other.is_candidate or _sort_key(other) > _sort_key(surface)
    surface.is_candidate = not became_active
    session.flush()
    return row


def decide(
    session: Session,
    name: str,
    version: int,
    became_active: bool,
    actor: str,
    grounds: Justification,
    shown: int | None = None,
) -> DecisionRow:
    """Make a version of a heliostat active, or keep the active one instead of this candidate.

    Raises
    ------
    NotFoundError
        If there is no such heliostat or version.
    ConflictError
        If the version to reject is no candidate, or as in `undo_decision`.
    """
    heliostat = get_heliostat(session, name)
    lock_heliostat(session, heliostat)
    _require_active(session, heliostat, shown)
    surface = get_surface(session, heliostat, version)
    if not (became_active or surface.is_candidate):
        raise ConflictError(f"version {version} of {name} is no candidate; reload the page")
    return apply_decision(session, heliostat, surface, became_active, actor, grounds)


def _require_active(session: Session, heliostat: HeliostatRow, shown: int | None) -> None:
    """Require that the version ``shown`` is active, 0 for none; None requires nothing."""
    active = find_surface_at(session, heliostat)
    version = 0 if active is None else active.version
    if shown in (None, version):
        return
    query = select(DecisionRow).where(DecisionRow.heliostat_id == heliostat.id)
    last = session.scalar(query.order_by(DecisionRow.id.desc()).limit(1))
    by = "" if last is None else f" by {last.created_by} ({last.reason})"
    raise ConflictError(
        f"heliostat {heliostat.name}: the active surface was changed from version {shown} to"
        f" {version}{by} since it was read; read it again before you decide"
    )


def undo_decision(
    session: Session,
    heliostat: HeliostatRow,
    actor: str,
    shown: int | None = None,
    decision: int | None = None,
) -> DecisionRow:
    """Undo the decision of `find_undoable`, so that the previous surface is active again.

    A second undo reverses the first. ``shown`` is the version that was active when it was read, and
    ``decision`` the number of the decision to undo; None requires nothing.

    Raises
    ------
    ConflictError
        If there is no such decision, or another surface is active.
    """
    lock_heliostat(session, heliostat)
    _require_active(session, heliostat, shown)
    last = find_undoable(session, heliostat)
    if last is not None and decision not in (None, last.id):
        raise ConflictError(
            f"heliostat {heliostat.name}: {last.created_by} decided on version"
            f" {last.surface.version} since ({last.reason}); reload the page before you undo"
        )
    if last is None or last.previous is None:
        raise ConflictError(
            f"heliostat {heliostat.name}: no decision took another surface's place; choose a"
            " version"
        )
    of_heliostat = select(SurfaceRow).where(SurfaceRow.heliostat_id == heliostat.id)
    rows = {row.version: row for row in session.scalars(of_heliostat)}
    back = _record(
        session,
        heliostat,
        rows[last.previous],
        True,
        actor,
        Justification(f"took back: {last.reason}"[:200]),
    )
    for version, row in rows.items():
        # Versions that are newer than the decision keep their state.
        if row.created_at <= last.created_at:
            row.is_candidate = version in last.candidates_before
    session.flush()
    return back


def acknowledge_warnings(
    session: Session, heliostat: HeliostatRow, surface: SurfaceRow, actor: str
) -> None:
    """Record that ``actor`` has seen a surface's warnings. An earlier record remains.

    Raises
    ------
    ConflictError
        If the surface has no warnings.
    """
    if not surface.warnings:
        raise ConflictError(
            f"heliostat {heliostat.name}: surface {surface.version} has no warnings to acknowledge"
        )
    if surface.acknowledged_by is None:
        surface.acknowledged_at, surface.acknowledged_by = now(), actor
        subject = f"heliostat {heliostat.name}"
        audit.record(session, actor, "surface.acknowledged", subject, version=surface.version)


def forget_acknowledgement(
    session: Session, heliostat: HeliostatRow, surface: SurfaceRow, actor: str
) -> None:
    """Undo `acknowledge_warnings`."""
    if surface.acknowledged_by is not None:
        surface.acknowledged_at = surface.acknowledged_by = None
        subject = f"heliostat {heliostat.name}"
        audit.record(session, actor, "surface.unacknowledged", subject, version=surface.version)


def list_decisions(
    session: Session, heliostat: HeliostatRow, limit: int, after: int | None = None
) -> Sequence[DecisionRow]:
    """Up to ``limit`` decisions on a heliostat's surfaces before ``after``, newest first."""
    query = select(DecisionRow).where(DecisionRow.heliostat_id == heliostat.id).limit(limit)
    return session.scalars(select_after(session, query, DecisionRow, NEWEST_FIRST, after)).all()


def is_undecided(session: Session, candidate: SurfaceRow) -> bool:
    """Whether nobody decided on a candidate after the decision with which it was stored."""
    query = select(DecisionRow.id).where(DecisionRow.surface_id == candidate.id).limit(2)
    return len(session.scalars(query).all()) < 2


def find_undecided(
    session: Session, heliostat: HeliostatRow, epoch_since: datetime
) -> SurfaceRow | None:
    """The newest candidate of an epoch, if nobody decided on it."""
    query = select(SurfaceRow).where(
        SurfaceRow.heliostat_id == heliostat.id,
        SurfaceRow.is_candidate,
        SurfaceRow.epoch_since == epoch_since,
    )
    row = session.scalar(query.order_by(SurfaceRow.version.desc()).limit(1))
    return row if row is not None and is_undecided(session, row) else None


def find_comparison(
    session: Session, surface: SurfaceRow, other: SurfaceRow | None
) -> Justification | None:
    """The last comparison of a version with another one, or with the ideal mirror for None."""
    query = select(DecisionRow).where(
        DecisionRow.heliostat_id == surface.heliostat_id, DecisionRow.photographs > 0
    )
    second = None if other is None else other.version
    for row in session.scalars(query.order_by(DecisionRow.id.desc())):
        reason, before, after = row.reason, row.accuracy_before, row.accuracy_after
        if (row.previous, row.surface.version) == (surface.version, second):
            reason, before, after = f"version {second} {reason}", after, before
        elif (row.previous, row.surface.version) != (second, surface.version):
            continue
        return Justification(reason, before, after, row.photographs)
    return None


def find_undoable(session: Session, heliostat: HeliostatRow) -> DecisionRow | None:
    """The last decision that changed the active surface; None if nothing can be undone.

    Later candidates do not matter. Nothing can be undone if the active surface is not the one that
    the decision promoted, for example because a measured surface arrived since.
    """
    query = (
        select(DecisionRow)
        .join(SurfaceRow)
        .where(DecisionRow.heliostat_id == heliostat.id, DecisionRow.became_active)
    )
    query = query.where(
        DecisionRow.previous.is_not(None), DecisionRow.previous != SurfaceRow.version
    )
    last, today = (
        session.scalar(query.order_by(DecisionRow.id.desc()).limit(1)),
        find_surface_at(session, heliostat),
    )
    return last if last is not None and today is not None and last.surface_id == today.id else None
