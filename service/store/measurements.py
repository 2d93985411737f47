"""Storage of images and measurements."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import ColumnElement, Select, Text, cast, func, select
from sqlalchemy.orm import Session, undefer

from service.base import validation
from service.base.errors import ConflictError, NotFoundError
from service.store import sizes
from service.store.columns import now
from service.store.listing import EVER, Order, Period, select_after
from service.store.plant import get_target
from service.store.rows import ROUNDS, Added, insert, lock_heliostat, lock_row
from service.store.tables import (
    NO_IMAGE,
    AliasRow,
    HeliostatRow,
    ImageRow,
    MeasurementRow,
    TargetRow,
)

# Preferred kinds of a measurement's images. Separated images come first, because their flux needs
# no estimate.
PREFERENCE = ("flux", "cropped", "raw", "flux-centered", NO_IMAGE)


EXCLUDED = "excluded"
"""Reason of a photograph that somebody excluded."""


def _measurements(heliostat: HeliostatRow) -> Select[MeasurementRow]:
    return select(MeasurementRow).where(MeasurementRow.heliostat_id == heliostat.id)


def find_measurement_of_image(
    session: Session, heliostat: HeliostatRow, sha256: str, kind: str
) -> MeasurementRow | None:
    """The measurement of this image and kind, or None."""
    query = _measurements(heliostat).where(
        MeasurementRow.image_sha256 == sha256, MeasurementRow.kind == kind
    )
    return session.scalar(query)


def find_known_image(
    session: Session, heliostat: HeliostatRow, sha256: str, kind: str, forced: bool = False
) -> MeasurementRow | None:
    """The heliostat's measurement of this image and kind; None if the image is new.

    Raises
    ------
    ConflictError
        If the heliostat has the same bytes as another kind, or another heliostat has them. The
        latter is allowed if ``forced``.
    """
    query = select(MeasurementRow, HeliostatRow.name).join(
        HeliostatRow, HeliostatRow.id == MeasurementRow.heliostat_id
    )
    found = session.execute(
        query.where(MeasurementRow.image_sha256 == sha256).order_by(MeasurementRow.id)
    ).all()
    here = [row for row, _ in found if row.heliostat_id == heliostat.id]
    same = next((row for row in here if row.kind == kind), None)
    if same is not None:
        return same
    if here:
        address = f"/v1/heliostats/{heliostat.name}/measurements/{here[0].identifier}"
        raise ConflictError(
            f"kind: {here[0].kind} is stored, {kind} was sent. The image is known already as"
            f" {address}; if its kind is wrong there, DELETE {address}?only_this=true&reason=..."
            " and post it again"
            # A forced measurement already declares that both have the image.
        )
    others = [(row, name) for row, name in found if row.forced is None]
    if others and not forced:
        row, name = others[0]
        address = f"/v1/heliostats/{name}/measurements/{row.identifier}"
        raise ConflictError(
            f"image: heliostat {name} has it already as {address}. If it is not of {name}, DELETE"
            f" {address}?reason=... "
            f'and post it again; if both have the same image, add "force": true and a "reason"'
        )
    return None


def find_measurement(
    session: Session, heliostat: HeliostatRow, identifier: str, arrays: bool = False
) -> MeasurementRow | None:
    """The measurement of this identifier or alias, with its ``arrays`` on request, or None."""
    query = _measurements(heliostat)
    query = query.options(undefer(MeasurementRow.arrays)) if arrays else query
    row = session.scalar(query.where(MeasurementRow.identifier == identifier))
    if row is not None:
        return row
    alias = session.get(AliasRow, (heliostat.id, identifier))
    return (
        None
        if alias is None
        else session.scalar(query.where(MeasurementRow.id == alias.measurement_id))
    )


def get_measurement(
    session: Session, heliostat: HeliostatRow, identifier: str, arrays: bool = False
) -> MeasurementRow:
    """Like `find_measurement`, but NotFoundError if there is none."""
    row = find_measurement(session, heliostat, identifier, arrays)
    if row is None:
        raise NotFoundError(f"heliostat {heliostat.name} has no measurement {identifier}")
    return row


def get_measurements(
    session: Session, heliostat: HeliostatRow, identifiers: Sequence[str], arrays: bool = False
) -> list[MeasurementRow]:
    """The measurements of these identifiers in this order, in one query except for aliases.

    Raises
    ------
    NotFoundError
        If one does not exist.
    """
    query = _measurements(heliostat).where(MeasurementRow.identifier.in_(identifiers))
    found = session.scalars(query.options(undefer(MeasurementRow.arrays)) if arrays else query)
    rows = {row.identifier: row for row in found}
    for identifier in identifiers:
        if identifier not in rows:
            rows[identifier] = get_measurement(session, heliostat, identifier, arrays)
    return [rows[identifier] for identifier in identifiers]


def list_identifiers(session: Session, heliostat: HeliostatRow) -> Sequence[str]:
    """The identifiers of all measurements of a heliostat, in order of arrival."""
    query = select(MeasurementRow.identifier).where(MeasurementRow.heliostat_id == heliostat.id)
    return session.scalars(query.order_by(MeasurementRow.id)).all()


@dataclass(frozen=True)
class MeasurementFilter:
    """Filters of measurements; None matches all. ``taken`` is the period of their time."""

    accepted: bool | None = None
    kind: str | None = None
    target: str | None = None
    is_dated: bool | None = None
    is_warned: bool | None = None
    taken: Period = EVER


def list_measurements(
    session: Session,
    heliostat: HeliostatRow,
    limit: int | None,
    after: str | None = None,
    filters: MeasurementFilter = MeasurementFilter(),
    order: Order = Order(),
) -> Sequence[MeasurementRow]:
    """Up to ``limit`` measurements (None: all) after ``after``, in order of arrival by default."""
    row, query = MeasurementRow, _measurements(heliostat).limit(limit)
    query = query.where(*filters.taken.conditions(row.taken_at))
    if filters.accepted is not None:
        query = query.where(row.accepted == filters.accepted)
    if filters.kind is not None:
        query = query.where(row.kind == filters.kind)
    if filters.target is not None:
        query = query.where(row.target_id == get_target(session, filters.target).id)
    for is_known, column in ((filters.is_dated, row.taken_at), (filters.is_warned, row.warnings)):
        if is_known is not None:
            query = query.where(column.is_not(None) if is_known else column.is_(None))
    last = None if after is None else get_measurement(session, heliostat, after).id
    return session.scalars(select_after(session, query, MeasurementRow, order, last)).all()


def count_undated(session: Session) -> list[tuple[str, int]]:
    """Heliostats with photographs of unknown time, and how many, the most first."""
    row = MeasurementRow
    n = func.count(func.distinct(func.coalesce(row.external_id, row.identifier)))
    query = select(HeliostatRow.name, n).join(HeliostatRow, HeliostatRow.id == row.heliostat_id)
    query = query.where(row.taken_at.is_(None)).group_by(HeliostatRow.name)
    found = session.execute(query.order_by(n.desc(), HeliostatRow.name)).all()
    return [(name, count) for name, count in found]


def has_warning(type_: str) -> ColumnElement[bool]:
    """Condition that a measurement has a warning of this type."""
    return cast(MeasurementRow.warnings, Text).contains(f'"{type_}"')


def images_of_photograph(session: Session, row: MeasurementRow) -> dict[str, MeasurementRow]:
    """All images of the photograph of ``row`` by kind."""
    if row.external_id is None:
        return {row.kind: row}
    query = select(MeasurementRow).where(
        MeasurementRow.heliostat_id == row.heliostat_id,
        MeasurementRow.external_id == row.external_id,
    )
    return {one.kind: one for one in session.scalars(query)}


def _is_excluded(session: Session, heliostat: HeliostatRow, row: MeasurementRow) -> bool:
    """Whether the photograph of a new image was already excluded."""
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
    """The newest accepted photographs, one image each. Those without a time come last.

    A time range excludes photographs without a time.
    """
    moment = MeasurementRow.taken_at
    query = _measurements(heliostat).where(
        MeasurementRow.accepted, MeasurementRow.arrays.is_not(None)
    )
    query = query.where(*Period(since, until).conditions(moment))
    # Several kinds of images show the same photograph, so query more rows than needed.
    query = query.order_by(moment.desc().nulls_last(), MeasurementRow.id.desc()).limit(
        len(PREFERENCE) * limit
    )
    best: dict[str, MeasurementRow] = {}
    for row in session.scalars(query):
        key = row.external_id or row.identifier
        if key not in best or PREFERENCE.index(row.kind) < PREFERENCE.index(best[key].kind):
            best[key] = row
    return list(best.values())[:limit]


def _free_identifier(session: Session, heliostat: HeliostatRow, row: MeasurementRow) -> str:
    """A free identifier; the kind is appended if another kind of image has the identifier."""
    wanted = row.external_id or (row.image_sha256 or "")[:16]
    for identifier in (wanted, f"{wanted}-{row.kind}"):
        holder = find_measurement(session, heliostat, identifier)
        if holder is None:
            return identifier
        if holder.kind == row.kind:
            break
    raise ConflictError(
        f"id: {wanted} of heliostat {heliostat.name} has another {row.kind} image already; send"
        " this one's own id, or DELETE"
        f" /v1/heliostats/{heliostat.name}/measurements/{identifier}?reason=... if that one is"
        " wrong"
    )


def add_alias(
    session: Session, heliostat: HeliostatRow, row: MeasurementRow, external_id: str
) -> bool:
    """Add another identifier to a stored measurement; False if it had it already.

    It becomes the measurement's external id if there was none.

    Raises
    ------
    ConflictError
        If another image of the heliostat has this id.
    """
    validation.require_name(validation.IDENTIFIER, external_id, "id")
    holder = find_measurement(session, heliostat, external_id)
    if holder is row:
        return False
    alias = external_id
    if holder is not None and holder.kind != row.kind and row.external_id in (None, external_id):
        # Another kind of image of the same photograph has this id.
        alias = f"{external_id}-{row.kind}"
        holder = find_measurement(session, heliostat, alias)
        if holder is row:
            return False
    if holder is not None or not insert(
        session, AliasRow(heliostat_id=heliostat.id, identifier=alias, measurement_id=row.id)
    ):
        raise ConflictError(
            f"id: {external_id} is another image of heliostat {heliostat.name}; send this one's"
            " own id"
        )
    row.external_id = row.external_id or external_id
    if _is_excluded(session, heliostat, row):
        row.accepted, row.reason = False, EXCLUDED
    return True


def use_image(session: Session, image: ImageRow, accepted: bool, is_new: bool) -> None:
    """Update an image's row for a new measurement, and the totals."""
    if is_new:
        sizes.count(session, accepted, 1, image.size_bytes)
    # The image was deleted and arrived again with something new; its sender has the file.
    elif image.pruned_at is not None:
        image.accepted |= accepted
        image.pruned_at = image.pruned_for = image.removed_at = None
        image.created_at = now()
        sizes.count(session, image.accepted, 1, image.size_bytes)
    elif accepted and not image.accepted:
        image.accepted = True
        sizes.count(session, False, -1, -image.size_bytes)
        sizes.count(session, True, 1, image.size_bytes)


