"""Storage of the plant, its heliostats, targets and receivers."""

from collections.abc import Sequence

from numpy.typing import ArrayLike
from sqlalchemy import func, select
from sqlalchemy.orm import Session, defer

from model.locating import locator_from_json, locator_to_json
from model.plant import Receiver, TargetPlane, Tower
from service.base import validation
from service.base.errors import ConflictError, NotFoundError
from service.base.fields import JsonObject
from service.base.plant import (
    AnyReceiver,
    PlantFacts,
    receiver_from_json,
    receiver_to_json,
    rectangle,
)
from service.store.rows import Change, Put, assign, floats, insert, insert_or_find
from service.store.tables import HeliostatRow, MeasurementRow, PlantRow, ReceiverRow, TargetRow

_NEW_PLANT = "heliotwin.new_plant"


def find_plant(session: Session) -> PlantRow | None:
    """The plant, or None."""
    return session.get(PlantRow, 1)


def get_plant(session: Session) -> PlantRow:
    """The plant; ConflictError if it is not set."""
    plant = find_plant(session)
    if plant is None:
        raise ConflictError(
            "the plant is not set yet: PUT its PAINT tower measurements to /v1/plant, or import a"
            " folder"
        )
    return plant


def put_plant(session: Session, name: str, origin: ArrayLike) -> Change:
    """Set the plant's name and origin (latitude [deg], longitude [deg], altitude [m]).

    Raises
    ------
    ConflictError
        If heliostats or targets are already stored relative to another origin.
    """
    latitude, longitude, altitude = floats(origin)
    values = {
        "name": name,
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "altitude_m": altitude,
    }
    plant = session.get(PlantRow, 1)
    if plant is None:
        if insert(session, PlantRow(id=1, **values)):
            session.info[_NEW_PLANT] = True  # A session of `Database.writing` is one transaction.
            return Change.NEW
        plant = get_plant(session)
    require_origin(session, name, origin)
    return assign(plant, values)


def require_origin(session: Session, name: str, origin: ArrayLike) -> None:
    """Raise ConflictError if data are stored relative to another origin than that of plant
    ``name``.
    """
    plant = session.get(PlantRow, 1)
    if plant is not None and plant.origin != tuple(floats(origin)) and _has_positions(session):
        raise ConflictError(
            f"the plant's origin is fixed: heliostats or targets of {plant.name} are stored"
            f" relative to ({', '.join(f'{value:g}' for value in plant.origin)}), and {name} is at"
            f" ({', '.join(f'{value:g}' for value in floats(origin))}); take another store for"
            " another plant"
        )


def is_plant_new(session: Session) -> bool:
    """Whether the plant was created in this transaction. No result can depend on it then."""
    return bool(session.info.get(_NEW_PLANT))


def _has_positions(session: Session) -> bool:
    return any(
        session.scalar(select(table.id).limit(1)) is not None for table in (HeliostatRow, TargetRow)
    )


def find_heliostat(session: Session, name: str) -> HeliostatRow | None:
    """The heliostat of this name, or None."""
    return session.scalar(select(HeliostatRow).where(HeliostatRow.name == name))


def get_heliostat(session: Session, name: str) -> HeliostatRow:
    """The heliostat of this name; NotFoundError if there is none."""
    row = find_heliostat(session, name)
    if row is None:
        raise NotFoundError(f"there is no heliostat {name}; POST it to /v1/heliostats first")
    return row


def get_heliostats(session: Session, names: Sequence[str]) -> dict[str, HeliostatRow]:
    """The stored heliostats among ``names``, by name."""
    rows = session.scalars(select(HeliostatRow).where(HeliostatRow.name.in_(names)))
    return {row.name: row for row in rows}


def list_heliostats_near(
    session: Session, row: HeliostatRow, reach_m: float
) -> Sequence[HeliostatRow]:
    """Other heliostats in a square of ``reach_m`` [m] to each side of one, sorted by name."""
    return session.scalars(
        select(HeliostatRow)
        .where(HeliostatRow.east_m.between(row.east_m - reach_m, row.east_m + reach_m))
        .where(HeliostatRow.north_m.between(row.north_m - reach_m, row.north_m + reach_m))
        .where(HeliostatRow.id != row.id)
        .order_by(HeliostatRow.name)
    ).all()


