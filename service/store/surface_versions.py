"""Storage of surfaces by version."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Select, func, literal, or_, select
from sqlalchemy.orm import Session, undefer

from model.times import format_time
from service.base.arrays import pack, unpack
from service.base.errors import ConflictError, NotFoundError
from service.store.columns import EPOCH, UtcDateTime, now
from service.store.listing import EVER, Order, Period, select_after
from service.store.rows import ROUNDS, Added, insert, lock_heliostat
from service.store.tables import HeliostatRow, MeasurementRow, SurfaceRow

# Tolerance for equal heights [m]. Threads that sum in a different order differ by less.
_ALIKE_M = 1e-7


@dataclass(frozen=True)
class Trust:
    """Self-assessment of a prediction.

    ``warnings`` are warnings as sentences, none if it is trusted. ``suspicious`` names the
    measurements that it does not explain. ``mahalanobis_distance`` is its Mahalanobis distance.
    ``sun_span_deg`` is the largest angle between the sun directions of its photographs.
    """

    warnings: Sequence[str]
    suspicious: Sequence[str]
    mahalanobis_distance: float
    sun_span_deg: float


@dataclass(frozen=True, eq=False)
class NewSurface:
    """A surface to store as the next version.

    Attributes
    ----------
    source : one of measured, network, refined, imported
    z, z_std : (4, 8, 8) [m]
        Control heights and their standard deviation; zero if it is unknown.
    control_points : (4, 8, 8, 3) [m]
        In heliostat coordinates, including canting and facet positions.
    valid_from : datetime or None
        Since when it describes the mirror; None if unknown.
    model : str
        Name and hash of the network weights.
    model_version : str
        Version of the plant's model.
    measurements : rows of the measurements used
    misfit : float
    trust : Trust
        Of a prediction.
    epoch_since : datetime or None
        Since when photographs show this mirror; None if it never changed.
    """

    source: str
    z: NDArray[Any]
    z_std: NDArray[Any]
    control_points: NDArray[Any]
    valid_from: datetime | None = None
    model: str | None = None
    model_version: str | None = None
    measurements: Sequence[MeasurementRow] = field(default=())
    misfit: float | None = None
    trust: Trust | None = None
    epoch_since: datetime | None = None

    @property
    def content(self) -> str:
        """SHA-256 of its source and control points."""
        points = np.ascontiguousarray(self.control_points, dtype=np.float64)
        return hashlib.sha256(self.source.encode() + points.tobytes()).hexdigest()


def valid_since(row: type[SurfaceRow] = SurfaceRow) -> ColumnElement[datetime]:
    """Since when a version describes the mirror, for sorting. Unknown times come first."""
    return func.coalesce(row.valid_from, literal(EPOCH, UtcDateTime()))


def newest_first() -> Sequence[ColumnElement[Any]]:
    """Sort order of precedence: the first version is the active one."""
    return valid_since().desc(), SurfaceRow.version.desc()


def _surfaces(heliostat: HeliostatRow) -> Select[SurfaceRow]:
    return select(SurfaceRow).where(SurfaceRow.heliostat_id == heliostat.id)


def _surface_row(
    heliostat: HeliostatRow, version: int, new: NewSurface, content: str | None
) -> SurfaceRow:
    created, trust = now(), new.trust
    arrays = {"z": new.z, "z_std": new.z_std, "control_points": new.control_points}
    trusted = (
        {}
        if trust is None
        else {
            "trusted": not trust.warnings,
            "warnings": list(trust.warnings),
            "warned_since": created if trust.warnings else None,
            "suspicious": list(trust.suspicious),
            "mahalanobis_distance": trust.mahalanobis_distance,
            "sun_span_deg": trust.sun_span_deg,
        }
    )
    return SurfaceRow(
        **trusted,
        heliostat_id=heliostat.id,
        version=version,
        created_at=created,
        valid_from=new.valid_from,
        epoch_since=new.epoch_since,
        source=new.source,
        model=new.model,
        model_version=new.model_version,
        misfit=new.misfit,
        content_sha256=content,
        arrays=pack({name: np.asarray(array, np.float64) for name, array in arrays.items()}),
    )


def add_surface(
    session: Session, heliostat: HeliostatRow, new: NewSurface, once: bool = False
) -> Added[SurfaceRow]:
    """Store a surface as the heliostat's next version.

    With ``once`` (imports) the same control points from the same source are stored only once.

    Raises
    ------
    NotFoundError
        If the heliostat was deleted since it was read.
    """
    lock_heliostat(session, heliostat)
    content = new.content if once else None
    for _ in range(ROUNDS):
        if content is not None:
            existing = session.scalar(
                _surfaces(heliostat).where(SurfaceRow.content_sha256 == content)
            )
            if existing is not None:
                return Added(existing, False)
        last = session.scalar(
            select(func.max(SurfaceRow.version)).where(SurfaceRow.heliostat_id == heliostat.id)
        )
        row = _surface_row(heliostat, (last or 0) + 1, new, content)
        if insert(session, row):
            row.measurements = sorted(new.measurements, key=lambda measurement: measurement.id)
            return Added(row, True)
    raise ConflictError("too many writers on the same heliostat's surfaces; try again")


@dataclass(frozen=True)
class SurfaceFilter:
    """Filters of surface versions; None matches all. ``valid`` is the period of their start."""

    source: str | None = None
    trusted: bool | None = None
    is_candidate: bool | None = None
    valid: Period = EVER


def list_surfaces(
    session: Session,
    heliostat: HeliostatRow,
    limit: int | None,
    after: int | None = None,
    arrays: bool = False,
    filters: SurfaceFilter = SurfaceFilter(),
    order: Order = Order(),
) -> Sequence[SurfaceRow]:
    """Up to ``limit`` versions (None: all) after version ``after``, oldest first by default.

    ``arrays`` loads the arrays too.
    """
    row, query = SurfaceRow, _surfaces(heliostat).limit(limit)
    query = query.where(*filters.valid.conditions(row.valid_from))
    if arrays:
        query = query.options(undefer(row.arrays))
    for name in ("source", "trusted", "is_candidate"):
        value = getattr(filters, name)
        query = query if value is None else query.where(getattr(row, name) == value)
    last = None if after is None else get_surface(session, heliostat, after).id
    return session.scalars(select_after(session, query, SurfaceRow, order, last)).all()


def newest_prediction(session: Session, heliostat: HeliostatRow) -> SurfaceRow | None:
    """The newest predicted version, or None."""
    query = _surfaces(heliostat).where(SurfaceRow.trusted.is_not(None))
    return session.scalar(query.order_by(SurfaceRow.version.desc()).limit(1))


def find_same_content(
    session: Session, heliostat: HeliostatRow, new: NewSurface
) -> SurfaceRow | None:
    """A version from the same method and photographs with nearly equal heights, or None.

    Nearly equal means a difference below 0.1 um.
    """
    query = _surfaces(heliostat).where(
        SurfaceRow.source == new.source,
        SurfaceRow.model == new.model,
        SurfaceRow.model_version == new.model_version,
    )
    made_from = {row.id for row in new.measurements}
    for row in session.scalars(query.order_by(SurfaceRow.version.desc())):
        if made_from == {measurement.id for measurement in row.measurements}:
            found = get_surface(session, heliostat, row.version)
            if np.allclose(unpack(found.arrays)["z"], new.z, rtol=0, atol=_ALIKE_M):
                return found
    return None


def get_surface(session: Session, heliostat: HeliostatRow, version: int) -> SurfaceRow:
    """A version with its arrays; NotFoundError if there is none."""
    row = session.scalar(
        _surfaces(heliostat)
        .where(SurfaceRow.version == version)
        .options(undefer(SurfaceRow.arrays))
    )
    if row is None:
        raise NotFoundError(f"heliostat {heliostat.name} has no surface version {version}")
    return row


def find_measured_surface(session: Session, heliostat: HeliostatRow) -> SurfaceRow | None:
    """The newest measured (not predicted) version with its arrays, or None."""
    query = _surfaces(heliostat).where(SurfaceRow.source == "measured")
    return session.scalar(
        query.order_by(SurfaceRow.version.desc()).limit(1).options(undefer(SurfaceRow.arrays))
    )


def find_surface_at(
    session: Session, heliostat: HeliostatRow, moment: datetime | None = None
) -> SurfaceRow | None:
    """The version with its arrays that was valid at ``moment``, or None.

    It is the last one that starts before ``moment``; candidates do not count. Without a moment it
    is the last of all. This includes versions that start slightly in the future, because a camera's
    clock is fast or ours was set back.
    """
    query = _surfaces(heliostat).where(~SurfaceRow.is_candidate)
    if moment is not None:
        query = query.where(or_(SurfaceRow.valid_from.is_(None), SurfaceRow.valid_from <= moment))
    query = query.order_by(*newest_first()).limit(1)
    return session.scalar(query.options(undefer(SurfaceRow.arrays)))


def next_epoch(
    session: Session, heliostat: HeliostatRow, since: datetime | None
) -> datetime | None:
    """When the epoch of an active version began that follows the one ``since`` a time."""
    begun = SurfaceRow.epoch_since
    query = select(func.min(begun)).where(
        SurfaceRow.heliostat_id == heliostat.id, ~SurfaceRow.is_candidate, begun > (since or EPOCH)
    )
    return session.scalar(query)


def find_candidate(session: Session, heliostat: HeliostatRow) -> SurfaceRow | None:
    """The newest version with its arrays if the heliostat has only candidates, else None."""
    order = (SurfaceRow.is_candidate, SurfaceRow.valid_from.desc(), SurfaceRow.version.desc())
    query = _surfaces(heliostat).order_by(*order).limit(1).options(undefer(SurfaceRow.arrays))
    row = session.scalar(query)
    return row if row is not None and row.is_candidate else None


def current_surfaces(session: Session, heliostats: Sequence[int]) -> dict[int, bytes]:
    """Arrays of the active surfaces by heliostat id. Heliostats without a surface are missing."""
    newest = func.row_number().over(partition_by=SurfaceRow.heliostat_id, order_by=newest_first())
    candidates = select(SurfaceRow.id, newest.label("place")).where(
        SurfaceRow.heliostat_id.in_(heliostats)
    )
    ranked = candidates.where(~SurfaceRow.is_candidate).subquery()
    first = select(ranked.c.id).where(ranked.c.place == 1)
    rows = session.execute(
        select(SurfaceRow.heliostat_id, SurfaceRow.arrays).where(SurfaceRow.id.in_(first))
    )
    return {row.heliostat_id: row.arrays for row in rows}


def active_versions(session: Session) -> dict[int, int]:
    """Versions of all active surfaces by heliostat id."""
    place = func.row_number().over(partition_by=SurfaceRow.heliostat_id, order_by=newest_first())
    ranked = select(SurfaceRow.heliostat_id, SurfaceRow.version, place.label("place"))
    found = ranked.where(~SurfaceRow.is_candidate).subquery()
    query = select(found.c.heliostat_id, found.c.version).where(found.c.place == 1)
    return {row.heliostat_id: row.version for row in session.execute(query)}


@dataclass(frozen=True)
class Outdated:
    """An active surface whose prediction used another version of the plant's model.

    ``waits``: a prediction with the requested version exists, but is not active.
    """

    heliostat: str
    version: int
    source: str
    model_version: str | None
    waits: bool


def outdated_surfaces(session: Session, model_version: str) -> list[Outdated]:
    """Active surfaces whose predictions used another version of the plant's model, sorted by
    heliostat.
    """
    newest = func.row_number().over(partition_by=SurfaceRow.heliostat_id, order_by=newest_first())
    ranked = select(SurfaceRow.id, newest.label("place")).where(~SurfaceRow.is_candidate).subquery()
    of_version = select(SurfaceRow.heliostat_id).where(SurfaceRow.model_version == model_version)
    query = (
        select(
            HeliostatRow.name,
            SurfaceRow.version,
            SurfaceRow.source,
            SurfaceRow.model_version,
            SurfaceRow.heliostat_id.in_(of_version),
        )
        .join(ranked, ranked.c.id == SurfaceRow.id)
        .join(HeliostatRow, HeliostatRow.id == SurfaceRow.heliostat_id)
        .where(ranked.c.place == 1, SurfaceRow.model_version != model_version)
    )
    return [Outdated(*row) for row in session.execute(query.order_by(HeliostatRow.name))]


def get_surface_at(
    session: Session, heliostat: HeliostatRow, moment: datetime | None = None
) -> SurfaceRow:
    """The version valid at ``moment`` (default: now); NotFoundError if there is none."""
    row = find_surface_at(session, heliostat, moment)
    if row is not None:
        return row
    candidate = None if moment else find_candidate(session, heliostat)
    if candidate is not None:
        raise NotFoundError(
            f"heliostat {heliostat.name} has no active surface, version {candidate.version} is a"
            " candidate only; correct or exclude its photographs and predict again, or PUT to its"
            " surfaces/current"
        )
    when = f"at {format_time(moment)}" if moment else "yet"
    raise NotFoundError(
        f"heliostat {heliostat.name} has no surface {when}; POST to its surfaces to predict one"
    )