def _keep_image(session: Session, image: ImageRow, accepted: bool) -> Added[ImageRow]:
    """Lock the image's row against deletion of its file."""
    held = session.get(ImageRow, image.sha256, with_for_update=True)
    if held is not None:
        return Added(held, False)
    image.accepted = accepted
    if insert(session, image):
        return Added(image, True)
    return Added(session.get_one(ImageRow, image.sha256, with_for_update=True), False)


def _check_and_lock(session: Session, heliostat: HeliostatRow, row: MeasurementRow) -> None:
    """Check the id of a new measurement, and lock its heliostat and its target."""
    if row.external_id is not None:
        validation.require_name(validation.IDENTIFIER, row.external_id, "id")
    lock_heliostat(session, heliostat)
    lock_row(session, TargetRow, row.target_id, "its target")


def add_position(
    session: Session, heliostat: HeliostatRow, row: MeasurementRow
) -> Added[MeasurementRow]:
    """Store a measurement without an image once, or find it (`find_position`).

    Motor positions and focal spot of a photograph are stored with its image.

    Raises
    ------
    InvalidInputError
        For an invalid id.
    NotFoundError
        If the heliostat or target was deleted since it was read.
    """
    _check_and_lock(session, heliostat, row)
    row.heliostat_id, row.kind = heliostat.id, NO_IMAGE
    for _ in range(ROUNDS):
        existing = find_position(session, heliostat, row)
        if existing is not None:
            return Added(existing, False)
        if insert(session, row):
            session.refresh(row, ["target", "image"])
            return Added(row, True)
    raise ConflictError("too many writers on the same measurement; try again")