def list_heliostats(
    session: Session,
    limit: int,
    after: str | None = None,
    prefix: str | None = None,
    search: str = "",
) -> Sequence[HeliostatRow]:
    """Up to ``limit`` heliostats after ``after``, sorted by name.

    Their names begin with ``prefix`` and contain ``search``, both case-insensitive.
    """
    query = (
        select(HeliostatRow)
        .options(defer(HeliostatRow.properties))
        .order_by(HeliostatRow.name)
        .limit(limit)
    )
    if prefix:
        query = query.where(HeliostatRow.name.istartswith(prefix, autoescape=True))
    if search:
        query = query.where(HeliostatRow.name.icontains(search, autoescape=True))
    return session.scalars(query.where(HeliostatRow.name > after) if after else query).all()


def require_same_properties(row: HeliostatRow, properties: dict[str, object]) -> None:
    """Raise ConflictError if ``properties`` differ from those of the stored heliostat."""
    if row.properties != properties:
        raise ConflictError(
            f"name: heliostat {row.name} exists with other properties; PUT them to change it"
        )


def put_heliostat(
    session: Session,
    name: str,
    properties: dict[str, object],
    position: ArrayLike,
    replace: bool = True,
) -> Put[HeliostatRow]:
    """Store a heliostat, or update it with ``replace``.

    It has PAINT ``properties`` and an ENU ``position`` (3,) [m].

    Raises
    ------
    InvalidInputError
        For an invalid name.
    ConflictError
        Without ``replace``, if a heliostat of this name has other properties, even from a
        concurrent writer.
    """
    validation.require_name(validation.NAME, name, "heliostat")
    east, north, up = floats(position)
    values = {"properties": properties, "east_m": east, "north_m": north, "up_m": up}
    row, is_new = insert_or_find(session, HeliostatRow(name=name, **values))
    if is_new:
        return Put(row, Change.NEW)
    if replace:
        return Put(row, assign(row, values))
    require_same_properties(row, properties)
    return Put(row, Change.UNCHANGED)


def find_target(session: Session, name: str) -> TargetRow | None:
    """The target of this name, or None."""
    return session.scalar(select(TargetRow).where(TargetRow.name == name))


def get_target(session: Session, name: str) -> TargetRow:
    """The target of this name; NotFoundError if there is none. The message lists the known ones."""
    row = find_target(session, name)
    if row is None:
        known = ", ".join(target.name for target in list_targets(session)) or "none yet"
        raise NotFoundError(f"there is no target {name}; known targets: {known}")
    return row


def list_targets(session: Session) -> Sequence[TargetRow]:
    """All targets, sorted by name."""
    return session.scalars(select(TargetRow).order_by(TargetRow.name)).all()


def count_photographs(session: Session) -> list[tuple[TargetRow, int]]:
    """All targets, sorted by name, with the number of their images."""
    counted = (
        select(TargetRow, func.count(MeasurementRow.id))
        .outerjoin(MeasurementRow)
        .group_by(TargetRow.id)
    )
    return [(row, count) for row, count in session.execute(counted.order_by(TargetRow.name))]


def put_target(
    session: Session, plane: TargetPlane, corners: dict[str, list[float]] | None = None
) -> Put[TargetRow]:
    """Store or update a target plane; ``corners`` are its WGS84 corners, if known.

    A stored locator remains if the plane declares none.

    Raises
    ------
    InvalidInputError
        For an invalid name.
    ConflictError
        If a receiver has this name.
    """
    validation.require_name(validation.NAME, plane.name, "target")
    if find_receiver(session, plane.name) is not None:
        raise ConflictError(
            f"name: {plane.name} is a receiver; choose another name for the target plane"
        )
    values: JsonObject = {
        "geometry": rectangle(plane),
        "corners": corners,
        "locator": None if plane.locator is None else locator_to_json(plane.locator),
    }
    row, is_new = insert_or_find(session, TargetRow(name=plane.name, **values))
    if is_new:
        return Put(row, Change.NEW)
    if row.geometry == values["geometry"]:
        values["corners"] = corners or row.corners
    values["locator"] = values["locator"] or row.locator
    return Put(row, assign(row, values))


