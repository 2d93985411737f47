"""What effects change in the accuracies of the whole field, and of photographs after a study.

A study is judged by its photographs. What came later may contradict it: haze ends, a mirror is
cleaned. So some photographs of each day are forecast with and without an effect.
"""

import json
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from datetime import date, datetime
from typing import NamedTuple

import numpy as np
from cachetools import LRUCache
from pydantic import BaseModel, Field
from sqlalchemy import extract, func, select
from sqlalchemy.orm import Session

from model.effects import Always, ByDay, Effect
from model.errors import ModelError
from model.metrics import flux_accuracies
from model.study.judging import Gain, few_gain, find_end, is_worse
from service import store
from service.base.errors import ConflictError, ServiceError
from service.base.fields import MeanGain
from service.store.listing import Portion
from service.store.tables import HeliostatRow, MeasurementRow, StudyRow, SurfaceRow
from service.twin import model_versions
from service.twin.adoption_rules import is_ambiguous
from service.twin.measurements import accepted_measurement, heights_of, load_heliostat_context
from service.twin.model_versions import Ends, ModelVersion, effect_key, effect_text, without
from service.twin.runtime import Runtime
from service.twin.studies.adoption import StudyState, study_states
from service.twin.surfaces.accuracy import forecasts_of

_DAYS, _A_DAY = 60, 6  # days with photographs, and photographs of each
_MOST = 50_000  # newest photographs that they are chosen from
_REMEMBERED = 64  # pairs of models whose gains are remembered
_RECENT = 5  # studies, one of which may be adopted


class SampledPhotograph(NamedTuple):
    """A photograph of a known time, and the active version of its heliostat's surface."""

    id: int
    identifier: str
    heliostat: str
    taken_at: datetime
    surface: int | None


def sample_photographs(
    session: Session, heliostats: Collection[str] | None = None, a_day: int = _A_DAY
) -> list[SampledPhotograph]:
    """Choose up to ``a_day`` photographs of each of the last days, the newest day first.

    They are of all heliostats with a surface, or of some of them. An ideal mirror would gain by
    every effect that spreads its light.
    """
    row = MeasurementRow
    has_surface = row.heliostat_id.in_(select(SurfaceRow.heliostat_id))
    chosen = [row.accepted, row.arrays.is_not(None), row.taken_at.is_not(None), has_surface]
    if heliostats is not None:
        numbers = select(HeliostatRow.id).where(HeliostatRow.name.in_(heliostats))
        chosen.append(row.heliostat_id.in_(numbers))
    second = extract("epoch", row.taken_at)
    columns = (row.id, row.identifier, row.heliostat_id, row.taken_at)
    newest = select(*columns, (second - second % 86400).label("day")).where(*chosen)
    of = newest.order_by(row.taken_at.desc()).limit(_MOST).subquery().c
    # Ids times a prime, modulo another: in no order of heliostats or hours.
    scattered = (of.id * 7919 % 1009, of.id)
    age = func.dense_rank().over(order_by=of.day.desc())
    place = func.row_number().over(partition_by=of.day, order_by=scattered)
    ranked = select(*of, age.label("age"), place.label("place")).subquery().c
    query = select(
        ranked.id, ranked.identifier, HeliostatRow.name, ranked.taken_at, HeliostatRow.id
    )
    query = query.join(HeliostatRow, HeliostatRow.id == ranked.heliostat_id)
    query = query.where(ranked.age <= _DAYS, ranked.place <= a_day)
    active = store.active_versions(session)
    found = session.execute(query.order_by(ranked.age, ranked.place))
    return [
        SampledPhotograph(photograph, identifier, name, at, active.get(heliostat))
        for photograph, identifier, name, at, heliostat in found
        if at is not None
    ]


