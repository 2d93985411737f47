"""What effects change in the accuracies of the whole field, and of photographs after a study.

A study is judged by its photographs. What came later may contradict it: haze ends, a mirror is
cleaned. So some photographs of each day are forecast with and without an effect.
"""

import json
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime
from typing import NamedTuple

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from model.effects import ByDay, Effect
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


@dataclass(frozen=True, eq=False)
class ContradictedEffect:
    """An effect of a study that later photographs contradict.

    Attributes
    ----------
    key : str
        See `service.twin.plant.model_versions.effect_key`.
    study : int
    until : date
        First day without it.
    gain : Gain
        Of accuracy [1] by it since then.
    photographs : int
    can_end : bool
        Whether it acted before that day. If not, it never made photographs better.
    """

    key: str
    study: int
    until: date
    gain: Gain
    photographs: int
    can_end: bool

    @property
    def in_words(self) -> str:
        """The contradiction as a clause."""
        return (
            f"{self.key.replace('_', ' ')} makes {self.photographs} photographs since {self.until}"
            f" worse, by {-100 * self.gain.mean:.1f} points of accuracy in the mean"
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
        effect_key(effect),
        study.id,
        end.day,
        end.gain,
        sum(day >= end.day for day in days),
        end.day > model_versions.first_day(effect, study),
    )


@dataclass(frozen=True, eq=False)
class FieldChange:
    """Gain of a study's effects on photographs of the field, and on those after the study.

    Attributes
    ----------
    whole, later : Gain
        Mean changes of accuracy [1], zero included where nothing changes.
    n_whole, n_later : int
        Numbers of photographs.
    contradicted : tuple of ContradictedEffect
    """

    whole: Gain
    later: Gain
    n_whole: int
    n_later: int
    contradicted: tuple[ContradictedEffect, ...]

    @property
    def is_harmful(self) -> bool:
        """Whether photographs after the study are significantly worse."""
        return is_worse(self.later) or bool(self.contradicted)

    @property
    def ends(self) -> dict[str, date]:
        """The days with which contradicted effects can be adopted."""
        return {one.key: one.until for one in self.contradicted if one.can_end}

    @property
    def in_words(self) -> str:
        """What photographs after the study say, as a clause."""
        change = f"by {100 * self.later.mean:+.1f} points on {self.n_later} photographs after it"
        return "; ".join(
            [f"accuracy changes {change}", *(one.in_words for one in self.contradicted)]
        )


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
    return FieldChange(
        few_gain(np.array(list(gains.values()))),
        few_gain(np.array(later)),
        len(gains),
        len(later),
        tuple(one for one in contradicted if one is not None),
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
