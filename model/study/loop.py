"""The loop: fit every candidate, keep the one that images it never saw gain from, and go on from there."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import date

import numpy as np
from numpy.typing import NDArray

from model.effects import CATALOGUE, Always, ByDay, Effect
from model.errors import InvalidInputError
from model.forecast import View
from model.images import FLUX_SIZE
from model.metrics import flux_accuracies
from model.study.fitting import Fitter
from model.study.flux_images import FluxImage, Forecaster, noise_floor, spot_window
from model.study.judging import Gain, Rows, Split, few_gain, paired_gain, split
from model.study.position import EXPECTED, NAT, loss
from model.study.report import Candidate, Found, Study
from model.study.scopes import OF_THE_BEST, SCREENED, STRENGTHS, Promise, alone, change, days_of, promises
from model.study.unknowns import Term, Unknowns
from model.tracing import Optics

Array = NDArray[np.float64]

LEAST_IMAGES = 4

REFITTED = 3
"""How many of the best candidates are fitted once more, jointly with the effects found before."""


SETTLING = 3
"""How often a change's date and what changed are sought in turn."""

CHANGED = 0.002
"""Share of the light that an effect must move in a forecast for its photograph to say something of it."""

LEAST_ALONE = 0.01
"""Accuracy that an effect which one heliostat has alone must gain there: some mirrors of undeclared sets that have none
gain up to 0.008, where two tracers, surfaces of finite resolution or what 8 bits leave of faint light differ."""

MOVED = 0.5
"""Standard deviations that an effect must move a spot by for its photograph to say something of it."""

LEAST_DIFFERENCE = 0.001
"""Accuracy that one effect must gain more than another on the same images to be told from it."""


@dataclass(frozen=True)
class StudyOptions:
    """How a study is made.

    ``least_gain`` of accuracy is what an effect must bring to be worth its place in a model; at the ``most`` so many
    effects are added. ``window`` [m] is that of the spots unless given. ``candidates`` are names of the catalogue.
    """

    candidates: tuple[str, ...] = tuple(CATALOGUE)
    least_gain: float = 0.004
    most: int = 3
    window: float | None = None
    fit_view: View = field(default_factory=lambda: View(64, 64, samples=12, padding=0.125))
    view: View = field(default_factory=lambda: View(128, 128, samples=24))


@dataclass(frozen=True, eq=False)
class Trial:
    """A model with some effects, fitted.

    Attributes
    ----------
    unknowns : Unknowns
    values, spread : (P,)
        Of the unknowns, and their standard deviations.
    cuts : (H, 64, 64)
        Forecasts of the held-out images.
    accuracy : (H,)
        Of those.
    off : (H, 2)
        How far the held-out spots lie from where motors sent them, in independent standard deviations; NaN where not
        known.
    """

    unknowns: Unknowns
    values: Array
    spread: Array
    cuts: Array
    accuracy: Array
    off: Array

    @property
    def score(self) -> Array:
        """Accuracy (H,) of the held-out images, less the loss by where they lie."""
        return self.scored(place=True)

    def scored(self, place: bool) -> Array:
        """`score`, or accuracy alone."""
        return self.accuracy - place * NAT * loss(self.off)

    @property
    def effects(self) -> list[Effect]:
        """The fitted effects."""
        return self.unknowns.effects(self.values)

    def redated(self, term: Term, since: date) -> "Trial":
        """The same with one effect since another day."""
        later = replace(term, since=since)
        terms = tuple(later if one == term else one for one in self.unknowns.terms)
        return replace(self, unknowns=Unknowns(terms, self.unknowns.facets))


