"""Storage of the state of the heliostats and of the field, which workers write."""

from collections.abc import Mapping

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from service.store.columns import EPOCH
from service.store.rows import insert, inserting
from service.store.tables import FieldStateRow, HeliostatRow, HeliostatStateRow

NOTHING = FieldStateRow(
    id=1, revision=0, states=0, computed_at=EPOCH, marks="", pending=0, cameras=[]
)
"""State of a field that no worker has seen yet."""


def read_field_state(session: Session) -> FieldStateRow:
    """Return the state of the field as it was written last."""
    return session.get(FieldStateRow, 1, populate_existing=True) or NOTHING


def lock_field_state(session: Session) -> FieldStateRow:
    """Return the state of the field, and block other writers of it until the transaction ends."""
    insert(session, FieldStateRow(id=1, marks="", cameras=[]))
    return session.get_one(FieldStateRow, 1, with_for_update=True, populate_existing=True)


def save_states(session: Session, found: Mapping[int, Mapping[str, object]]) -> None:
    """Store results of heliostats by their row ids; those that were deleted are left out."""
    lock_field_state(session).states += 1
    query = select(HeliostatRow.id).where(HeliostatRow.id.in_(found)).order_by(HeliostatRow.id)
    for number in session.scalars(query.with_for_update(read=True, key_share=True)).all():
        columns = dict(found[number])
        statement = inserting(session, HeliostatStateRow).values(heliostat_id=number, **columns)
        key = [HeliostatStateRow.heliostat_id]
        session.execute(statement.on_conflict_do_update(index_elements=key, set_=columns))


def apply_pointing_limit(session: Session, limit_mrad: float) -> None:
    """Let all pointing be computed again if it was for another limit [mrad]."""
    field = lock_field_state(session)
    if field.pointing_limit_mrad != limit_mrad:
        field.pointing_limit_mrad = limit_mrad
        session.execute(update(HeliostatStateRow).values(pointing_key=None))
