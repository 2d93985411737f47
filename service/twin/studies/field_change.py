"""What effects change in the accuracies of the whole field, and of photographs after a study.

A study is judged by its photographs. What came later may contradict it: haze ends, a mirror is
cleaned. So some photographs of each day are forecast with and without an effect.
"""

import json
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import date, datetime
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, Field
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.effects import Always, ByDay, Effect
from model.errors import ModelError
from model.metrics import flux_accuracies
from model.study.judging import Gain, few_gain, find_end, is_worse
from service import store
from service.base.errors import ConflictError, ServiceError
from service.store.tables import HeliostatRow, MeasurementRow, StudyRow, SurfaceRow
from service.twin.heliostats.measurements import (
    accepted_measurement,
    heights_of,
    load_heliostat_context,
)
from service.twin.plant import model_versions
from service.twin.plant.model_versions import Ends, ModelVersion, effect_key, effect_text, without
from service.twin.runtime.runtime import Runtime
from service.twin.surfaces.accuracy import forecasts_of

_DAYS, _A_DAY = 60, 6  # days with photographs, and photographs of each


class SampledPhotograph(NamedTuple):
    """A photograph of a known time."""

    id: int
    identifier: str
    heliostat: str
    taken_at: datetime


def sample_photographs(
    session: Session, heliostats: Collection[str] | None = None
) -> list[SampledPhotograph]:
    """Choose some photographs of each of the last days, the newest day first.

    They are of all heliostats with a surface, or of some of them. An ideal mirror would gain by
    every effect that spreads its light.
    """
    row, found = MeasurementRow, list[SampledPhotograph]()
    has_surface = row.heliostat_id.in_(select(SurfaceRow.heliostat_id))
    chosen = [row.accepted, row.arrays.is_not(None), has_surface]
    if heliostats is not None:
        numbers = select(HeliostatRow.id).where(HeliostatRow.name.in_(heliostats))
        chosen.append(row.heliostat_id.in_(numbers))
    newest = select(func.max(row.taken_at)).where(*chosen)
    query = select(row.id, row.identifier, HeliostatRow.name, row.taken_at).where(*chosen)
    query = query.join(HeliostatRow, HeliostatRow.id == row.heliostat_id)
    before = session.scalar(newest)
    for _ in range(_DAYS):
        if before is None:
            break
        day = before.replace(hour=0, minute=0, second=0, microsecond=0)
        taken = query.where(row.taken_at >= day, row.taken_at <= before)
        # Ids times a prime, modulo another: in no order of heliostats or hours.
        scattered = taken.order_by(row.id * 7919 % 1009, row.id).limit(_A_DAY)
        found += [
            SampledPhotograph(number, identifier, name, at)
            for number, identifier, name, at in session.execute(scattered)
            if at is not None
        ]
        before = session.scalar(newest.where(row.taken_at < day))
    return found


def accuracy_gains(
    runtime: Runtime,
    photographs: Iterable[SampledPhotograph],
    before: ModelVersion,
    after: ModelVersion,
) -> dict[int, float]:
    """Changes of accuracy [1] from one model to another with the active surfaces, by row id.

    Photographs that both forecast alike have zero. Those that cannot be forecast are left out.
    """
    old, new = ({effect_text(e): e for e in model.effects} for model in (before, after))
    differing = [effect for key, effect in (old | new).items() if (key in old) != (key in new)]
    gains, changed = dict[int, float](), defaultdict[str, list[SampledPhotograph]](list)
    for one in photographs:
        if any(effect.at(one.taken_at, one.heliostat) is not None for effect in differing):
            changed[one.heliostat].append(one)
        else:
            gains[one.id] = 0.0
    for name, taken in changed.items():
        try:
            gains |= _gains_of_heliostat(runtime, name, taken, before, after)
        except (ModelError, ServiceError):  # deleted since, or not traceable
            continue
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


class AccuracyGain(BaseModel):
    """Mean change of accuracy [1] with its 95 % interval, on some photographs."""

    mean: float = Field(description="Mean change of accuracy [1].")
    ci95: tuple[float, float] = Field(description="Its 95 % interval [1].")
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

    Effects by day are left out: their usual value is none of a single day.
    """
    if isinstance(effect.scope, ByDay):
        return []
    names = effect.scope.heliostats or effect.heliostats
    sample = sample_photographs(session, names)
    acting = [one for one in sample if effect.at(one.taken_at, one.heliostat) is not None]
    return acting if acting and _is_later(acting[0], study) else []


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
        study=study.id,
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


def read_field_change(runtime: Runtime, number: int, ends: Ends | None = None) -> FieldChange:
    """Forecast photographs with and without the effects of a study, that have some ``ends``.

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
        study = store.get_study(session, number)
        before = model_versions.get_model(session)
        after = model_versions.model_if_adopted(session, study, ends)
        found = model_versions.effects_of_study(study, ends)
        if not found:
            raise ConflictError(f"study {number} found no effect; adopting it changes nothing")
        if not ends and model_versions.find_adopted(session, number) is not None:
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
    gains = accuracy_gains(runtime, sample, before, after)
    later = [gains[one.id] for one in sample if one.id in gains and _is_later(one, study)]
    contradicted = [
        find_contradiction(
            effect,
            study,
            photographs,
            accuracy_gains(runtime, photographs, without(after, [effect]), after),
        )
        for effect, photographs in zip(found, acting, strict=True)
        if model_versions.is_open(effect)
    ]
    known, change = [one for one in contradicted if one is not None], few_gain(np.array(later))
    return FieldChange(
        whole=AccuracyGain.of(few_gain(np.array(list(gains.values()))), len(gains)),
        later=AccuracyGain.of(change, len(later)),
        is_harmful=is_worse(change) or bool(known),
        contradicted=known,
    )


class ContradictionError(ConflictError):
    """The effects of a study make photographs after it significantly worse."""


def require_no_contradiction(runtime: Runtime, number: int, ends: Ends) -> None:
    """Raise ContradictionError if a study makes photographs after it significantly worse."""
    change = read_field_change(runtime, number, ends)
    if not change.is_harmful:
        return
    until = {key: day.isoformat() for key, day in change.ends.items()}
    remedy = (
        f'adopt it with this end, {{"until": {json.dumps(until)}}}'
        if until
        else "make another study"
    )
    raise ContradictionError(
        f"study {number}: {change.in_words}; {remedy}, or force it and give the reason to adopt it"
        " nevertheless"
    )


class EffectWatch:
    """Gains of adopted effects on photographs; each is computed once."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._gains: dict[tuple[int, str], dict[int, float]] = {}

    def read(self) -> list[ContradictedEffect]:
        """Find the effects of the current model that photographs after their studies contradict."""
        with self._runtime.database.reading() as session:
            adopted = model_versions.adopted_effects(session)
            model = model_versions.get_model(session) if adopted else None
            photographs = [photographs_of_effect(session, a.effect, a.study) for a in adopted]
        known, self._gains, found = self._gains, {}, []
        for one, taken in zip(adopted, photographs, strict=True):
            assert model is not None
            key = (model.number, effect_text(one.effect))
            gains = known.get(key, {})
            new = [photograph for photograph in taken if photograph.id not in gains]
            reduced = without(model, [one.effect])
            gains = gains | accuracy_gains(self._runtime, new, reduced, model)
            self._gains[key] = {photo.id: gains[photo.id] for photo in taken if photo.id in gains}
            found.append(find_contradiction(one.effect, one.study, taken, gains))
        return [one for one in found if one is not None]