_POSITION = ("target_id", "sun_azimuth_deg", "sun_elevation_deg", "motor_axis_1", "motor_axis_2")


def find_position(
    session: Session, heliostat: HeliostatRow, new: MeasurementRow
) -> MeasurementRow | None:
    """The measurement of the same motor positions and focal spot as a ``new`` one; None without.

    ``new`` has the identifier that it would get: its id, or else a hash of what was sent. The id
    decides, and may also belong to a photograph. If either has no id, it is a measurement without
    an image with the same target, sun and motors, and the same or an unknown time. The hash of
    what was sent finds it even if it was corrected since.
    """
    row, query = MeasurementRow, _measurements(heliostat).order_by(MeasurementRow.id).limit(1)
    same = [getattr(row, name) == getattr(new, name) for name in _POSITION]
    if new.taken_at is not None:
        same.append(row.taken_at.is_(None) | (row.taken_at == new.taken_at))
    named = find_measurement(session, heliostat, new.identifier)
    if new.external_id is not None:
        named = named or session.scalar(query.where(row.external_id == new.external_id))
        same.append(row.external_id.is_(None))
    return named or session.scalar(query.where(row.kind == NO_IMAGE, *same))


def add_measurement(
    session: Session, heliostat: HeliostatRow, image: ImageRow, row: MeasurementRow
) -> Added[MeasurementRow]:
    """Store a measurement of ``image`` once, under a free identifier, or find that of its kind.

    It is excluded if its photograph is.

    Raises
    ------
    ConflictError
        If the id belongs to another image of the same kind, or as in `find_known_image`.
    InvalidInputError
        For an invalid id.
    NotFoundError
        If the heliostat or target was deleted since it was read.
    """
    _check_and_lock(session, heliostat, row)
    if _is_excluded(session, heliostat, row):
        row.accepted, row.reason = False, EXCLUDED
    image, is_new = _keep_image(session, image, row.accepted)
    row.heliostat_id, row.image_sha256 = heliostat.id, image.sha256
    for _ in range(ROUNDS):
        existing = find_known_image(
            session, heliostat, image.sha256, row.kind, row.forced is not None
        )
        if existing is not None:
            return Added(existing, False)
        row.identifier = _free_identifier(session, heliostat, row)
        if insert(session, row):
            use_image(session, image, row.accepted, is_new)
            session.refresh(row, ["target", "image"])
            return Added(row, True)
    raise ConflictError("too many writers on the same measurement; try again")