def target_plane(row: TargetRow) -> TargetPlane:
    """Convert a stored target to the model's target plane."""
    locator = None if row.locator is None else locator_from_json(row.locator)
    return TargetPlane(row.name, **row.geometry, locator=locator)


def list_receivers(session: Session) -> Sequence[ReceiverRow]:
    """All receivers, sorted by name."""
    return session.scalars(select(ReceiverRow).order_by(ReceiverRow.name)).all()


def receivers_of_heliostats(session: Session) -> dict[str, str]:
    """Receivers that the layout gives heliostats to, by heliostat; by default the first one.

    Empty if all have one receiver, or there is none.
    """
    every = list(session.scalars(select(ReceiverRow.name).order_by(ReceiverRow.id)))
    own = HeliostatRow.properties["receiver"].as_string()
    given = {
        name: goal or next(iter(every), "")
        for name, goal in session.execute(
            select(HeliostatRow.name, own).order_by(HeliostatRow.name)
        )
    }
    return given if len(set(given.values()) & set(every)) > 1 else {}


def find_receiver(session: Session, name: str) -> ReceiverRow | None:
    """The receiver of this name, or None."""
    return session.scalar(select(ReceiverRow).where(ReceiverRow.name == name))


def get_receiver(session: Session, name: str) -> ReceiverRow:
    """The receiver of this name; NotFoundError if there is none."""
    row = find_receiver(session, name)
    if row is None:
        raise NotFoundError(f"there is no receiver {name}; PUT it to /v1/receivers/{name} first")
    return row


def put_receiver(session: Session, receiver: Receiver) -> Put[ReceiverRow]:
    """Store or update a receiver.

    Raises
    ------
    InvalidInputError
        For an invalid name, or a kind that cannot be stored.
    ConflictError
        If a target has this name.
    """
    validation.require_name(validation.NAME, receiver.name, "receiver")
    document = receiver_to_json(receiver)
    if find_target(session, receiver.name) is not None:
        raise ConflictError(
            f"name: {receiver.name} is a target plane; choose another name for the receiver"
        )
    values: JsonObject = {"kind": document.pop("kind"), "geometry": document}
    row, is_new = insert_or_find(session, ReceiverRow(name=receiver.name, **values))
    return Put(row, Change.NEW if is_new else assign(row, values))


def receiver_document(row: ReceiverRow) -> JsonObject:
    """A stored receiver as REST and exports have it, without its name."""
    return {"kind": row.kind, **row.geometry}


def stored_receiver(row: ReceiverRow) -> AnyReceiver:
    """Convert a stored receiver to the model's."""
    return receiver_from_json(row.name, receiver_document(row))


def get_target_or_receiver(session: Session, name: str) -> AnyReceiver:
    """The target plane or the receiver of this name; NotFoundError if there is neither."""
    row = find_receiver(session, name)
    return target_plane(get_target(session, name)) if row is None else stored_receiver(row)


def goals_of_heliostats(session: Session) -> dict[str, AnyReceiver]:
    """What heliostats may be canted to by name: receivers, then targets, the first stored first."""
    receivers = session.scalars(select(ReceiverRow).order_by(ReceiverRow.id))
    targets = session.scalars(select(TargetRow).order_by(TargetRow.id))
    return {row.name: stored_receiver(row) for row in receivers} | {
        row.name: target_plane(row) for row in targets
    }


def put_plant_facts(session: Session, facts: PlantFacts) -> Change:
    """Set what is known of the plant besides its geometry; what is None stays as it is."""
    return assign(
        get_plant(session),
        {name: value for name, value in facts.columns().items() if value is not None},
    )


def stored_tower(session: Session) -> Tower | None:
    """The plant's tower, if it is known."""
    known = get_plant(session).tower
    return None if known is None else Tower(known["radius_m"], known["height_m"])