class _Loop:
    """One study while it goes on."""

    def __init__(
        self,
        flux_images: Sequence[FluxImage],
        optics: Optics,
        declared: Sequence[Effect],
        options: StudyOptions,
        latitude_deg: float,
    ) -> None:
        self.flux_images, self.options = flux_images, options
        self.optics, self.declared, self.latitude_deg = optics, declared, latitude_deg
        self.window = options.window or spot_window(flux_images)
        self.split: Split = split(flux_images)
        self.facets = tuple(sorted({(p.heliostat, len(p.setup.control_points)) for p in flux_images}))
        self.days = days_of(flux_images)
        self.all_heliostats = np.array([p.heliostat for p in flux_images])
        self.judge = self._forecaster(self.split.held_out, options.view)
        self.measured = self.judge.measured(FLUX_SIZE)
        self.heliostats = self.all_heliostats[self.split.held_out]
        held_out = [flux_images[row] for row in self.split.held_out]
        known = [p.setup.angles is not None for p in held_out]
        self.noise = noise_floor(held_out, self.window) + NAT * EXPECTED * float(np.mean(known))
        self.since = _first_uncalibrated(flux_images)
        self._pairs: dict[bytes, tuple[Forecaster, Forecaster]] = {}

    def _forecaster(self, rows: Rows, view: View) -> Forecaster:
        chosen = [self.flux_images[row] for row in rows]
        return Forecaster(chosen, self.optics, self.declared, self.window, view, latitude_deg=self.latitude_deg)

    def _pair(self, rows: Rows) -> tuple[Forecaster, Forecaster]:
        """A coarse and a fine forecaster of some images."""
        key = rows.tobytes()
        if key not in self._pairs:
            views = self.options.fit_view, self.options.view
            self._pairs[key] = self._forecaster(rows, views[0]), self._forecaster(rows, views[1])
        return self._pairs[key]

    def touched(self, rows: Rows, terms: Iterable[Term]) -> Rows:
        """Those of some images that one of the terms may change."""
        known, some = [self.flux_images[row] for row in rows], list(terms)
        return rows[[any(term.touches(p.heliostat, p.taken_at) for term in some) for p in known]]

    # --- fits ---------------------------------------------------------------------------------------------------------

    def trial(self, terms: Sequence[Term], start: Trial | None = None, joint: bool = True) -> Trial:
        """Fit effects, from where ``start`` has fitted some of them, and judge them.

        All of them, unless ``joint`` is false: then those that ``start`` knows stay as they are.
        """
        whole = Unknowns(tuple(terms), self.facets)
        trial = Trial(whole, whole.neutral, np.zeros(len(whole.all)), *(np.empty(0) for _ in range(3)))
        known: set[Term] = set()
        if start is not None:
            values, spread = (start.unknowns.put(v, whole) for v in (start.values, start.spread))
            trial, known = replace(trial, values=values, spread=spread), set(start.unknowns.terms)
        for rows, unknowns in self._parts(whole):
            moving = unknowns if joint else unknowns.without(known)
            trial = self._fitted(trial, self.touched(rows, moving.terms), moving, known)
        return self.judged(trial)

    def _parts(self, whole: Unknowns) -> list[tuple[Rows, Unknowns]]:
        """What is fitted to which images: to those of the heliostat that is kept apart only what is its own.

        A day has its haze for all heliostats; where an effect comes by day, none is kept apart.
        """
        if any(term.days for term in whole.terms):
            return [(self.split.fitted, whole)]
        return [(self.split.fit, whole), (self.split.own, whole.own)]

    def judged(self, trial: Trial) -> Trial:
        """The trial with its forecasts of the held-out images."""
        cuts, off = self.judge.cuts(trial.effects), self.judge.off(trial.effects)
        return replace(trial, cuts=cuts, accuracy=flux_accuracies(self.measured, cuts), off=off)

    def _fitted(self, trial: Trial, rows: Rows, unknowns: Unknowns, known: set[Term]) -> Trial:
        """The trial with those unknowns fitted that some photographs can tell of."""
        local = unknowns.of(sorted(set(self.all_heliostats[rows].tolist())))
        if not local.all or not len(rows):
            return trial
        fixed = trial.unknowns.without(unknowns.terms)
        fitter = Fitter(*self._pair(rows), fixed=fixed.effects(trial.unknowns.put(trial.values, fixed)))
        free = np.array([u.term not in known for u in local.all], dtype=bool)
        fit = fitter.fit(local, trial.unknowns.put(trial.values, local), free)
        values, spread = trial.values.copy(), trial.spread.copy()
        places = [trial.unknowns.all.index(u) for u in local.all]
        values[places], spread[places] = fit.values, fit.spread
        return replace(trial, values=values, spread=spread)

    def added(self, term: Term, current: Trial) -> Trial:
        """The current model with one more effect, fitted beside what is known."""
        return self.trial([*current.unknowns.terms, term], current, joint=False)

    def refitted(self, trials: dict[Term, Trial]) -> dict[Term, Trial]:
        """Trials, the best of them fitted once more from where they are, jointly with what was known before."""
        best = sorted(trials, key=lambda term: -trials[term].score.mean())[:REFITTED]
        joint = {term: self.trial(trials[term].unknowns.terms, trials[term]) for term in best}
        return trials | joint

    def whole(self, kind: type[Effect]) -> Term:
        """An effect as long as it could act: always, on calibrated mounts since the first photograph thereafter."""
        moves = kind.on_mount is not Effect.on_mount or kind.on_sun is not Effect.on_sun
        return Term(kind, since=self.since if moves else None)

    def is_whole(self, term: Term) -> bool:
        """Whether an effect acts as long as it could, everywhere."""
        return term == self.whole(term.kind)

    # --- scopes -------------------------------------------------------------------------------------------------------

    def scoped(self, trials: dict[Term, Trial], current: Trial) -> dict[Term, Trial]:
        """Effects that are not always there, or not everywhere, fitted: those of the most promising scopes."""
        rows, heliostats = self.split.fitted, self.all_heliostats[self.split.fitted]
        dated, days = self._dated(rows)
        known = np.isin(rows, dated)
        of_time: list[Promise] = []
        of_one: list[Promise] = []
        before = self._costs(rows, current.unknowns, current.values[None])
        for term, trial in trials.items():
            if self.days is not None or term.kind.of_heliostats:
                saved = before - self._costs_without_scope(trial, term, rows, STRENGTHS)
                of_time += promises(term.kind, saved[:, known], days, heliostats[known])
                of_one += alone(term.kind, saved, heliostats)
        best = [term for found in (of_time, of_one) for term in _screened(found, current.unknowns.terms)]
        return dict(self._settled(term, current, dated) for term in best)

    def _costs(self, rows: Rows, unknowns: Unknowns, trials: Array) -> Array:
        """What each of some images (M, n) costs under trials (M, P)."""
        return np.asarray((Fitter(*self._pair(rows)).residuals_of(unknowns, trials) ** 2).sum(axis=-1) / 2)

    def _costs_without_scope(self, trial: Trial, term: Term, rows: Rows, strengths: Sequence[float]) -> Array:
        """What each of some images costs (strengths, n) if an effect were always there, at multiples of its fit."""
        terms = tuple(self._from_the_first(term) if one == term else one for one in trial.unknowns.terms)
        unknowns, moved = Unknowns(terms, self.facets), np.array([u.term == term for u in trial.unknowns.all])
        away = np.where(moved, trial.values - trial.unknowns.neutral, 0.0)
        tried = [np.clip(trial.values + (s - 1) * away, *unknowns.bounds) for s in strengths]
        return self._costs(rows, unknowns, np.array(tried))

    def _from_the_first(self, term: Term) -> Term:
        return replace(term, since=self.whole(term.kind).since)

    def _settled(self, term: Term, current: Trial, rows: Rows) -> tuple[Term, Trial]:
        """An effect in its scope, fitted; one since a day since that from which on its fit saves most."""
        trial = self.added(term, current)
        for _ in range(SETTLING if term.since is not None else 0):
            day = self._changed(term, trial, current, rows)
            if day is None or day == term.since or replace(term, since=day) in current.unknowns.terms:
                break
            term = replace(term, since=day)
            trial = self.added(term, current)
        return term, trial

    def _changed(self, term: Term, trial: Trial, current: Trial, rows: Rows) -> date | None:
        """The day from which on photographs among some save most by an effect as it was fitted."""
        rows, days = self._dated(self.touched(rows, [self._from_the_first(term)]))
        before = self._costs(rows, current.unknowns, current.values[None])
        found = change(before - self._costs_without_scope(trial, term, rows, (1.0,)), days)
        return None if found is None else found[0]

    def _dated(self, rows: Rows) -> tuple[Rows, list[date]]:
        """Those of some images whose day is known, and the days."""
        days = self.days or [None] * len(self.flux_images)
        known = [(row, day) for row in rows.tolist() if (day := days[row]) is not None]
        return np.array([row for row, _ in known], dtype=np.int64), [day for _, day in known]

    def dated(self, term: Term, trial: Trial, current: Trial) -> tuple[Term, Trial]:
        """An effect that was judged since the day that all photographs name, also those that judged it."""
        comes = term.since is not None and not self.is_whole(term)
        day = self._changed(term, trial, current, np.arange(len(self.flux_images))) if comes else None
        if day is None or day == term.since or replace(term, since=day) in current.unknowns.terms:
            return term, trial
        return replace(term, since=day), trial.redated(term, day)

    # --- judgement ----------------------------------------------------------------------------------------------------

    def worth_adding_to(self, current: Trial) -> bool:
        """Whether even the truth, which leaves the images' noise, could bring the gain that an effect must bring."""
        return 1 - float(current.score.mean()) - self.noise >= self.options.least_gain

    def gain(self, after: Trial, before: Trial, place: bool = True) -> Gain:
        """What ``after`` is better by on held-out images, by their shapes alone unless ``place``."""
        return paired_gain(after.scored(place) - before.scored(place), self.heliostats)

    def own_gain(self, term: Term, after: Trial, before: Trial, place: bool = True) -> Gain:
        """What an effect gains where it acts: on the held-out images whose forecast it changes.

        One that is not always there acts on few of them. So it is fitted once more to those, and judged by the images
        that it was fitted to first: every image that it changes judges once, by a fit that did not see it. But where
        those chose a heliostat among many, only images that had no say in that judge, and they judge several choices.
        """
        if self.is_whole(term):
            return self.gain(after, before, place)
        held_out = _changes(self.measured, (before.cuts, before.off), (after.cuts, after.off), place)
        if term.always:
            return few_gain(held_out, among=SCREENED)
        if place and not held_out.sum() > 0:
            return few_gain(held_out)
        return few_gain(np.concatenate([held_out, self._crossed(term, after, before, place)]))

    def _crossed(self, term: Term, after: Trial, before: Trial, place: bool) -> Array:
        """Changes of score (n,) of images that were fitted, by an effect fitted to those held out."""
        crossed = replace(after, values=before.unknowns.put(before.values, after.unknowns))
        moving = Unknowns((term,), self.facets)
        crossed = self._fitted(crossed, self.touched(self.split.held_out, [term]), moving, set())
        rows = self.touched(self.split.fitted, [term])
        if not len(rows):
            return np.empty(0)
        judge = self._pair(rows)[1]
        first, second = ((judge.cuts(trial.effects), judge.off(trial.effects)) for trial in (before, crossed))
        return _changes(judge.measured(FLUX_SIZE), first, second, place)

    def counts(self, term: Term, gain: Gain) -> bool:
        """Whether a gain by an effect is both significant and worth having."""
        least = LEAST_ALONE if term.always and term.heliostats is not None else 0.0
        return gain.low > 0 and gain.mean >= max(least, self.options.least_gain)

    @staticmethod
    def distinguishes(gain: Gain) -> bool:
        """Whether a gain of one effect over another is significant, and more than what fits may differ by."""
        return gain.low > 0 and gain.mean >= LEAST_DIFFERENCE

    def choose(self, trials: dict[Term, Trial], current: Trial) -> tuple[Term, Gain, list[Term]] | None:
        """The candidate to add, its gain and its look-alikes, or None.

        Of those that no held-out image tells from the best one the simplest is taken; what other heliostats have is
        nothing alike.
        """
        gains = {term: self.own_gain(term, trial, current) for term, trial in trials.items()}
        significant = {term: t for term, t in trials.items() if self.counts(term, gains[term])}
        if not significant:
            return None
        best = max(significant, key=lambda term: significant[term].score.mean())
        alike = [
            term
            for term, t in significant.items()
            if term == best or not (term.is_apart_from(best) or self.distinguishes(self.gain(significant[best], t)))
        ]
        alike.sort(key=lambda term: (_complexity(term, significant[term]), -significant[term].score.mean()))
        chosen, *others = alike
        gain = gains[chosen] if not self.is_whole(chosen) else self._nested_gain(significant, current)
        return (chosen, gain, others) if self.counts(chosen, gain) else None

    def _nested_gain(self, trials: dict[Term, Trial], current: Trial) -> Gain:
        """What the best of some trials gains on images that did not choose it: each half judges the other's choice."""
        second = np.arange(len(self.heliostats)) % 2 == 1
        differences = np.empty(len(second))
        for half in (second, ~second):
            best = max(trials.values(), key=lambda t: t.score[~half].mean() if (~half).any() else 0.0)
            differences[half] = (best.score - current.score)[half]
        return paired_gain(differences, self.heliostats)

    def without_idle(self, current: Trial) -> Trial:
        """The trial without effects that a later one has made idle."""
        for term in current.unknowns.terms[:-1]:
            rest = [one for one in current.unknowns.terms if one != term]
            less = self.trial(rest, current)
            if not self.counts(term, self.own_gain(term, current, less)):
                current = less
        return current


