"""Set the plant's geometry, with an audit entry for each change.

All functions run in the caller's transaction. A call that changes nothing leaves no entry.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.plant import Plant, Receiver, TargetPlane
from service import store
from service.base.plant_facts import NO_FACTS, PlantFacts
from service.sources.documents import read_heliostat
from service.sources.heliostat_of_type import HeliostatOfType, document_of
from service.sources.paint_documents import Corners
from service.store import Change, audit
from service.store.plant.model_versions import put_declared
from service.store.rows import Put
from service.store.tables import HeliostatRow, ReceiverRow, TargetRow


@dataclass(frozen=True)
class PlantChange:
    """What setting a plant changed in each of its parts."""

    plant: Change
    declared: Change | None
    targets: dict[str, Change]
    receivers: dict[str, Change]


def set_plant(
    session: Session,
    actor: str,
    plant: Plant,
    declared: dict[str, object] | None = None,
    corners: Mapping[str, Corners] | None = None,
    facts: PlantFacts = NO_FACTS,
) -> PlantChange:
    """Set tower base, targets, receivers, declared model and other facts together.

    Raises
    ------
    ConflictError
        If stored data forbid it: see the functions of `service.store`.
    """
    placed = store.put_plant(session, plant.name, plant.origin)
    known = store.put_plant_facts(session, facts)
    change = PlantChange(
        known if placed is Change.UNCHANGED else placed,
        put_declared(session, declared, actor) if declared else None,
        {
            name: store.put_target(session, plane, (corners or {}).get(name)).change
            for name, plane in plant.targets.items()
        },
        {
            name: store.put_receiver(session, receiver).change
            for name, receiver in plant.receivers.items()
        },
    )
    parts = {
        "declared": change.declared,
        **{f"target {name}": outcome for name, outcome in change.targets.items()},
        **{f"receiver {name}": outcome for name, outcome in change.receivers.items()},
    }
    unchanged = (None, Change.UNCHANGED)
    changed = {part: outcome for part, outcome in parts.items() if outcome not in unchanged}
    if changed or change.plant is not Change.UNCHANGED:
        audit.record(
            session, actor, "plant.set", f"plant {plant.name}", change=change.plant, **changed
        )
    return change


def set_target(
    session: Session, actor: str, plane: TargetPlane, corners: Corners | None = None
) -> Put[TargetRow]:
    """Set a target plane; raises what `store.put_target` raises."""
    put = store.put_target(session, plane, corners)
    _note(session, actor, "target", plane.name, put.change)
    return put


def set_receiver(session: Session, actor: str, receiver: Receiver) -> Put[ReceiverRow]:
    """Set a receiver; raises what `store.put_receiver` raises."""
    put = store.put_receiver(session, receiver)
    _note(session, actor, "receiver", receiver.name, put.change)
    return put


def set_heliostat(
    session: Session, actor: str, name: str, properties: dict[str, object], replace: bool = True
) -> Put[HeliostatRow]:
    """Set a heliostat's properties; raises what `store.put_heliostat` raises.

    The model must be able to read them, so that all stored heliostats can be traced.
    """
    put = store.put_heliostat(
        session, name, properties, _position(session, name, properties), replace
    )
    _note(session, actor, "heliostat", name, put.change)
    return put


def set_heliostat_of_type(
    session: Session, actor: str, name: str, given: HeliostatOfType, replace: bool = True
) -> Put[HeliostatRow]:
    """Set a heliostat in the terms of ``plant.yaml``; raises what `document_of` raises, too."""
    store.serialize_writers(session)  # types and receivers must not change before it is written
    types, goals = store.get_plant(session).heliostat_types, store.goals_of_heliostats(session)
    return set_heliostat(session, actor, name, document_of(name, given, types, goals), replace)


def remove(
    session: Session, actor: str, kind: Literal["target", "receiver", "heliostat"], name: str
) -> None:
    """Delete what was set by mistake; raises what `store.remove_target` raises."""
    _REMOVERS[kind](session, name)
    audit.record(session, actor, f"{kind}.deleted", f"{kind} {name}")


_REMOVERS = {
    "target": store.remove_target,
    "receiver": store.remove_receiver,
    "heliostat": store.remove_heliostat,
}


def _position(session: Session, name: str, properties: dict[str, object]) -> NDArray[np.float64]:
    store.serialize_writers(
        session
    )  # the origin must not move before the heliostat's row is written
    return read_heliostat(name, properties, np.array(store.get_plant(session).origin)).position


def _note(session: Session, actor: str, kind: str, name: str, change: Change) -> None:
    if change is not Change.UNCHANGED:
        audit.record(session, actor, f"{kind}.set", f"{kind} {name}", change=change)
