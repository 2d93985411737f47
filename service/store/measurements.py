"""Images and measurements, as they are kept and found again."""

from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import Select, select
from sqlalchemy.orm import Session, undefer

from service.base import names
from service.base.faults import ConflictError, NotFoundError
from service.store import sizes
from service.store.columns import now
from service.store.rows import ROUNDS, hold, insert
from service.store.tables import HeliostatRow, ImageRow, MeasurementRow, TargetRow

# Which image of a measurement to use where there are several: separated ones first, for they need no guess.
PREFERENCE = ("flux", "cropped", "raw", "flux-centered")


EXCLUDED = "excluded"
"""Why a photograph is not accepted that somebody excluded."""


def _measurements(heliostat: HeliostatRow) -> Select[MeasurementRow]:
    return select(MeasurementRow).where(MeasurementRow.heliostat_id == heliostat.id)


def find_measurement_of_image(
    session: Session, heliostat: HeliostatRow, sha256: str, kind: str
) -> MeasurementRow | None:
    """The measurement that this image of this kind already is, or None."""
    query = _measurements(heliostat).where(MeasurementRow.image_sha256 == sha256, MeasurementRow.kind == kind)
    return session.scalar(query)


def find_measurement(session: Session, heliostat: HeliostatRow, identifier: str) -> MeasurementRow | None:
    """The measurement of this identifier, or None."""
    return session.scalar(_measurements(heliostat).where(MeasurementRow.identifier == identifier))


def get_measurement(session: Session, heliostat: HeliostatRow, identifier: str, arrays: bool = False) -> MeasurementRow:
    """The measurement of this identifier, with its ``arrays`` where wanted; NotFoundError where there is none."""
    query = _measurements(heliostat).where(MeasurementRow.identifier == identifier)
    row = session.scalar(query.options(undefer(MeasurementRow.arrays)) if arrays else query)
    if row is None:
        raise NotFoundError(f"heliostat {heliostat.name} has no measurement {identifier}")
    return row


def get_measurements(
    session: Session, heliostat: HeliostatRow, identifiers: Sequence[str], arrays: bool = False
) -> list[MeasurementRow]:
    """The measurements of these identifiers, in this order, by one query; else as `get_measurement`."""
    query = _measurements(heliostat).where(MeasurementRow.identifier.in_(identifiers))
    found = session.scalars(query.options(undefer(MeasurementRow.arrays)) if arrays else query)
    rows = {row.identifier: row for row in found}
    for identifier in identifiers:
        if identifier not in rows:
            raise NotFoundError(f"heliostat {heliostat.name} has no measurement {identifier}")
    return [rows[identifier] for identifier in identifiers]


def list_identifiers(session: Session, heliostat: HeliostatRow) -> Sequence[str]:
    """The identifiers of all its measurements, in the order they came."""
    query = select(MeasurementRow.identifier).where(MeasurementRow.heliostat_id == heliostat.id)
    return session.scalars(query.order_by(MeasurementRow.id)).all()


def list_measurements(
    session: Session, heliostat: HeliostatRow, limit: int | None, after: str | None = None, accepted: bool | None = None
) -> Sequence[MeasurementRow]:
    """Up to ``limit`` measurements, or all, in the order they came, those after the one called ``after``."""
    query = _measurements(heliostat).order_by(MeasurementRow.id).limit(limit)
    if accepted is not None:
        query = query.where(MeasurementRow.accepted == accepted)
    if after is not None:
        query = query.where(MeasurementRow.id > get_measurement(session, heliostat, after).id)
    return session.scalars(query).all()


def images_of_shot(session: Session, row: MeasurementRow, arrays: bool = False) -> dict[str, MeasurementRow]:
    """The images of the photograph that ``row`` is one of, by kind, with their ``arrays`` where wanted."""
    if row.external_id is None:
        return {row.kind: row}
    query = select(MeasurementRow).where(
        MeasurementRow.heliostat_id == row.heliostat_id, MeasurementRow.external_id == row.external_id
    )
    query = query.order_by(MeasurementRow.id).options(undefer(MeasurementRow.arrays)) if arrays else query
    return {one.kind: one for one in session.scalars(query)}