def _changes(measured: Array, before: tuple[Array, Array], after: tuple[Array, Array], place: bool) -> Array:
    """Changes of score (n,) of the images whose forecasts, cuts and how far spots lie off, differ."""
    moved = np.nan_to_num(np.linalg.norm(after[1] - before[1], axis=-1))
    differ = (1 - flux_accuracies(before[0], after[0]) > CHANGED) | (moved > MOVED)
    first, second = (flux_accuracies(measured, cuts) - place * NAT * loss(off) for cuts, off in (before, after))
    return np.asarray((second - first)[differ])


def _first_uncalibrated(flux_images: Sequence[FluxImage]) -> date | None:
    """The day of the first photograph with motors after all that mounts were calibrated by; None without such."""
    mounts = [p.setup.heliostat.mount for p in flux_images]
    if not any(mount.is_calibrated for mount in mounts):
        return None
    until = [mount.calibrated_until for mount in mounts if mount.calibrated_until is not None]
    told = [p.taken_at.date() for p in flux_images if p.setup.angles is not None and p.taken_at is not None]
    return min((day for day in told if day > max(until, default=date.max)), default=None)


def _screened(found: Sequence[Promise], known: Sequence[Term]) -> list[Term]:
    """The most promising ones that are not known yet."""
    new = sorted((one for one in found if one.term not in known), key=lambda promise: -promise.saved)
    return [promise.term for promise in new[:SCREENED] if promise.saved > OF_THE_BEST * new[0].saved]


