"""Surfaces by version, as they are kept and found again."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session, undefer

from service.base.arrays import pack, unpack
from service.base.faults import ConflictError, NotFoundError
from service.store.columns import now
from service.store.rows import ROUNDS, hold, insert
from service.store.tables import HeliostatRow, MeasurementRow, SurfaceRow

# Heights that differ less [m] are the same: what threads that add up in another order make of them.
_ALIKE_M = 1e-7


@dataclass(frozen=True)
class Trust:
    """What a prediction says of itself.

    ``doubts`` are sentences, none where it is trusted; ``suspicious`` the measurements that it does not explain;
    ``strangeness`` its Mahalanobis distance; ``sun_span_deg`` the largest angle between the suns of its photographs.
    """

    doubts: tuple[str, ...]
    suspicious: tuple[str, ...]
    strangeness: float
    sun_span_deg: float


@dataclass(frozen=True, eq=False)
class NewSurface:
    """A surface to be stored as the next version.

    Attributes
    ----------
    source : one of measured, network, refined, imported
    z, z_std : (4, 8, 8) [m]
        Control heights and their standard deviation; zero where it is not known.
    control_points : (4, 8, 8, 3) [m]
        In heliostat coordinates, canting and facet position in them.
    valid_from : datetime
        From when it describes the mirror; without it, from now.
    model : str
        Name and hash of the weights that made it.
    model_version : str
        Version of the plant's model that it was made with.
    measurements : the rows that it was made from
    misfit : float
    trust : Trust
        Of a prediction.
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

    @property
    def content(self) -> str:
        """SHA-256 over its source and control points."""
        points = np.ascontiguousarray(self.control_points, dtype=np.float64)
        return hashlib.sha256(self.source.encode() + points.tobytes()).hexdigest()


def _surfaces(heliostat: HeliostatRow) -> Select[SurfaceRow]:
    return select(SurfaceRow).where(SurfaceRow.heliostat_id == heliostat.id)


def _surface_row(heliostat: HeliostatRow, version: int, new: NewSurface, content: str | None) -> SurfaceRow:
    created, trust = now(), new.trust
    arrays = {"z": new.z, "z_std": new.z_std, "control_points": new.control_points}
    told = (
        {}
        if trust is None
        else {
            "trusted": not trust.doubts,
            "doubts": list(trust.doubts),
            "doubted_since": created if trust.doubts else None,
            "suspicious": list(trust.suspicious),
            "strangeness": trust.strangeness,
            "sun_span_deg": trust.sun_span_deg,
        }
    )
    return SurfaceRow(
        **told,
        heliostat_id=heliostat.id,
        version=version,
        created_at=created,
        valid_from=new.valid_from or created,
        source=new.source,
        model=new.model,
        model_version=new.model_version,
        misfit=new.misfit,
        content_sha256=content,
        arrays=pack({name: np.asarray(array, np.float64) for name, array in arrays.items()}),
    )


def add_surface(
    session: Session, heliostat: HeliostatRow, new: NewSurface, once: bool = False
) -> tuple[SurfaceRow, bool]:
    """Store a surface as the heliostat's next version.

    With ``once`` (imports) the same control points from the same source are stored only the first time; the second
    value is False where they were there already. NotFoundError where the heliostat was deleted since it was read.
    """
    hold(session, HeliostatRow, heliostat.id, f"heliostat {heliostat.name}")
    content = new.content if once else None
    for _ in range(ROUNDS):
        if content is not None:
            existing = session.scalar(_surfaces(heliostat).where(SurfaceRow.content_sha256 == content))
            if existing is not None:
                return existing, False
        last = session.scalar(select(func.max(SurfaceRow.version)).where(SurfaceRow.heliostat_id == heliostat.id))
        row = _surface_row(heliostat, (last or 0) + 1, new, content)
        if insert(session, row):
            row.measurements = sorted(new.measurements, key=lambda measurement: measurement.id)
            return row, True
    raise ConflictError("too many writers on the same heliostat's surfaces; try again")


def list_surfaces(
    session: Session, heliostat: HeliostatRow, limit: int | None, after: int | None = None, arrays: bool = False
) -> Sequence[SurfaceRow]:
    """Up to ``limit`` versions, or all, oldest first, those after version ``after``, with ``arrays`` where wanted."""
    query = _surfaces(heliostat).order_by(SurfaceRow.version).limit(limit)
    if arrays:
        query = query.options(undefer(SurfaceRow.arrays))
    return session.scalars(query.where(SurfaceRow.version > after) if after else query).all()