def _is_excluded(session: Session, heliostat: HeliostatRow, row: MeasurementRow) -> bool:
    """Whether somebody excluded the photograph that an image, yet to be stored, is another one of."""
    if row.external_id is None:
        return False
    query = _measurements(heliostat).where(MeasurementRow.external_id == row.external_id)
    return session.scalar(query.where(MeasurementRow.reason == EXCLUDED).limit(1)) is not None


def recent_measurements(
    session: Session,
    heliostat: HeliostatRow,
    limit: int,
    since: datetime | None = None,
    until: datetime | None = None,
) -> list[MeasurementRow]:
    """The newest accepted measurements, one image of each, by when they were taken or else came."""
    moment = MeasurementRow.moment
    query = _measurements(heliostat).where(MeasurementRow.accepted, MeasurementRow.arrays.is_not(None))
    if since is not None:
        query = query.where(moment >= since)
    if until is not None:
        query = query.where(moment < until)
    # Images of the same measurement in another kind show the same spot again, hence the longer list.
    query = query.order_by(moment.desc(), MeasurementRow.id.desc()).limit(len(PREFERENCE) * limit)
    best: dict[str, MeasurementRow] = {}
    for row in session.scalars(query):
        key = row.external_id or row.identifier
        if key not in best or PREFERENCE.index(row.kind) < PREFERENCE.index(best[key].kind):
            best[key] = row
    return list(best.values())[:limit]


def _free_identifier(session: Session, heliostat: HeliostatRow, row: MeasurementRow) -> str:
    """Its own identifier; with the kind appended where another kind of image of the same measurement has it."""
    wanted = row.external_id or row.image_sha256[:16]
    for identifier in (wanted, f"{wanted}-{row.kind}"):
        holder = find_measurement(session, heliostat, identifier)
        if holder is None:
            return identifier
        if holder.kind == row.kind:
            break
    raise ConflictError(f"id: measurement {wanted} of heliostat {heliostat.name} has another {row.kind} image already")


def use_image(session: Session, image: ImageRow, accepted: bool, is_new: bool) -> None:
    """Keep an image's row in step with a new measurement of it, and the totals with the row."""
    if is_new:
        sizes.count(session, accepted, 1, image.size_bytes)
    elif image.pruned_at is not None:  # it came again, and with something new; whoever brought it has the file
        image.accepted |= accepted
        image.pruned_at = image.pruned_for = image.removed_at = None
        image.created_at = now()
        sizes.count(session, image.accepted, 1, image.size_bytes)
    elif accepted and not image.accepted:
        image.accepted = True
        sizes.count(session, False, -1, -image.size_bytes)
        sizes.count(session, True, 1, image.size_bytes)


def _keep_image(session: Session, image: ImageRow, accepted: bool) -> tuple[ImageRow, bool]:
    """The image's row, locked against its file's removal until the transaction ends, and whether it is new."""
    held = session.get(ImageRow, image.sha256, with_for_update=True)
    if held is not None:
        return held, False
    image.accepted = accepted
    if insert(session, image):
        return image, True
    return session.get_one(ImageRow, image.sha256, with_for_update=True), False


def add_measurement(
    session: Session, heliostat: HeliostatRow, image: ImageRow, row: MeasurementRow
) -> tuple[MeasurementRow, bool]:
    """Store a measurement of ``image`` once, under an identifier that is free; of an excluded photograph excluded.

    The second value is False where this image of this kind was there already; the first is then the row that was.

    Raises
    ------
    ConflictError
        Where the given id belongs to another image of the same kind.
    InvalidInputError
        Where the given id is no good name.
    NotFoundError
        Where heliostat or target were deleted since they were read.
    """
    if row.external_id is not None:
        names.require(names.IDENTIFIER, row.external_id, "id")
    hold(session, HeliostatRow, heliostat.id, f"heliostat {heliostat.name}")
    hold(session, TargetRow, row.target_id, "its target")
    if _is_excluded(session, heliostat, row):
        row.accepted, row.reason = False, EXCLUDED
    image, is_new = _keep_image(session, image, row.accepted)
    row.heliostat_id, row.image_sha256 = heliostat.id, image.sha256
    for _ in range(ROUNDS):
        existing = find_measurement_of_image(session, heliostat, image.sha256, row.kind)
        if existing is not None:
            return existing, False
        row.identifier = _free_identifier(session, heliostat, row)
        if insert(session, row):
            use_image(session, image, row.accepted, is_new)
            session.refresh(row, ["target", "image"])
            return row, True
    raise ConflictError("too many writers on the same measurement; try again")
