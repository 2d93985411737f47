"""Versions of the plant's model, as they are kept and found again; `service.twin.versions` says what they mean.

It knows effects, which bring the tracer's libraries along: so `service.store` does not hand it on to those that only
look into the database.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.effects import Effect, effect_to_json, model_version
from service.base.faults import ConflictError
from service.store.keys import RESERVED
from service.store.plant import get_plant, is_plant_new
from service.store.rows import Change, insert, one_at_a_time
from service.store.tables import ModelRow, PlantRow, StudyRow

DECLARED = 1
"""Number of the model that the plant began with, which has no effect but the declared ones."""


def version_name(number: int, effects: Iterable[Effect]) -> str:
    """``number:names``, the names of adopted effects as `model.effects.model_version` has them."""
    return f"{number}:{model_version(effects).partition(':')[2]}"


def list_models(session: Session) -> Sequence[ModelRow]:
    """The versions that came after the first, oldest first."""
    return session.scalars(select(ModelRow).order_by(ModelRow.number)).all()


def find_current(session: Session) -> ModelRow | None:
    """The current version; None where that is the first."""
    query = select(ModelRow).where(ModelRow.withdrawn_at.is_(None)).order_by(ModelRow.number.desc()).limit(1)
    return session.scalar(query)


def declared_of(session: Session, version: ModelRow | None) -> dict[str, Any] | None:
    """What was declared when a version was made; None as version is the first, None as an answer the defaults."""
    holder = session.get(PlantRow, 1) if version is None else version
    return None if holder is None else holder.declared


def add_model(
    session: Session, effects: Sequence[Effect], declared: dict[str, Any] | None, study: int | None, actor: str
) -> ModelRow:
    """Store the next version: these ``effects`` upon what is ``declared``; its number was never given before."""
    number = (session.scalar(select(func.max(ModelRow.number))) or DECLARED) + 1
    row = ModelRow(
        number=number,
        version=version_name(number, effects),
        effects=[effect_to_json(effect) for effect in effects],
        declared=declared,
        study_id=study,
        adopted_by=actor,
    )
    if not insert(session, row):
        raise ConflictError("another version of the model was made at the same moment; try again")
    return row


def put_declared(session: Session, declared: dict[str, Any], actor: str = RESERVED) -> Change:
    """Set what is declared of the plant's model, in the form of ``twin.json``.

    It belongs to the first version where the plant itself is new in this transaction. Later on forecasts and surfaces
    may name that version, also those that are being computed: what is declared otherwise then is the next version.

    Raises
    ------
    ConflictError
        Where studies were made with another: what they found adds to that.
    """
    one_at_a_time(session)
    plant = get_plant(session)
    if (declared_of(session, find_current(session)) or {}) == declared:
        return Change.UNCHANGED
    if session.scalar(select(StudyRow.id).limit(1)) is not None:
        raise ConflictError("the declared model is fixed: studies were made with it; adopt what they find instead")
    if is_plant_new(session):
        plant.declared = declared
    else:
        add_model(session, (), declared, None, actor)
    return Change.CHANGED