def newest_prediction(session: Session, heliostat: HeliostatRow) -> SurfaceRow | None:
    """The version that was predicted last, or None."""
    query = _surfaces(heliostat).where(SurfaceRow.trusted.is_not(None))
    return session.scalar(query.order_by(SurfaceRow.version.desc()).limit(1))


def find_alike(session: Session, heliostat: HeliostatRow, new: NewSurface) -> SurfaceRow | None:
    """A version that was made in the same way from the same photographs and differs by less than 0.1 um, or None."""
    query = _surfaces(heliostat).where(
        SurfaceRow.source == new.source, SurfaceRow.model == new.model, SurfaceRow.model_version == new.model_version
    )
    made_from = {row.id for row in new.measurements}
    for row in session.scalars(query.order_by(SurfaceRow.version.desc())):
        if made_from == {measurement.id for measurement in row.measurements}:
            found = get_surface(session, heliostat, row.version)
            if np.allclose(unpack(found.arrays)["z"], new.z, rtol=0, atol=_ALIKE_M):
                return found
    return None


def get_surface(session: Session, heliostat: HeliostatRow, version: int) -> SurfaceRow:
    """A version with its arrays; NotFoundError where there is none."""
    row = session.scalar(_surfaces(heliostat).where(SurfaceRow.version == version).options(undefer(SurfaceRow.arrays)))
    if row is None:
        raise NotFoundError(f"heliostat {heliostat.name} has no surface version {version}")
    return row


def find_measured_surface(session: Session, heliostat: HeliostatRow) -> SurfaceRow | None:
    """The newest version, with its arrays, that was measured and not predicted, or None."""
    query = _surfaces(heliostat).where(SurfaceRow.source == "measured")
    return session.scalar(query.order_by(SurfaceRow.version.desc()).limit(1).options(undefer(SurfaceRow.arrays)))


def find_surface_at(session: Session, heliostat: HeliostatRow, moment: datetime | None = None) -> SurfaceRow | None:
    """The version, with its arrays, that was valid at ``moment``: the last to begin before it, or None.

    What is set aside does not count.
    Without a moment the last of all: what begins a little ahead, because a camera's clock is ahead of ours or ours was
    set back, is current too.
    """
    query = _surfaces(heliostat).where(~SurfaceRow.set_aside)
    if moment is not None:
        query = query.where(SurfaceRow.valid_from <= moment)
    query = query.order_by(SurfaceRow.valid_from.desc(), SurfaceRow.version.desc()).limit(1)
    return session.scalar(query.options(undefer(SurfaceRow.arrays)))


def current_surfaces(session: Session, heliostats: Sequence[int]) -> dict[int, bytes]:
    """The arrays of what `find_surface_at` has without a moment, by the heliostats' ids, of those that have one."""
    newest = func.row_number().over(
        partition_by=SurfaceRow.heliostat_id, order_by=(SurfaceRow.valid_from.desc(), SurfaceRow.version.desc())
    )
    candidates = select(SurfaceRow.id, newest.label("place")).where(SurfaceRow.heliostat_id.in_(heliostats))
    ranked = candidates.where(~SurfaceRow.set_aside).subquery()
    first = select(ranked.c.id).where(ranked.c.place == 1)
    rows = session.execute(select(SurfaceRow.heliostat_id, SurfaceRow.arrays).where(SurfaceRow.id.in_(first)))
    return {row.heliostat_id: row.arrays for row in rows}


@dataclass(frozen=True)
class Outdated:
    """A surface of today that was predicted by another version of the plant's model than one that is asked for.

    ``waits``: one that was made by that version is there, but is not today's.
    """

    heliostat: str
    version: int
    source: str
    model_version: str | None
    waits: bool


def outdated_surfaces(session: Session, model_version: str) -> list[Outdated]:
    """Today's surfaces that were predicted by another version of the plant's model, by their heliostats' names."""
    newest = func.row_number().over(
        partition_by=SurfaceRow.heliostat_id, order_by=(SurfaceRow.valid_from.desc(), SurfaceRow.version.desc())
    )
    ranked = select(SurfaceRow.id, newest.label("place")).where(~SurfaceRow.set_aside).subquery()
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


def get_surface_at(session: Session, heliostat: HeliostatRow, moment: datetime | None = None) -> SurfaceRow:
    """The version valid at ``moment``, by default now; NotFoundError where there is none."""
    row = find_surface_at(session, heliostat, moment)
    if row is None:
        when = f"at {moment.isoformat()}" if moment else "yet"
        raise NotFoundError(f"heliostat {heliostat.name} has no surface {when}; POST to its surfaces to predict one")
    return row
