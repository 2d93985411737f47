"""Versions of the plant's model: the declared one, then those declared or adopted later.

A version keeps its declaration and its effects. It never changes, because forecasts refer to it.
The current version is the newest that is not withdrawn. No version is deleted, so that all can be
requested, even withdrawn ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from model.effects import Effect, effect_to_json, effects_from_json, in_light_order
from model.plant_model import PlantModel
from model.site import Site
from service import store
from service.base.errors import ConflictError, NotFoundError
from service.sources.documents import parse_declared
from service.store import audit
from service.store.columns import now
from service.store.plant.model_versions import (
    DECLARED,
    add_model,
    declared_of,
    find_current,
    list_models,
    version_name,
)
from service.store.tables import ModelRow, StudyRow
from service.twin.plant.open_questions import open_questions

__all__ = [
    "DECLARED",
    "ModelVersion",
    "adopt",
    "current_number",
    "current_version",
    "find_adopted",
    "find_current",
    "find_model",
    "get_model",
    "list_models",
    "model_if_adopted",
    "newest_of",
    "version_name",
    "withdraw",
]


Declaration = dict[str, object] | None
"""A declared model, as stored; None is the default one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelVersion(PlantModel):
    """A version of the plant's model.

    ``version`` is the ``number`` with the adopted effects.
    """

    number: int
    version: str


# --- reading
# --------------------------------------------------------------------------------------------------


def find_adopted(session: Session, study: int) -> ModelRow | None:
    """The newest version adopted from a study, unless it is withdrawn."""
    row = newest_of(session, [study]).get(study)
    return None if row is None or row.withdrawn_at else row


def newest_of(session: Session, studies: Sequence[int]) -> dict[int, ModelRow]:
    """The newest version of each study, withdrawn only if all its versions are, by study id."""
    query = select(ModelRow).where(ModelRow.study_id.in_(studies)).order_by(ModelRow.number)
    rows = [row for row in session.scalars(query) if row.study_id is not None]
    rows.sort(key=lambda row: (row.withdrawn_at is None, row.number))
    return {row.study_id: row for row in rows if row.study_id is not None}


def current_number(session: Session) -> int:
    """Number of the current version."""
    row = find_current(session)
    return DECLARED if row is None else row.number


def current_version(session: Session) -> str:
    """Number and effects of the current version, as stored with forecasts and surfaces."""
    row = find_current(session)
    return version_name(DECLARED, ()) if row is None else row.version


def get_model(session: Session, number: int | None = None) -> ModelVersion:
    """A version of the plant's model, by default the current one.

    Raises
    ------
    NotFoundError
        If there is no such version.
    ConflictError
        If the plant is not set.
    """
    return _model_version(
        session, find_current(session) if number is None else _row(session, number)
    )


def _row(session: Session, number: int) -> ModelRow | None:
    """The row of a version; None for the first, which the plant's row contains."""
    if number == DECLARED:
        return None
    row = session.get(ModelRow, number)
    if row is None:
        raise NotFoundError(
            f"model_version: the plant's model has no version {number}; see /v1/models"
        )
    return row


def _model_version(session: Session, row: ModelRow | None) -> ModelVersion:
    number, adopted = (DECLARED, ()) if row is None else (row.number, _effects(row.effects))
    return _compose(session, number, adopted, declared_of(session, row))


def _compose(
    session: Session, number: int, adopted: tuple[Effect, ...], declaration: Declaration
) -> ModelVersion:
    """The plant's model with a declaration and adopted effects."""
    declared = parse_declared(declaration or {}, "the plant")
    return ModelVersion(
        site=Site.from_origin(store.get_plant(session).origin),
        optics=declared.optics,
        effects=(*declared.effects, *adopted),
        cameras=declared.cameras,
        number=number,
        version=version_name(number, adopted),
    )


def _with_found(base: ModelRow | None, study: StudyRow) -> tuple[Effect, ...]:
    """The effects of the version that a study used, and those that it found."""
    return (*(() if base is None else _effects(base.effects)), *_effects(study.report))


