"""Storage of calibrated mounts by version."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Select, and_, func, or_, select
from sqlalchemy.orm import Session, undefer

from service.base.errors import ConflictError, NotFoundError
from service.store.columns import now
from service.store.listing import Period
from service.store.measurements import EXCLUDED
from service.store.rows import ROUNDS, insert, lock_row
from service.store.tables import HeliostatRow, MeasurementRow, MountRow

_KINEMATICS = ("kinematics_properties", "kinematic_properties")


def _mounts(heliostat: HeliostatRow) -> Select[MountRow]:
    return select(MountRow).where(MountRow.heliostat_id == heliostat.id)


def add_mount(session: Session, heliostat: HeliostatRow, document: dict[str, Any]) -> MountRow:
    """Store a mount as the next version, valid from the start of its newest state.

    Raises
    ------
    NotFoundError
        If the heliostat was deleted since it was read.
    """
    lock_row(session, HeliostatRow, heliostat.id, f"heliostat {heliostat.name}")
    since = document["valid_from"]
    valid_from = None if since is None else datetime.fromisoformat(since)
    for _ in range(ROUNDS):
        newest = session.scalar(_mounts(heliostat).order_by(MountRow.version.desc()).limit(1))
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


def list_mounts(
    session: Session, heliostat: HeliostatRow, limit: int, after: int | None = None
) -> Sequence[MountRow]:
    """Up to ``limit`` versions after version ``after``, with documents, oldest first."""
    query = (
        _mounts(heliostat)
        .order_by(MountRow.version)
        .limit(limit)
        .options(undefer(MountRow.document))
    )
    return session.scalars(query.where(MountRow.version > after) if after else query).all()


def mounts_of_versions(session: Session, versions: Mapping[str, int]) -> dict[str, MountRow]:
    """The stored ones of some mounts, by heliostat; ``versions`` says which."""
    rows = session.execute(
        select(HeliostatRow.name, MountRow)
        .join(MountRow, MountRow.heliostat_id == HeliostatRow.id)
        .where(HeliostatRow.name.in_(versions))
    )
    return {name: mount for name, mount in rows if mount.version == versions[name]}


def find_mount_at(
    session: Session, heliostat: HeliostatRow, moment: datetime | None = None
) -> MountRow | None:
    """The newest version with its document that was valid at ``moment`` (default: now), or None."""
    query = _mounts(heliostat).where(
        or_(MountRow.valid_from.is_(None), MountRow.valid_from <= (moment or now()))
    )
    return session.scalar(
        query.order_by(MountRow.version.desc()).limit(1).options(undefer(MountRow.document))
    )


def get_mount_at(
    session: Session, heliostat: HeliostatRow, moment: datetime | None = None
) -> MountRow:
    """Like `find_mount_at`, but NotFoundError if there is none."""
    row = find_mount_at(session, heliostat, moment)
    if row is None:
        raise NotFoundError(
            f"heliostat {heliostat.name} has no calibrated mount; POST to /v1/jobs/calibrations"
            " first"
        )
    return row


def current_mounts(
    session: Session, names: Sequence[str] | None = None
) -> Sequence[tuple[HeliostatRow, MountRow]]:
    """Heliostats with their newest mounts and documents, sorted by name; by default all."""
    newest = select(func.max(MountRow.id)).group_by(MountRow.heliostat_id)
    if names is not None:
        of_names = select(HeliostatRow.id).where(HeliostatRow.name.in_(names))
        newest = newest.where(MountRow.heliostat_id.in_(of_names))
    query = select(HeliostatRow, MountRow).join(MountRow, MountRow.heliostat_id == HeliostatRow.id)
    query = (
        query.where(MountRow.id.in_(newest))
        .order_by(HeliostatRow.name)
        .options(undefer(MountRow.document))
    )
    return [(heliostat, mount) for heliostat, mount in session.execute(query)]


@dataclass(frozen=True)
class CalibrationState:
    """Summary of a heliostat's mount calibration.

    Attributes
    ----------
    name : str
    measurements : int
        Measurements used for the newest mount.
    newest : str or None
        Time of the last of them in ISO 8601 and UTC; None without a mount.
    """

    name: str
    measurements: int
    newest: str | None


def calibration_states(session: Session) -> list[CalibrationState]:
    """Calibration states of all heliostats whose drives are known, sorted by name.

    Only the needed parts of the JSON documents are read.
    """
    newest = select(func.max(MountRow.id)).group_by(MountRow.heliostat_id)
    document, properties = MountRow.document, HeliostatRow.properties
    # Older PAINT files use the other name.
    kinds = [properties[name]["actuators"][1]["type_axis"].as_string() for name in _KINEMATICS]
    of_any = properties["mount"]["drives"][1]["kind"].as_string()
    query = (
        select(HeliostatRow.name, document["measurements"].as_integer(), document["history"]["at"])
        .outerjoin(
            MountRow, and_(MountRow.heliostat_id == HeliostatRow.id, MountRow.id.in_(newest))
        )
        .where(or_(*(kind == "linear" for kind in kinds), of_any.is_not(None)))
        .order_by(HeliostatRow.name)
    )
    return [
        CalibrationState(name, count or 0, at[-1] if at else None)
        for name, count, at in session.execute(query)
    ]


def pointing_measurements(
    session: Session,
    heliostat: HeliostatRow,
    since: datetime | None = None,
    until: datetime | None = None,
) -> Sequence[MeasurementRow]:
    """Measurements of the focal spot for pointing calibration, one image each, without arrays.

    These are accepted measurements, and those whose sender gave the focal spot, without excluded
    ones. If a measurement has several images, the first is used. A time range excludes measurements
    without a time.
    """
    row, moment = MeasurementRow, MeasurementRow.taken_at
    first = select(func.min(row.id)).where(row.heliostat_id == heliostat.id)
    is_excluded = func.coalesce(row.reason, "") == EXCLUDED
    first = first.where(row.accepted | (row.focal_spot_wgs84.is_not(None) & ~is_excluded))
    query = select(row).where(
        row.id.in_(first.group_by(func.coalesce(row.external_id, row.identifier)))
    )
    query = query.where(*Period(since, until).conditions(moment))
    return session.scalars(query.order_by(row.id)).all()
