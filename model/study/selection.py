"""Forward selection of effects, judged on held-out images.

Notes
-----
The score of a held-out image is its flux accuracy, minus the loss by the position of its spot
(`model.study.position`). The gain of an effect is the mean difference of scores with and without
it, with a 95 % interval. An effect is worthwhile if the lower end of the interval is above zero and
the mean is above a minimum.

Of the worthwhile candidates that no held-out image distinguishes from the best, the simplest is
added. If the best has values by day, a much simpler one that gains most of that goes before it:
what it leaves may be another effect's. After each addition effects that are no longer worthwhile
are pruned, and begins are estimated again, or exchanged, where that is better.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.images import FLUX_SIZE
from model.metrics import flux_accuracies
from model.study.flux_images import noise_floor
from model.study.judging import Gain, clustered_gain, few_gain, paired_gain
from model.study.parameters import Term
from model.study.position import EXPECTED, NAT, loss
from model.study.scope_search import ScopeSearch
from model.study.scopes import MAX_SCREENED
from model.study.trials import Trial, TrialFitter

Array = NDArray[np.float64]

MAX_REFITTED = 3
"""Number of the best candidates that are re-fitted jointly with the effects found before."""

MIN_CHANGE = 0.002
"""Share of the light that an effect must move in a forecast for its photograph to judge it."""

MIN_SINGLE_GAIN = 0.01
"""Smallest gain of an effect at one heliostat. Some mirrors of undeclared sets without such an
effect gain up to 0.008: two tracers, surfaces of finite resolution, and faint light in 8 bits
differ by that.
"""

MIN_MOVEMENT = 0.5
"""Standard deviations that an effect must move a spot by for its photograph to judge it."""

MIN_DISTINCTION = 0.001
"""Smallest gain of one effect over another that distinguishes them."""

DATED = 0.5
"""Share of the least gain that is enough for an effect with a date where surfaces are estimates:
what they and the model leave is there before and after it.
"""

SIMPLER, MOST = 4, 2 / 3
"""How many times fewer values than one by day an effect must have, and the share of its gain, to go
before it. Values for each day also absorb what is another effect's.
"""


@dataclass(frozen=True)
class Choice:
    """The candidate to add, its gain and its look-alikes."""

    term: Term
    gain: Gain
    lookalikes: list[Term]


class ForwardSelection:
    """Chooses effects by the gain on held-out images."""

    def __init__(self, fitter: TrialFitter, scopes: ScopeSearch) -> None:
        self.fitter, self.scopes, self.options = fitter, scopes, fitter.options
        self.heliostats = fitter.judged_heliostats
        held_out = [fitter.flux_images[row] for row in fitter.split.held_out]
        with_motors = float(np.mean([p.setup.angles is not None for p in held_out]))
        self.noise = noise_floor(held_out, fitter.window) + NAT * EXPECTED * with_motors

    def refit_best(self, trials: dict[Term, Trial]) -> dict[Term, Trial]:
        """Re-fit the best trials jointly with the effects found before."""
        best = sorted(trials, key=lambda term: -trials[term].score.mean())[:MAX_REFITTED]
        return trials | {
            term: self.fitter.fit(trials[term].parameters.terms, trials[term]) for term in best
        }

    def can_improve(self, current: Trial) -> bool:
        """Whether a model without any error but the images' noise would be worthwhile."""
        return 1 - float(current.score.mean()) - self.noise >= self.options.min_gain

    def gain(self, after: Trial, before: Trial, with_position: bool = True) -> Gain:
        """Return the gain on held-out images, of accuracy alone unless ``with_position``."""
        return paired_gain(
            after.scores(with_position) - before.scores(with_position), self.heliostats
        )

    def gain_where_acting(
        self, term: Term, after: Trial, before: Trial, with_position: bool = True
    ) -> Gain:
        """Return the gain of an effect on the images whose forecast it changes.

        An effect of limited scope changes few held-out images. So it is also fitted to those and
        judged by the images of the first fit: each image judges a fit that did not see it. An
        effect at one heliostat, or with an end, is judged by held-out images alone, since the
        others chose that heliostat or span among many; they judge several choices. An effect by day
        is judged on the days that have a fitted image. One with values for each heliostat must gain
        at several, or it is that of a single one.
        """
        if self.scopes.has_full_scope(term):
            return self.gain(after, before, with_position)
        rows = self.fitter.split.held_out
        judging = np.isin(rows, self.fitter.touched(rows, [term]))
        held_out = _ScoreChanges.of(
            self.fitter.measured[judging],
            _forecasts(before, judging),
            _forecasts(after, judging),
            self.heliostats[judging],
            with_position,
        )
        if term.is_permanent or term.until is not None:
            return few_gain(held_out.changes, among=MAX_SCREENED)
        if with_position and not held_out.changes.sum() > 0:
            return few_gain(held_out.changes)
        fitted = self._cross_fitted(term, after, before, with_position)
        changes = np.concatenate([held_out.changes, fitted.changes])
        names = np.concatenate([held_out.heliostats, fitted.heliostats])
        if not term.is_per_heliostat or not len(changes):
            return few_gain(changes)
        return clustered_gain([changes[names == name] for name in np.unique(names)])

    def _cross_fitted(
        self, term: Term, after: Trial, before: Trial, with_position: bool
    ) -> "_ScoreChanges":
        """Changes of the fitted images, by a fit to the held-out ones."""
        fitter = self.fitter
        crossed = replace(after, values=before.parameters.transfer(before.values, after.parameters))
        moving = fitter.unknowns.of_terms([term])
        crossed = fitter.fit_rows(
            crossed, fitter.touched(fitter.split.held_out, [term]), moving, set()
        )
        rows = fitter.touched(fitter.split.fitted, [term])
        if not len(rows):
            return _ScoreChanges(np.empty(0), np.empty(0, dtype=np.str_))
        judge = fitter.forecasters(rows).fine
        first, second = (
            _Forecasts(judge.cuts(trial.effects), judge.position_residuals(trial.effects))
            for trial in (before, crossed)
        )
        measured, names = judge.measured(FLUX_SIZE), fitter.heliostats[rows]
        return _ScoreChanges.of(measured, first, second, names, with_position)

    def is_worthwhile(self, term: Term, gain: Gain) -> bool:
        """Whether a gain by an effect is significant and large enough."""
        least = self.options.min_gain
        if term.is_permanent and term.heliostats is not None:
            least = max(least, MIN_SINGLE_GAIN)
        elif self.fitter.is_estimated and self.scopes.is_shared_since(term):
            least *= DATED
        return gain.low > 0 and gain.mean >= least

    def choose(self, trials: dict[Term, Trial], current: Trial) -> Choice | None:
        """Choose the candidate to add: the simplest of those that are not distinguished from the
        best.

        Effects of different heliostats are no look-alikes.
        """
        gains = {
            term: self.gain_where_acting(term, trial, current) for term, trial in trials.items()
        }
        significant = {
            term: t for term, t in trials.items() if self.is_worthwhile(term, gains[term])
        }
        if not significant:
            return None
        best = self._best(significant, current)
        alike = [
            term
            for term, t in significant.items()
            if term == best
            or not (term.is_disjoint_from(best) or is_distinct(self.gain(significant[best], t)))
        ]
        alike.sort(
            key=lambda term: (_complexity(term, significant[term]), -significant[term].score.mean())
        )
        chosen, *others = alike
        is_nested = self.scopes.has_full_scope(chosen)
        gain = self._nested_gain(significant, current) if is_nested else gains[chosen]
        return Choice(chosen, gain, others) if self.is_worthwhile(chosen, gain) else None

    def _best(self, trials: dict[Term, Trial], current: Trial) -> Term:
        """The term of the best score; for values by day a much simpler one, if there is any."""
        best = _of_best_score(trials)
        if not best.days:
            return best
        most = _complexity(best, trials[best]) / SIMPLER
        least = MOST * self.gain(trials[best], current).mean
        simpler = {
            term: trial
            for term, trial in trials.items()
            if _complexity(term, trial) <= most and self.gain(trial, current).mean >= least
        }
        return _of_best_score(simpler or trials)

    def _nested_gain(self, trials: dict[Term, Trial], current: Trial) -> Gain:
        """Gain of the best trial: each half of the images judges the choice by the other."""
        second = np.arange(len(self.heliostats)) % 2 == 1
        differences = np.empty(len(second))
        for half in (second, ~second):
            best = trials[_of_best_score(trials, ~half)]
            differences[half] = (best.score - current.score)[half]
        return paired_gain(differences, self.heliostats)