def model_if_adopted(session: Session, study: StudyRow) -> ModelVersion:
    """The plant's model as it would be after a study, loaded with its report, is adopted."""
    base, number = _row(session, study.model), current_number(session) + 1
    return _compose(session, number, _with_found(base, study), declared_of(session, base))


def find_model(session: Session, effects: Sequence[Effect]) -> ModelVersion | None:
    """The newest version with exactly these effects that is not withdrawn, or None."""

    def plain(some: Sequence[Effect]) -> list[dict[str, object]]:
        return [effect_to_json(effect) for effect in in_light_order(some)]

    rows = [row for row in list_models(session) if row.withdrawn_at is None]
    versions = (_model_version(session, row) for row in (*reversed(rows), None))
    return next((version for version in versions if plain(version.effects) == plain(effects)), None)


def _effects(data: Any) -> tuple[Effect, ...]:
    return tuple(effects_from_json(data))


# --- adopting and withdrawing
# -----------------------------------------------------------------------------------------


def adopt(
    session: Session,
    number: int,
    actor: str,
    force: bool = False,
    reason: str | None = None,
    shown: int | None = None,
) -> ModelRow:
    """Adopt the effects of a study in a new current version.

    The new version has the effects that the study assumed and those that it found. This is the
    model that the study's held-out photographs evaluated, also if ``force`` replaces another
    current version. If it is current already, nothing changes. ``shown`` is the version that was
    current when the study was read; None requires nothing.

    Raises
    ------
    NotFoundError
        If there is no such study.
    ConflictError
        If the study found no effect, or another version than ``shown`` is current. Without
        ``force``, also if its verdict is not "effect", or if it was made with another version than
        the current one. Without a ``reason``, if the study leaves questions open
        (`open_questions`).
    """
    study = store.get_study(session, number)
    found = _effects(study.report)
    current = current_number(session)
    if not found:
        raise ConflictError(f"study {number} found no effect; there is nothing to adopt")
    if study.verdict != "effect" and not force:
        raise ConflictError(
            f"study {number}: its verdict is '{study.verdict}'; force it to adopt what it found"
            " anyway"
        )
    if shown not in (None, current):
        newest = find_current(session)
        by = "" if newest is None else f", adopted by {newest.adopted_by}"
        raise ConflictError(
            f"version {current} of the model is current{by}, instead of {shown} when study {number}"
            " was read; read it again before you adopt it"
        )
    if study.model != current and not force:
        raise ConflictError(
            f"study {number} was made with version {study.model} of the model, {current} is"
            " current; make another study, or force it to put this one in place of the current"
            " model"
        )
    held = find_adopted(session, number)
    if held is not None and held.number == current:
        return held
    questions = open_questions(study.report["effects"], study.report["unexplained_share"])
    if questions and not reason:
        raise ConflictError(
            f"reason: study {number} leaves questions open"
            f" ({'; '.join(question.finding for question in questions)}); resolve them, or give the"
            " reason to adopt it nevertheless"
        )
    base = _row(session, study.model)
    row = add_model(session, _with_found(base, study), declared_of(session, base), study.id, actor)
    row.reason = reason
    names = [effect.name for effect in found]
    about = {"model": row.version, "effects": names, **_given(reason)}
    audit.record(session, actor, "effect.adopted", f"study {number}", **about)
    return row


def _given(reason: str | None) -> dict[str, str]:
    return {"reason": reason} if reason else {}


def withdraw(session: Session, study: int, actor: str, reason: str | None = None) -> ModelRow:
    """Withdraw the version adopted from a study; the version before is current again.

    Raises
    ------
    NotFoundError
        If there is no such study.
    ConflictError
        If the study is not adopted, or a later version is current.
    """
    store.get_study(session, study)
    row, current = find_adopted(session, study), find_current(session)
    if row is None or current is None:
        raise ConflictError(f"study {study} is not adopted")
    if row is not current:
        raise ConflictError(
            f"version {row.number} of the model is not the current one: "
            f"withdraw version {current.number}, adopted from study {current.study_id}, first"
        )
    row.withdrawn_at, row.withdrawn_by, row.withdrawn_reason = now(), actor, reason
    about = {"model": row.version, **_given(reason)}
    audit.record(session, actor, "effect.withdrawn", f"study {study}", **about)
    return row
