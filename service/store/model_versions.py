"""Storage of versions of the plant's model; see `service.twin.model_versions`.

This module imports effects and with them the ray tracer's libraries. Therefore `service.store` does
not import it, and programs that only query the database start fast.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.effects import Effect, effect_to_json, model_version
from service.base.errors import ConflictError
from service.store.keys import RESERVED
from service.store.plant import get_plant, is_plant_new
from service.store.rows import Change, insert
from service.store.tables import ModelRow, PlantRow, StudyRow

DECLARED = 1
"""Number of the plant's first model, which has only the declared effects."""


def version_name(number: int, effects: Iterable[Effect]) -> str:
    """Name of a version: ``number:names``, with names as in `model.effects.model_version`."""
    return f"{number}:{model_version(effects).partition(':')[2]}"


def list_models(session: Session) -> Sequence[ModelRow]:
    """The versions after the first, oldest first."""
    return session.scalars(select(ModelRow).order_by(ModelRow.number)).all()


def find_current(session: Session) -> ModelRow | None:
    """The current version; None if it is the first."""
    query = (
        select(ModelRow)
        .where(ModelRow.withdrawn_at.is_(None))
        .order_by(ModelRow.number.desc())
        .limit(1)
    )
    return session.scalar(query)


def declared_of(session: Session, version: ModelRow | None) -> dict[str, Any] | None:
    """The declared model of a version. A ``version`` of None is the first; a None result, the
    defaults.
    """
    holder = session.get(PlantRow, 1) if version is None else version
    return None if holder is None else holder.declared


def add_model(
    session: Session,
    effects: Sequence[Effect],
    declared: dict[str, object] | None,
    study: int | None,
    actor: str,
) -> ModelRow:
    """Store the next version: these ``effects`` on top of ``declared``, with a new number."""
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


def put_declared(session: Session, declared: dict[str, object], actor: str = RESERVED) -> Change:
    """Set the declared model of the plant, in the form of ``twin.json``.

    It belongs to the first version if the plant was created in this transaction. Later, forecasts
    and surfaces may refer to the current version, even while they are being computed. A changed
    declaration is then the next version.

    Raises
    ------
    ConflictError
        If studies used another declaration, because their results add to that one.
    """
    plant = get_plant(session)
    if (declared_of(session, find_current(session)) or {}) == declared:
        return Change.UNCHANGED
    if session.scalar(select(StudyRow.id).limit(1)) is not None:
        raise ConflictError(
            "the declared model is fixed: studies were made with it; adopt what they find instead"
        )
    if is_plant_new(session):
        plant.declared = declared
    else:
        add_model(session, (), declared, None, actor)
    return Change.CHANGED
