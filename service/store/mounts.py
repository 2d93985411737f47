"""Calibrated mounts by version, as they are kept and found again."""

from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session, undefer

from service.base.faults import ConflictError, NotFoundError
from service.store.columns import now
from service.store.rows import ROUNDS, hold, insert
from service.store.tables import HeliostatRow, MeasurementRow, MountRow


def _mounts(heliostat: HeliostatRow) -> Select[MountRow]:
    return select(MountRow).where(MountRow.heliostat_id == heliostat.id)


def add_mount(session: Session, heliostat: HeliostatRow, document: dict[str, Any]) -> MountRow:
    """Store a mount, valid from when its newest state began.

    It is the heliostat's next version, or takes the place of the newest where that is of the same state: versions grow
    with what happens to a mount, not with how often it is calibrated. NotFoundError where the heliostat was deleted
    since it was read.
    """
    hold(session, HeliostatRow, heliostat.id, f"heliostat {heliostat.name}")
    valid_from = datetime.fromisoformat(document["valid_from"])
    for _ in range(ROUNDS):
        newest = session.scalar(_mounts(heliostat).order_by(MountRow.version.desc()).limit(1))
        if newest is not None and newest.valid_from == valid_from:
            newest.document, newest.created_at = document, now()
            return newest
        row = MountRow(
            heliostat_id=heliostat.id,
            version=1 if newest is None else newest.version + 1,
            created_at=now(),
            valid_from=valid_from,
            document=document,
        )
        if insert(session, row):
            return row
    raise ConflictError("too many writers on the same heliostat's mounts; try again")


def list_mounts(session: Session, heliostat: HeliostatRow, limit: int, after: int | None = None) -> Sequence[MountRow]:
    """Up to ``limit`` versions with their documents, oldest first, those after version ``after``."""
    query = _mounts(heliostat).order_by(MountRow.version).limit(limit).options(undefer(MountRow.document))
    return session.scalars(query.where(MountRow.version > after) if after else query).all()


def find_mount_at(session: Session, heliostat: HeliostatRow, moment: datetime | None = None) -> MountRow | None:
    """The newest version whose state had begun at ``moment``, by default now, with its document; None without one."""
    query = _mounts(heliostat).where(MountRow.valid_from <= (moment or now()))
    return session.scalar(query.order_by(MountRow.version.desc()).limit(1).options(undefer(MountRow.document)))


def get_mount_at(session: Session, heliostat: HeliostatRow, moment: datetime | None = None) -> MountRow:
    """The same; NotFoundError where there is none."""
    row = find_mount_at(session, heliostat, moment)
    if row is None:
        raise NotFoundError(f"heliostat {heliostat.name} has no calibrated mount; POST to /v1/jobs/calibrations first")
    return row


def current_mounts(session: Session, names: Sequence[str] | None = None) -> Sequence[tuple[HeliostatRow, MountRow]]:
    """Heliostats with their newest mounts and documents, by name; all of the store where none is named."""
    newest = select(func.max(MountRow.id)).group_by(MountRow.heliostat_id)
    if names is not None:
        of_names = select(HeliostatRow.id).where(HeliostatRow.name.in_(names))
        newest = newest.where(MountRow.heliostat_id.in_(of_names))
    query = select(HeliostatRow, MountRow).join(MountRow, MountRow.heliostat_id == HeliostatRow.id)
    query = query.where(MountRow.id.in_(newest)).order_by(HeliostatRow.name).options(undefer(MountRow.document))
    return [(heliostat, mount) for heliostat, mount in session.execute(query)]


def pointing_measurements(
    session: Session, heliostat: HeliostatRow, since: datetime | None = None, until: datetime | None = None
) -> Sequence[MeasurementRow]:
    """Measurements that tell where light went, one image of each, without their arrays.

    Those that were accepted, or whose sender knew the spot. Of several images of a measurement the first stands.
    """
    row, moment = MeasurementRow, func.coalesce(MeasurementRow.taken_at, MeasurementRow.created_at)
    first = select(func.min(row.id)).where(row.heliostat_id == heliostat.id)
    first = first.where(row.accepted | row.focal_spot_wgs84.is_not(None))
    query = select(row).where(row.id.in_(first.group_by(func.coalesce(row.external_id, row.identifier))))
    if since is not None:
        query = query.where(moment >= since)
    if until is not None:
        query = query.where(moment < until)
    return session.scalars(query.order_by(row.id)).all()


def undated(session: Session, heliostat: HeliostatRow, identifiers: Sequence[str]) -> set[str]:
    """Those of these measurements that do not tell when they were taken."""
    row = MeasurementRow
    query = select(row.identifier).where(row.heliostat_id == heliostat.id, row.identifier.in_(identifiers))
    return set(session.scalars(query.where(row.taken_at.is_(None))))
