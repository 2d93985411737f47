"""The plant's geometry as it is set: each deed in the caller's transaction, with its entry in the audit trail.

A deed that changes nothing leaves no entry.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sqlalchemy.orm import Session

from model.plant import Cylinder, TargetPlane
from service import store
from service.sources.documents import read_heliostat
from service.store import Change, audit
from service.store.models import put_declared
from service.store.tables import HeliostatRow, ReceiverRow, TargetRow

Corners = dict[str, list[float]]
"""WGS84 corners of a target by their names."""


@dataclass(frozen=True)
class PlantChange:
    """What setting a plant did to each of its parts."""

    plant: Change
    declared: Change | None
    targets: dict[str, Change]
    receivers: dict[str, Change]


def set_plant(
    session: Session,
    actor: str,
    name: str,
    origin: ArrayLike,
    targets: Iterable[TargetPlane] = (),
    receivers: Iterable[Cylinder] = (),
    declared: dict[str, Any] | None = None,
    corners: Mapping[str, Corners] | None = None,
) -> PlantChange:
    """Set tower base (latitude [deg], longitude [deg], altitude [m]), targets, receivers and declared model at once.

    Raises
    ------
    ConflictError
        Where what is stored already forbids it: see the functions of `service.store`.
    """
    given = corners or {}
    change = PlantChange(
        store.put_plant(session, name, origin),
        put_declared(session, declared, actor) if declared else None,
        {plane.name: store.put_target(session, plane, given.get(plane.name))[1] for plane in targets},
        {cylinder.name: store.put_receiver(session, cylinder)[1] for cylinder in receivers},
    )
    parts = {
        "declared": change.declared,
        **{f"target {target}": made for target, made in change.targets.items()},
        **{f"receiver {receiver}": made for receiver, made in change.receivers.items()},
    }
    changed = {part: made for part, made in parts.items() if made not in (None, Change.UNCHANGED)}
    if changed or change.plant is not Change.UNCHANGED:
        audit.record(session, actor, "plant.set", f"plant {name}", change=change.plant, **changed)
    return change


def set_target(
    session: Session, actor: str, plane: TargetPlane, corners: Corners | None = None
) -> tuple[TargetRow, Change]:
    """Set a target plane; raises what `store.put_target` raises."""
    row, change = store.put_target(session, plane, corners)
    _note(session, actor, "target", plane.name, change)
    return row, change


def set_receiver(session: Session, actor: str, cylinder: Cylinder) -> tuple[ReceiverRow, Change]:
    """Set a cylindrical receiver; raises what `store.put_receiver` raises."""
    row, change = store.put_receiver(session, cylinder)
    _note(session, actor, "receiver", cylinder.name, change)
    return row, change


def set_heliostat(session: Session, actor: str, name: str, properties: dict[str, Any]) -> tuple[HeliostatRow, Change]:
    """Set a heliostat's PAINT properties.

    Raises
    ------
    InvalidInputError
        Where the model cannot read them: what is stored can be traced.
    """
    row, change = store.put_heliostat(session, name, properties, _position(session, name, properties))
    _note(session, actor, "heliostat", name, change)
    return row, change


def add_heliostat(session: Session, actor: str, name: str, properties: dict[str, Any]) -> tuple[HeliostatRow, Change]:
    """Add a heliostat; ConflictError where there is one of its name with other properties, else as `set_heliostat`."""
    row, change = store.add_heliostat(session, name, properties, _position(session, name, properties))
    _note(session, actor, "heliostat", name, change)
    return row, change


def remove(session: Session, actor: str, what: Literal["target", "receiver", "heliostat"], name: str) -> None:
    """Delete what was set by mistake; raises what `store.remove_target` raises."""
    _REMOVERS[what](session, name)
    audit.record(session, actor, f"{what}.deleted", f"{what} {name}")


_REMOVERS = {
    "target": store.remove_target,
    "receiver": store.remove_receiver,
    "heliostat": store.remove_heliostat,
}


def _position(session: Session, name: str, properties: dict[str, Any]) -> NDArray[np.float64]:
    store.one_at_a_time(session)  # the origin must not move between here and the row that stands upon it
    return read_heliostat(name, properties, np.array(store.get_plant(session).origin)).position


def _note(session: Session, actor: str, what: str, name: str, change: Change) -> None:
    if change is not Change.UNCHANGED:
        audit.record(session, actor, f"{what}.set", f"{what} {name}", change=change)