def _complexity(term: Term, trial: Trial) -> int:
    """How many numbers a term takes; a date is one, and so is a heliostat's name."""
    numbers = sum(u.term == term for u in trial.unknowns.all)
    return numbers + (term.since is not None) + (term.heliostats is not None)


def study(
    flux_images: Sequence[FluxImage],
    optics: Optics,
    effects: Sequence[Effect] = (),
    options: StudyOptions | None = None,
    progress: Callable[[str], None] = lambda message: None,
    *,
    latitude_deg: float,
) -> Study:
    """Which effects photographs demand that a model with these optics and effects lacks, when, and what they buy.

    Parameters
    ----------
    flux_images : sequence of FluxImage
        With surfaces that are believed; at least four, better several heliostats under many suns. Where all have their
        times, effects that come at a date or by day are found as such.
    optics, effects
        The declared model.
    progress : callable
        Told what is being fitted.
    latitude_deg : float [deg]
        Of the plant.

    Raises
    ------
    InvalidInputError
        For too few photographs or two of one name.
    UnreachableError
        Where no attitude reflects the sun to a measured spot.
    """
    options = options or StudyOptions()
    if len(flux_images) < LEAST_IMAGES:
        raise InvalidInputError(f"a study takes at least {LEAST_IMAGES} photographs, got {len(flux_images)}")
    if len({p.key for p in flux_images}) < len(flux_images):
        raise InvalidInputError("photographs of a study must have identifiers of their own")
    loop = _Loop(flux_images, optics, effects, options, latitude_deg)
    # What has changed once may change again, and what one heliostat has others may have.
    declared = {effect.name for effect in effects if effect.scope == Always() or isinstance(effect.scope, ByDay)}
    before = current = loop.trial([])
    found: dict[Term, Found] = {}
    candidates: list[Candidate] = []
    told = any(p.setup.angles is not None for p in flux_images)
    kinds = [CATALOGUE[name] for name in options.candidates if name not in declared]
    left = [loop.whole(kind) for kind in kinds if told or not kind.only_moves]
    for _ in range(options.most):
        if found and not loop.worth_adding_to(current):
            break
        trials = {}
        for term in left:
            progress(term.kind.name)
            trials[term] = loop.added(term, current)
        progress("changes, days and single heliostats")
        trials |= loop.scoped(trials, current)
        trials = loop.refitted(trials)
        candidates = candidates or [
            Candidate(term.kind.name, float(t.accuracy.mean()), loop.gain(t, before), loop.gain(t, before, place=False))
            for term, t in trials.items()
            if loop.is_whole(term)
        ]
        chosen = loop.choose(trials, current)
        if chosen is None:
            break
        term, gain, others = chosen
        dated, trial = loop.dated(term, trials[term], current)
        shape = loop.own_gain(term, trials[term], current, place=False) if told else gain
        found[dated] = Found(term.kind.name, gain, shape, _names(term, others))
        current = loop.without_idle(loop.judged(trial) if dated != term else trial)
        found = {known: one for known, one in found.items() if known in current.unknowns.terms}
        left = [one for one in left if one.kind is not term.kind or term.heliostats is not None]
    held_out = [flux_images[row] for row in loop.split.held_out]
    return Study(
        images=held_out,
        fitted=len(flux_images) - len(held_out),
        window=loop.window,
        measured=loop.measured,
        before=loop.judge.cuts([]),
        after=loop.judge.cuts(current.effects),
        off_before=before.off,
        off_after=current.off,
        displaced_before=loop.judge.displaced([]),
        displaced_after=loop.judge.displaced(current.effects),
        found=[one.fitted(term, current.unknowns, current.values, current.spread) for term, one in found.items()],
        candidates=sorted(candidates, key=lambda c: -c.gain.mean),
        effects=current.effects,
        latitude_deg=latitude_deg,
    )


def _names(term: Term, others: Sequence[Term]) -> list[str]:
    """The kinds of look-alikes, each once, but for the term's own in another scope."""
    return list(dict.fromkeys(other.kind.name for other in others if other.kind is not term.kind))