def prune_redundant(selection: ForwardSelection, current: Trial) -> Trial:
    """Remove effects that are no longer worthwhile beside a later one."""
    for term in current.parameters.terms[:-1]:
        rest = [other for other in current.parameters.terms if other != term]
        reduced = selection.fitter.fit(rest, current)
        if not selection.is_worthwhile(term, selection.gain_where_acting(term, current, reduced)):
            current = reduced
    return current


def improve_begins(selection: ForwardSelection, current: Trial) -> Trial:
    """Estimate the begins of effects beside each other, and exchange two, where that is better.

    If a camera is changed within a week of haze, what is found first begins with the week, and what
    is found second has part of the week or begins with the camera.
    """
    fitter, scopes = selection.fitter, selection.scopes
    for terms in _begins_to_try(current.parameters.terms, scopes):
        trial = fitter.fit(terms, current)
        for place, term in enumerate(terms):
            if scopes.is_shared_since(term):
                without = fitter.fit([*terms[:place], *terms[place + 1 :]], trial)
                terms[place], trial = scopes.refine_span(term, trial, without)
        if terms != list(current.parameters.terms):
            trial = fitter.forecast(fitter.fit(terms, trial))
            if is_distinct(selection.gain(trial, current)):
                return trial
    return current


def _begins_to_try(terms: Sequence[Term], scopes: ScopeSearch) -> Iterator[list[Term]]:
    """Several effects as they are, then with the begins of two of all heliostats exchanged."""
    places = [place for place, one in enumerate(terms) if scopes.is_shared_since(one)]
    if places and len(terms) > 1:
        yield list(terms)
    for first, second in combinations(places, 2):
        pairs = (first, second), (second, first)
        changed = {place: replace(terms[place], since=terms[other].since) for place, other in pairs}
        exchanged = [changed.get(place, one) for place, one in enumerate(terms)]
        if exchanged != list(terms) and all(
            one.until is None or (one.since is not None and one.since < one.until)
            for one in exchanged
        ):
            yield exchanged


