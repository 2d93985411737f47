"""Versions of the plant's model: the declared one, then those declared or adopted later.

A version keeps its declaration and its effects. It never changes, because forecasts refer to it.
The current version is the newest that is not withdrawn. No version is deleted, so that all can be
requested, even withdrawn ones.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any, Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from model.camera_choice import DECLARATIONS
from model.effects import (
    Always,
    ByDay,
    Effect,
    Since,
    effect_to_json,
    effects_from_json,
    in_light_order,
)
from model.errors import InvalidInputError
from model.plant_model import PlantModel
from model.site import Site
from service import store
from service.base.errors import ConflictError, NotFoundError
from service.sources.documents import parse_declared
from service.store import audit
from service.store.columns import now
from service.store.model_versions import (
    DECLARED,
    add_model,
    declared_of,
    find_current,
    list_models,
    version_name,
)
from service.store.tables import ModelRow, StudyRow
from service.twin.adoption_rules import names_of, open_questions, why_refused

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


CameraAnswer = Literal["srgb", "linear"]
"""Images without background are differences of sRGB counts, or linear light."""

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


def is_current(session: Session, study: int) -> bool:
    """Whether the current version was adopted from a study."""
    held = find_adopted(session, study)
    return held is not None and held.number == current_number(session)


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


def list_studied(session: Session) -> list[store.Studied]:
    """What each study with the current version was of, the oldest first."""
    return store.list_studied(session, current_number(session))


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


Ends = Mapping[str, date]
"""First days without effects that ended, by `effect_key`."""


def effect_key(effect: Effect) -> str:
    """Name of an effect, with the heliostats of its scope if it has some: ``soiling of AB12``."""
    named = None if isinstance(effect.scope, ByDay) else effect.scope.heliostats
    return effect.name if named is None else f"{effect.name} of {' '.join(named)}"


def is_open(effect: Effect) -> bool:
    """Whether an effect acts on all photographs to come."""
    return isinstance(effect.scope, Always) or effect.scope.until is None


def first_day(effect: Effect, study: StudyRow) -> date:
    """The first day of an effect that a study found: of its scope, else of the photographs."""
    if isinstance(effect.scope, Since):
        return effect.scope.since
    return (study.first_taken_at or study.created_at).date()


def effects_of_study(study: StudyRow, ends: Ends | None = None) -> tuple[Effect, ...]:
    """The effects that a study, loaded with its report, found, some of them with an end.

    Raises
    ------
    InvalidInputError
        If one of ``ends`` is of no effect that acts still, or not after its first day.
    """
    found, ends = _effects(study.report), ends or {}
    if unknown := set(ends) - {effect_key(effect) for effect in found if is_open(effect)}:
        raise InvalidInputError(
            f"until: study {study.id} found no {', '.join(sorted(unknown))} that acts still"
        )
    return tuple(
        _ended(effect, first_day(effect, study), ends[effect_key(effect)])
        if effect_key(effect) in ends
        else effect
        for effect in found
    )


def _ended(effect: Effect, since: date, until: date) -> Effect:
    scope = effect.scope
    if isinstance(scope, ByDay):
        return replace(effect, scope=replace(scope, until=until))
    return replace(effect, scope=Since(since, scope.heliostats, until))


def without(model: ModelVersion, effects: Iterable[Effect]) -> ModelVersion:
    """A model without some of its effects."""
    left_out = {effect_text(effect) for effect in effects}
    kept = tuple(effect for effect in model.effects if effect_text(effect) not in left_out)
    return replace(model, effects=kept)


def effect_text(effect: Effect) -> str:
    """Text that is the same for equal effects."""
    return str(effect_to_json(effect))


@dataclass(frozen=True)
class _NextModel:
    """The version that an adoption is based on, and the effects after it."""

    base: ModelRow | None
    effects: tuple[Effect, ...]


def _next_model(session: Session, study: StudyRow, ends: Ends) -> _NextModel:
    """Add what a study found to the version that it used.

    If it is adopted, its effects get their ``ends`` in the current version.
    """
    found = effects_of_study(study, ends)
    if ends and find_adopted(session, study.id) is not None:
        base = find_current(session)
        after = dict(zip(map(effect_text, _effects(study.report)), found, strict=True))
        current = () if base is None else _effects(base.effects)
        return _NextModel(base, tuple(after.get(effect_text(e), e) for e in current))
    base = _row(session, study.model)
    return _NextModel(base, (*(() if base is None else _effects(base.effects)), *found))


def model_if_adopted(session: Session, study: StudyRow, ends: Ends | None = None) -> ModelVersion:
    """The plant's model as it would be after a study, loaded with its report, is adopted.

    Raises what `effects_of_study` raises.
    """
    next_, number = _next_model(session, study, ends or {}), current_number(session) + 1
    return _compose(session, number, next_.effects, declared_of(session, next_.base))


@dataclass(frozen=True, eq=False)
class AdoptedEffect:
    """An effect of the current version, and the study that found it, loaded with its report."""

    effect: Effect
    study: StudyRow


def adopted_effects(session: Session) -> list[AdoptedEffect]:
    """The effects of the current version that acts still, and were adopted from studies."""
    current = find_current(session)
    acting = () if current is None else tuple(filter(is_open, _effects(current.effects)))
    rows = [row for row in list_models(session) if row.withdrawn_at is None]
    numbers = dict.fromkeys(row.study_id for row in reversed(rows) if row.study_id is not None)
    found = dict[str, AdoptedEffect]()
    for study in (store.get_study(session, number) for number in numbers if acting):
        texts = {effect_text(effect) for effect in _effects(study.report)}
        for effect in acting:
            if (text := effect_text(effect)) in texts:
                found.setdefault(text, AdoptedEffect(effect, study))
    return list(found.values())


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
    ends: Ends | None = None,
) -> ModelRow:
    """Adopt the effects of a study in a new current version.

    The new version has the effects that the study assumed and those that it found. This is the
    model that the study's held-out photographs evaluated, also if ``force`` replaces another
    current version. If it is current already, nothing changes. ``shown`` is the version that was
    current when the study was read; None requires nothing. Effects of an adopted study get their
    ``ends`` in the next version.

    Raises
    ------
    NotFoundError
        If there is no such study.
    ConflictError
        If its result cannot be adopted (`why_refused`), or if another version than ``shown`` is
        current. Without ``force``, also if it was made with another
        version than the current one. Without a ``reason``, if the study leaves questions open
        (`open_questions`).
    InvalidInputError
        If ``ends`` are not of its effects.
    """
    study = store.get_study(session, number)
    findings, current = store.study_findings(session, [number])[number], current_number(session)
    if refusal := why_refused(findings):
        raise ConflictError(f"study {number}: {refusal}")
    if shown not in (None, current):
        newest = find_current(session)
        by = "" if newest is None else f", adopted by {newest.adopted_by}"
        raise ConflictError(
            f"version {current} of the model is current{by}, instead of {shown} when study {number}"
            " was read; read it again before you adopt it"
        )
    held = find_adopted(session, number)
    is_ending = bool(ends) and held is not None
    if study.model != current and not force and not is_ending:
        raise ConflictError(
            f"study {number} was made with version {study.model} of the model, {current} is"
            " current; make another study, or force it to put this one in place of the current"
            " model"
        )
    if held is not None and held.number == current and not is_ending:
        return held
    questions = open_questions(findings)
    if questions and not reason and not is_ending:
        raise ConflictError(
            f"reason: study {number} leaves questions open"
            f" ({'; '.join(question.finding for question in questions)}); resolve them, or give the"
            " reason to adopt it nevertheless"
        )
    next_ = _next_model(session, study, ends or {})
    declared = declared_of(session, next_.base)
    row = add_model(session, next_.effects, declared, study.id, actor)
    row.reason = reason
    names = names_of(findings)
    until = {key: day.isoformat() for key, day in (ends or {}).items()}
    about: dict[str, object] = {"model": row.version, "effects": names, **_given(reason)}
    about |= {"until": until} if until else {}
    audit.record(session, actor, "effect.adopted", f"study {number}", **about)
    return row


def _given(reason: str | None) -> dict[str, str]:
    return {"reason": reason} if reason else {}


def declares_camera(session: Session) -> bool:
    """Whether the current version declares cameras, or that there are none."""
    return "cameras" in (declared_of(session, find_current(session)) or {})


def declare_camera(session: Session, answer: CameraAnswer, actor: str, reason: str) -> None:
    """Declare the camera of images without background, in a new version with the same effects.

    Nothing changes if the current version declares cameras.
    """
    current = find_current(session)
    if declares_camera(session):
        return
    declared = (declared_of(session, current) or {}) | DECLARATIONS[answer]
    effects = () if current is None else _effects(current.effects)
    row = add_model(session, effects, declared, None, actor)
    row.reason = reason
    about = {"model": row.version, "answer": answer, "reason": reason}
    audit.record(session, actor, "camera.declared", "the plant's model", **about)


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
