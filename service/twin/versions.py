"""Versions of the plant's model: the declared one, then one more for each that is declared otherwise or adopted.

A version never changes: it keeps what was declared when it was made, and its effects, for forecasts name it.
The current version is the newest that is not withdrawn. Nothing is deleted: whoever asks for an earlier version, even
a withdrawn one, gets it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from model.effects import Effect, effect_to_json, effects_from_json, in_light_order
from model.imaging import Camera
from model.tracing import Optics
from service import store
from service.base.faults import ConflictError, NotFoundError
from service.sources.documents import parse_declared
from service.store import audit
from service.store.columns import now
from service.store.models import DECLARED, add_model, declared_of, find_current, list_models, version_name
from service.store.tables import ModelRow

__all__ = [
    "DECLARED",
    "PlantModel",
    "adopt",
    "adopted_from",
    "current_number",
    "current_version",
    "find_adopted",
    "find_current",
    "find_model",
    "get_model",
    "list_models",
    "version_name",
    "withdraw",
]


@dataclass(frozen=True, eq=False)
class PlantModel:
    """The plant's model as it is computed with: declared optics and cameras, declared and adopted effects."""

    number: int
    version: str
    optics: Optics
    effects: tuple[Effect, ...]
    cameras: tuple[Camera, ...] = ()


# --- reading ----------------------------------------------------------------------------------------------------------


def find_adopted(session: Session, study: int) -> ModelRow | None:
    """The newest version that stands for what a study found, unless it is withdrawn."""
    return adopted_from(session, [study]).get(study)


def adopted_from(session: Session, studies: Sequence[int]) -> dict[int, ModelRow]:
    """What `find_adopted` has of each of these studies that has one, by its id."""
    query = select(ModelRow).where(ModelRow.study_id.in_(studies), ModelRow.withdrawn_at.is_(None))
    # Of a study's versions the last one stays.
    rows = session.scalars(query.order_by(ModelRow.number))
    return {row.study_id: row for row in rows if row.study_id is not None}


def current_number(session: Session) -> int:
    """Number of the current version."""
    row = find_current(session)
    return DECLARED if row is None else row.number


def current_version(session: Session) -> str:
    """Number and effects of the current version, as forecasts and surfaces name it."""
    row = find_current(session)
    return version_name(DECLARED, ()) if row is None else row.version


def get_model(session: Session, number: int | None = None) -> PlantModel:
    """A version of the plant's model, by default the current one; NotFoundError where there is none."""
    return _plant_model(session, find_current(session) if number is None else _row(session, number))


def _row(session: Session, number: int) -> ModelRow | None:
    """A version as it is kept; None for the first, which the plant has."""
    if number == DECLARED:
        return None
    row = session.get(ModelRow, number)
    if row is None:
        raise NotFoundError(f"model_version: the plant's model has no version {number}; see /v1/models")
    return row


def _plant_model(session: Session, row: ModelRow | None) -> PlantModel:
    number, adopted = (DECLARED, ()) if row is None else (row.number, _effects(row.effects))
    declared = parse_declared(declared_of(session, row) or {}, "the plant")
    effects = (*declared.effects, *adopted)
    return PlantModel(number, version_name(number, adopted), declared.optics, effects, declared.cameras)


def find_model(session: Session, effects: Sequence[Effect]) -> PlantModel | None:
    """The newest version that holds just these effects and is not withdrawn; None where there is none."""

    def plain(some: Sequence[Effect]) -> list[dict[str, Any]]:
        return [effect_to_json(effect) for effect in in_light_order(some)]

    rows = [row for row in list_models(session) if row.withdrawn_at is None]
    versions = (_plant_model(session, row) for row in (*reversed(rows), None))
    return next((version for version in versions if plain(version.effects) == plain(effects)), None)


def _effects(data: Any) -> tuple[Effect, ...]:
    return tuple(effects_from_json(data))


# --- adopting and withdrawing -----------------------------------------------------------------------------------------


def adopt(session: Session, number: int, actor: str, force: bool = False) -> ModelRow:
    """Make what a study found the plant's next model: the effects that it was made with, and those that it found.

    That is the very model that the study's held-out photographs have judged, also where ``force`` adopts it in place
    of another that is current by now. Where it is the current one already, it stays that.

    Raises
    ------
    NotFoundError
        Where there is no such study.
    ConflictError
        Where it found no effect; unless ``force``, where its verdict does not rest on its effects, or where it was
        made with another version than the current one.
    """
    store.one_at_a_time(session)
    study = store.get_study(session, number)
    found = _effects(study.report)
    current = current_number(session)
    if not found:
        raise ConflictError(f"study {number} found no effect; there is nothing to adopt")
    if study.verdict != "effect" and not force:
        raise ConflictError(f"study {number}: its verdict is '{study.verdict}'; force it to adopt what it found anyway")
    if study.model != current and not force:
        raise ConflictError(
            f"study {number} was made with version {study.model} of the model, {current} is current; "
            "make another study, or force it to put this one in place of the current model"
        )
    held = find_adopted(session, number)
    if held is not None and held.number == current:
        return held
    base = _row(session, study.model)
    before = () if base is None else _effects(base.effects)
    row = add_model(session, (*before, *found), declared_of(session, base), study.id, actor)
    names = [effect.name for effect in found]
    audit.record(session, actor, "effect.adopted", f"study {number}", model=row.version, effects=names)
    return row


def withdraw(session: Session, study: int, actor: str) -> ModelRow:
    """Withdraw what was adopted from a study; the version before is current again.

    Raises
    ------
    NotFoundError
        Where there is no such study.
    ConflictError
        Where it is not adopted, or a later version stands upon it.
    """
    store.one_at_a_time(session)
    store.get_study(session, study)
    row, current = find_adopted(session, study), find_current(session)
    if row is None or current is None:
        raise ConflictError(f"study {study} is not adopted")
    if row is not current:
        raise ConflictError(
            f"version {row.number} of the model is not the current one: "
            f"withdraw version {current.number}, adopted from study {current.study_id}, first"
        )
    row.withdrawn_at, row.withdrawn_by = now(), actor
    audit.record(session, actor, "effect.withdrawn", f"study {study}", model=row.version)
    return row