def _of_best_score(
    trials: dict[Term, Trial], judging: NDArray[np.bool_] | slice = slice(None)
) -> Term:
    """The term of the best mean score on the images that judge; the first, if none does."""
    scores = {term: trial.score[judging] for term, trial in trials.items()}
    return max(scores, key=lambda term: float(scores[term].mean()) if len(scores[term]) else 0.0)


def is_distinct(gain: Gain) -> bool:
    """Whether a gain over another effect is significant, and larger than a fit's error."""
    return gain.low > 0 and gain.mean >= MIN_DISTINCTION


@dataclass(frozen=True, eq=False)
class _Forecasts:
    """Forecast cuts (n, 64, 64) and position residuals (n, 2)."""

    cuts: Array
    position_residuals: Array


def _forecasts(trial: Trial, judging: NDArray[np.bool_]) -> _Forecasts:
    return _Forecasts(trial.cuts[judging], trial.position_residuals[judging])


class _ScoreChanges(NamedTuple):
    """Changes of score (n,) of the images whose forecasts differ, and their heliostats (n,)."""

    changes: Array
    heliostats: NDArray[np.str_]

    @classmethod
    def of(
        cls,
        measured: Array,
        before: _Forecasts,
        after: _Forecasts,
        heliostats: NDArray[np.str_],
        with_position: bool,
    ) -> "_ScoreChanges":
        """Compare forecasts of all images (m, 64, 64) that were ``measured``."""
        moved = np.nan_to_num(
            np.linalg.norm(after.position_residuals - before.position_residuals, axis=-1)
        )
        unlike = 1 - flux_accuracies(before.cuts, after.cuts) > MIN_CHANGE
        differ = unlike | (moved > MIN_MOVEMENT)
        first, second = (
            flux_accuracies(measured, forecasts.cuts)
            - with_position * NAT * loss(forecasts.position_residuals)
            for forecasts in (before, after)
        )
        return cls((second - first)[differ], heliostats[differ])


def _complexity(term: Term, trial: Trial) -> int:
    """Number of values of a term; each date and a heliostat's name count as one."""
    numbers = sum(u.term == term for u in trial.parameters.all)
    scope = (term.since, term.until, term.heliostats)
    return numbers + sum(part is not None for part in scope)
