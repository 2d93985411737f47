"""Set the plant's geometry, with an audit entry for each change.

All functions run in the caller's transaction. A call that changes nothing leaves no entry.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import inspect
from sqlalchemy.orm import Session

from model.errors import InvalidInputError
from model.plant import Plant, Receiver, TargetPlane
from service import store
from service.base.fields import JsonObject
from service.base.plant import NAMES_WITH_UNITS, NO_FACTS, PlantFacts
from service.sources.documents import read_heliostat
from service.sources.heliostat_document import HeliostatOfType, document_of
from service.sources.paint_documents import Corners
from service.store import Change, audit
from service.store.columns import Base
from service.store.model_versions import put_declared
from service.store.rows import Put
from service.store.tables import HeliostatRow, ReceiverRow, TargetRow


@dataclass(frozen=True)
class Authorship:
    """Who changes the plant, and why.

    If ``version`` is given, nobody may have changed the same thing since (`service.store.audit`).
    """

    actor: str
    reason: str | None = None
    version: int | None = None

    @property
    def about(self) -> dict[str, str]:
        """The reason, for the audit trail."""
        return {} if self.reason is None else {"reason": self.reason}


@dataclass(frozen=True)
class PlantChange:
    """What setting a plant changed in each of its parts."""

    plant: Change
    declared: Change | None
    targets: dict[str, Change]
    receivers: dict[str, Change]


def set_plant(
    session: Session,
    by: Authorship,
    plant: Plant,
    declared: dict[str, object] | None = None,
    corners: Mapping[str, Corners] | None = None,
    facts: PlantFacts = NO_FACTS,
) -> PlantChange:
    """Set tower base, targets, receivers, declared model and other facts together.

    Raises
    ------
    InvalidInputError
        If something that is stored changes without a reason.
    ConflictError
        If stored data forbid it: see the functions of `service.store`. Also if the plant was
        changed since the version.
    """
    known = store.find_plant(session)
    subject = f"plant {plant.name if known is None else known.name}"
    audit.require_version(session, subject, "plant.set", by.version)
    placed = store.put_plant(session, plant.name, plant.origin)
    facts_change = store.put_plant_facts(session, facts)
    values = _changed_values(store.get_plant(session))
    part_by = replace(by, version=None)

    def changed_part(
        kind: Literal["target", "receiver"], put: Put[TargetRow] | Put[ReceiverRow]
    ) -> Change:
        if put.change is Change.CHANGED:
            _note(session, part_by, kind, put)
        return put.change

    change = PlantChange(
        facts_change if placed is Change.UNCHANGED else placed,
        put_declared(session, declared, by.actor) if declared else None,
        {
            name: changed_part(
                "target", store.put_target(session, plane, (corners or {}).get(name))
            )
            for name, plane in plant.targets.items()
        },
        {
            name: changed_part("receiver", store.put_receiver(session, receiver))
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
        if known is not None:
            _require(session, by, subject, "plant.set")
        about = {"change": change.plant, **by.about, **values, **changed}
        audit.record(session, by.actor, "plant.set", f"plant {plant.name}", **about)
    return change


def set_target(
    session: Session, by: Authorship, plane: TargetPlane, corners: Corners | None = None
) -> Put[TargetRow]:
    """Set a target plane; raises what `store.put_target` raises."""
    put = store.put_target(session, plane, corners)
    _note(session, by, "target", put)
    return put


def set_receiver(session: Session, by: Authorship, receiver: Receiver) -> Put[ReceiverRow]:
    """Set a receiver; raises what `store.put_receiver` raises."""
    put = store.put_receiver(session, receiver)
    _note(session, by, "receiver", put)
    return put


def set_heliostat(
    session: Session, by: Authorship, name: str, properties: dict[str, object], replace: bool = True
) -> Put[HeliostatRow]:
    """Set a heliostat's properties; raises what `store.put_heliostat` raises.

    The model must be able to read them, so that all stored heliostats can be traced.
    """
    put = store.put_heliostat(
        session, name, properties, _position(session, name, properties), replace
    )
    _note(session, by, "heliostat", put)
    return put


def set_heliostat_of_type(
    session: Session, by: Authorship, name: str, given: HeliostatOfType, replace: bool = True
) -> Put[HeliostatRow]:
    """Set a heliostat in the terms of ``plant.yaml``; raises what `document_of` raises, too."""
    types, goals = store.get_plant(session).heliostat_types, store.goals_of_heliostats(session)
    return set_heliostat(session, by, name, document_of(name, given, types, goals), replace)


def remove(
    session: Session, by: Authorship, kind: Literal["target", "receiver", "heliostat"], name: str
) -> None:
    """Delete what was set by mistake; raises what `store.remove_target` raises."""
    _REMOVERS[kind](session, name)
    _require(session, by, f"{kind} {name}", f"{kind}.set")
    audit.record(session, by.actor, f"{kind}.deleted", f"{kind} {name}", **by.about)


_REMOVERS = {
    "target": store.remove_target,
    "receiver": store.remove_receiver,
    "heliostat": store.remove_heliostat,
}


def _position(session: Session, name: str, properties: dict[str, object]) -> NDArray[np.float64]:
    return read_heliostat(name, properties, np.array(store.get_plant(session).origin)).position


def _note(
    session: Session,
    by: Authorship,
    kind: str,
    put: Put[HeliostatRow] | Put[TargetRow] | Put[ReceiverRow],
) -> None:
    if put.change is Change.UNCHANGED:
        return
    subject, values = f"{kind} {put.row.name}", _changed_values(put.row)
    if put.change is Change.CHANGED:
        _require(session, by, subject, f"{kind}.set")
    about = {"change": put.change, **by.about, **values}
    audit.record(session, by.actor, f"{kind}.set", subject, **about)


def _require(session: Session, by: Authorship, subject: str, action: str) -> None:
    """Require a reason for a change of what is stored, and that nobody changed it meanwhile."""
    audit.require_version(session, subject, action, by.version)
    if by.reason is None:
        raise InvalidInputError(
            f"reason: {subject} is stored, and would change; say why, it is kept in the audit trail"
        )


def _changed_values(row: Base) -> dict[str, JsonObject]:
    """Values of a row's changed columns before and after, until they are flushed."""
    before, after = JsonObject(), JsonObject()
    for column in inspect(row).mapper.column_attrs:
        history = inspect(row).attrs[column.key].history
        for old, new in zip(history.deleted or (), history.added or (), strict=True):
            if isinstance(old, dict) and isinstance(new, dict):
                parts = [part for part in old.keys() | new.keys() if old.get(part) != new.get(part)]
                before |= {_label(column.key, part): old.get(part) for part in parts}
                after |= {_label(column.key, part): new.get(part) for part in parts}
            else:
                before[column.key], after[column.key] = old, new
    return {"before": before, "after": after} if after else {}


def _label(column: str, part: str) -> str:
    return NAMES_WITH_UNITS.get(part, part) if column == "geometry" else f"{column}.{part}"