class EffectGains:
    """Changes of accuracy from one model to another; that of a photograph is computed once."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._known: LRUCache[str, dict[SampledPhotograph, float]] = LRUCache(_REMEMBERED)

    def of(
        self, photographs: Sequence[SampledPhotograph], before: ModelVersion, after: ModelVersion
    ) -> dict[int, float]:
        """Changes of accuracy [1] with the active surfaces, by row id.

        Photographs that both models forecast alike have zero. Those that cannot be forecast are
        left out.
        """
        old, new = ({effect_text(e): e for e in model.effects} for model in (before, after))
        # A version of another number may have other cameras, which measure photographs again.
        known = self._known.setdefault(str((before.number, sorted(old), sorted(new))), {})
        differing = [effect for key, effect in (old | new).items() if (key in old) != (key in new)]
        gains, changed = dict[int, float](), defaultdict[str, list[SampledPhotograph]](list)
        for one in photographs:
            if one in known:
                gains[one.id] = known[one]
            elif any(effect.at(one.taken_at, one.heliostat) is not None for effect in differing):
                changed[one.heliostat].append(one)
            else:
                gains[one.id] = 0.0
        for name, taken in changed.items():
            try:
                gains |= _gains_of_heliostat(self._runtime, name, taken, before, after)
            except (ModelError, ServiceError):  # deleted since, or not traceable
                continue
        known |= {one: gains[one.id] for one in photographs if one.id in gains}
        return gains


def _gains_of_heliostat(
    runtime: Runtime,
    name: str,
    photographs: Sequence[SampledPhotograph],
    before: ModelVersion,
    after: ModelVersion,
) -> dict[int, float]:
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, name)
        surface = store.find_surface_at(session, twin.row)
        identifiers = [one.identifier for one in photographs]
        rows = store.get_measurements(session, twin.row, identifiers, arrays=True)
    if surface is None:
        return {}
    shown = [accepted_measurement(row, twin.origin) for row in rows]
    measured, heights = np.array([one.centered for one in shown]), heights_of(surface)
    old, new = (
        flux_accuracies(measured, forecasts_of(runtime, replace(twin, model=model), shown, heights))
        for model in (before, after)
    )
    return dict(zip([one.id for one in photographs], (new - old).tolist(), strict=True))


class AccuracyGain(MeanGain):
    """A gain on some photographs."""

    photographs: int = Field(description="Number of photographs.")

    @classmethod
    def of(cls, gain: Gain, photographs: int) -> "AccuracyGain":
        """The gain on a number of photographs."""
        return cls(mean=gain.mean, ci95=(gain.low, gain.high), photographs=photographs)


class ContradictedEffect(BaseModel):
    """An effect that makes photographs after its study worse."""

    effect: str = Field(description="Its name, as `until` of the adoption takes it.")
    study: int = Field(description="The study that found it.")
    until: date = Field(description="First day on which photographs are worse with it.")
    can_end: bool = Field(
        description="Whether it acted before that day, and can be adopted until then."
    )
    gain: AccuracyGain = Field(description="Change of accuracy by it since that day.")

    @property
    def in_words(self) -> str:
        """The contradiction as a clause."""
        return (
            f"{self.effect.replace('_', ' ')} makes {self.gain.photographs} photographs since"
            f" {self.until} worse, by {-100 * self.gain.mean:.1f} points of accuracy in the mean"
        )


def photographs_of_effect(
    session: Session, effect: Effect, study: StudyRow
) -> list[SampledPhotograph]:
    """Choose photographs on which an effect acts; none if all are of its study, or older.

    On days without a fitted photograph an effect by day has its usual value, which only later ones
    judge.
    """
    scope = effect.scope
    if isinstance(scope, ByDay):
        sample = [
            one
            for one in sample_photographs(session)
            if _is_later(one, study) or one.taken_at.date() in scope.by_day
        ]
    else:
        sample = sample_photographs(session, scope.heliostats or effect.heliostats)
    acting = [one for one in sample if effect.at(one.taken_at, one.heliostat) is not None]
    return acting if any(_is_later(one, study) for one in acting) else []


def _is_later(photograph: SampledPhotograph, study: StudyRow) -> bool:
    return photograph.taken_at > (study.last_taken_at or study.created_at)


def find_contradiction(
    effect: Effect,
    study: StudyRow,
    photographs: Sequence[SampledPhotograph],
    gains: Mapping[int, float],
) -> ContradictedEffect | None:
    """Find the day from which photographs are worse with an effect; None if they are not."""
    known = [one for one in photographs if one.id in gains]
    days = [one.taken_at.date() for one in known]
    end = find_end(np.array([gains[one.id] for one in known]), days)
    if end is None:
        return None
    return ContradictedEffect(
        effect=effect_key(effect),
        study=study.id or 0,
        until=end.day,
        can_end=end.day > model_versions.first_day(effect, study),
        gain=AccuracyGain.of(end.gain, sum(day >= end.day for day in days)),
    )


class FieldChange(BaseModel):
    """What the effects of a study change in forecasts of stored photographs.

    A candidate is compared with the current model. An adopted one is what the current model would
    be without its effects. Photographs are some of each day, of heliostats with a surface.
    """

    whole: AccuracyGain = Field(description="On photographs of the whole field.")
    later: AccuracyGain = Field(
        description="On those that came after the last one of the study; zero below two."
    )
    is_harmful: bool = Field(description="Whether later ones are significantly worse.")
    contradicted: list[ContradictedEffect] = Field(
        description="Effects that later photographs contradict."
    )

    @property
    def ends(self) -> dict[str, date]:
        """The days with which contradicted effects can be adopted."""
        return {one.effect: one.until for one in self.contradicted if one.can_end}

    @property
    def in_words(self) -> str:
        """What photographs after the study say, as a clause."""
        points = f"{100 * self.later.mean:+.1f} points"
        said = f"accuracy changes by {points} on {self.later.photographs} photographs after it"
        return "; ".join([said, *(one.in_words for one in self.contradicted)])


def read_field_change(
    runtime: Runtime,
    study: int | StudyRow,
    ends: Ends | None = None,
    known: EffectGains | None = None,
) -> FieldChange:
    """Forecast photographs with and without the effects of a study, that have some ``ends``.

    ``study`` is its number, or a study that is not stored. ``known`` gains are not computed again.
    If it is adopted, and no ends are given, that is the current model with and without them.

    Raises
    ------
    NotFoundError
        If there is no such study.
    ConflictError
        If the study found no effect.
    InvalidInputError
        If ``ends`` are not of its effects.
    """
    with runtime.database.reading() as session:
        study = store.get_study(session, study) if isinstance(study, int) else study
        before = model_versions.get_model(session)
        after = model_versions.model_if_adopted(session, study, ends)
        found = model_versions.effects_of_study(study, ends)
        if not found:
            raise ConflictError(f"study {study.id} found no effect; adopting it changes nothing")
        if not ends and model_versions.find_adopted(session, study.id) is not None:
            # They may have got an end since.
            plain = {effect_text(replace(effect, scope=Always())) for effect in found}
            found = tuple(
                effect
                for effect in before.effects
                if effect_text(replace(effect, scope=Always())) in plain
            )
            before, after = without(before, found), before
        sample = sample_photographs(session)
        acting = [photographs_of_effect(session, effect, study) for effect in found]
    known = known or EffectGains(runtime)
    gains = known.of(sample, before, after)
    later = [gains[one.id] for one in sample if one.id in gains and _is_later(one, study)]
    contradicted = [
        find_contradiction(
            effect, study, photographs, known.of(photographs, without(after, [effect]), after)
        )
        for effect, photographs in zip(found, acting, strict=True)
        if model_versions.is_open(effect)
    ]
    harmful, change = [one for one in contradicted if one is not None], few_gain(np.array(later))
    return FieldChange(
        whole=AccuracyGain.of(few_gain(np.array(list(gains.values()))), len(gains)),
        later=AccuracyGain.of(change, len(later)),
        is_harmful=is_worse(change) or bool(harmful),
        contradicted=harmful,
    )


class ContradictionError(ConflictError):
    """The effects of a study make photographs after it significantly worse."""


def require_no_contradiction(runtime: Runtime, study: int | StudyRow, ends: Ends) -> None:
    """Raise ContradictionError if a study makes photographs after it significantly worse."""
    change = read_field_change(runtime, study, ends)
    if not change.is_harmful:
        return
    until = {key: day.isoformat() for key, day in change.ends.items()}
    remedy = (
        f'adopt it with this end, {{"until": {json.dumps(until)}}}'
        if until and isinstance(study, int)
        else "make another study"
    )
    name = f"study {study}" if isinstance(study, int) else "this report"
    raise ContradictionError(
        f"{name}: {change.in_words}; {remedy}, or force it and give the reason to adopt it"
        " nevertheless"
    )


class AdoptableStudy(NamedTuple):
    """The newest study, whose effects help: what they change with their ``ends``, if any."""

    study: StudyRow
    ends: dict[str, date]
    change: FieldChange


class EffectFindings(NamedTuple):
    """What photographs say of effects: adopted ones, and those of the newest study."""

    contradicted: list[ContradictedEffect]
    adoptable: AdoptableStudy | None = None


class EffectWatch:
    """Compares effects with photographs; gains are computed once."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime, self._gains = runtime, EffectGains(runtime)

    def read(self) -> EffectFindings:
        """Find adopted effects that later photographs contradict, and a study to adopt."""
        with self._runtime.database.reading() as session:
            adopted = model_versions.adopted_effects(session)
            model = model_versions.get_model(session) if adopted else None
            photographs = [photographs_of_effect(session, a.effect, a.study) for a in adopted]
        found = []
        for one, taken in zip(adopted, photographs, strict=True):
            assert model is not None
            gains = self._gains.of(taken, without(model, [one.effect]), model)
            found.append(find_contradiction(one.effect, one.study, taken, gains))
        return EffectFindings([one for one in found if one is not None], self._find_adoptable())

    def _find_adoptable(self) -> AdoptableStudy | None:
        """The newest study that REST adopts without force, and with which photographs are better.

        They are the reason to adopt what leaves most of the error.
        """
        with self._runtime.database.reading() as session:
            studies = store.list_studies(session, Portion(_RECENT))
            states = study_states(session, studies)
        return next((one for row in studies if (one := self._adoptable(row, states[row.id]))), None)

    def _adoptable(self, study: StudyRow, state: StudyState) -> AdoptableStudy | None:
        if state.state != "candidate" or state.warnings:
            return None
        if is_ambiguous(state.findings) or state.findings.is_correction:
            return None
        ends = dict[str, date]()
        change = read_field_change(self._runtime, study.id, None, self._gains)
        if change.is_harmful and change.ends:
            ends = change.ends
            change = read_field_change(self._runtime, study.id, ends, self._gains)
        is_better = not change.is_harmful and change.whole.ci95[0] > 0
        return AdoptableStudy(study, ends, change) if is_better else None
