"""Search the scopes of effects: the heliostat that has one, and when it begins and ends."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect
from model.study.flux_images import FluxImage
from model.study.judging import Rows
from model.study.parameters import Term
from model.study.scopes import (
    MAX_SCREENED,
    MIN_SHARE_OF_BEST,
    STRENGTHS,
    ScopeCandidate,
    best_span,
    single_heliostat_scopes,
    time_scopes,
)
from model.study.trials import Trial, TrialFitter

Array = NDArray[np.float64]

MAX_SPAN_ITERATIONS = 3
"""Largest number of alternating fits of a span and of the values in it."""


class ScopedTrial(NamedTuple):
    """An effect in a scope, and the trial with it."""

    term: Term
    trial: Trial


class DatedImages(NamedTuple):
    """Rows of images with a known day, and their days."""

    rows: Rows
    days: list[date]


class ScopeSearch:
    """Finds scopes in which effects explain photographs better than always and everywhere."""

    def __init__(self, fitter: TrialFitter) -> None:
        self.fitter = fitter
        self.first_uncalibrated = _first_uncalibrated(fitter.flux_images)

    def full_scope(self, kind: type[Effect]) -> Term:
        """Return an effect in its longest scope: always, or since all mounts' calibrations."""
        moves = kind.on_mount is not Effect.on_mount or kind.on_sun is not Effect.on_sun
        return Term(kind, since=self.first_uncalibrated if moves else None)

    def has_full_scope(self, term: Term) -> bool:
        """Whether an effect acts in its longest scope, at all heliostats."""
        return term == self.full_scope(term.kind)

    def is_shared_since(self, term: Term) -> bool:
        """Whether an effect of all heliostats began on a day that was searched."""
        return bool(term.since) and term.heliostats is None and not self.has_full_scope(term)

    def fit_scopes(self, trials: dict[Term, Trial], current: Trial) -> dict[Term, Trial]:
        """Fit effects in the most promising limited scopes."""
        fitter = self.fitter
        rows, heliostats = fitter.split.fitted, fitter.heliostats[fitter.split.fitted]
        dated, days = self._dated(rows)
        known = np.isin(rows, dated)
        in_time: list[ScopeCandidate] = []
        single: list[ScopeCandidate] = []
        before = fitter.costs(rows, current.parameters, current.values[None])
        for term, trial in trials.items():
            if fitter.days is not None or term.kind.of_heliostats:
                saved = before - self._costs_without_scope(trial, term, rows, STRENGTHS)
                in_time += time_scopes(term.kind, saved[:, known], days, heliostats[known])
                single += single_heliostat_scopes(term.kind, saved, heliostats)
        best = [
            term
            for found in (in_time, single)
            for term in most_promising(found, current.parameters.terms)
        ]
        return dict(self._fit_span(term, current, dated) for term in best)

    def refine_span(self, term: Term, trial: Trial, current: Trial) -> ScopedTrial:
        """Re-estimate begin and end of a judged effect from all photographs, also held-out ones."""
        begins = term.since is not None and not self.has_full_scope(term)
        everything = np.arange(len(self.fitter.flux_images))
        scoped = self._in_best_span(term, trial, current, everything) if begins else None
        if scoped is None:
            return ScopedTrial(term, trial)
        return ScopedTrial(scoped, trial.with_scope(term, scoped))

    def _costs_without_scope(
        self, trial: Trial, term: Term, rows: Rows, strengths: Sequence[float]
    ) -> Array:
        """Costs (strengths, n) of images if an effect acted always, at some strengths."""
        terms = tuple(
            self._from_the_first(term) if other == term else other
            for other in trial.parameters.terms
        )
        parameters = self.fitter.unknowns.of_terms(terms)
        is_moved = np.array([u.term == term for u in trial.parameters.all])
        away = np.where(is_moved, trial.values - trial.parameters.neutral, 0.0)
        values = [np.clip(trial.values + (s - 1) * away, *parameters.bounds) for s in strengths]
        return self.fitter.costs(rows, parameters, np.array(values))

    def _from_the_first(self, term: Term) -> Term:
        return replace(term, since=self.full_scope(term.kind).since, until=None)

    def _fit_span(self, term: Term, current: Trial, rows: Rows) -> ScopedTrial:
        """Fit an effect in its scope; begin, end and the values between are fitted in turn."""
        trial = self.fitter.fit_added(term, current)
        for _ in range(MAX_SPAN_ITERATIONS if term.since is not None else 0):
            scoped = self._in_best_span(term, trial, current, rows)
            if scoped is None:
                break
            term, trial = scoped, self.fitter.fit_added(scoped, current)
        return ScopedTrial(term, trial)

    def _in_best_span(self, term: Term, trial: Trial, current: Trial, rows: Rows) -> Term | None:
        """Return an effect in the span that reduces the costs of some images most, if it is new."""
        rows, days = self._dated(self.fitter.touched(rows, [self._from_the_first(term)]))
        before = self.fitter.costs(rows, current.parameters, current.values[None])
        found = best_span(before - self._costs_without_scope(trial, term, rows, (1.0,)), days)
        scoped = term if found is None else found.of(term)
        return None if scoped in (term, *current.parameters.terms) else scoped

    def _dated(self, rows: Rows) -> DatedImages:
        """Select the images with a known day."""
        days = self.fitter.days or [None] * len(self.fitter.flux_images)
        known = [(row, day) for row in rows.tolist() if (day := days[row]) is not None]
        rows = np.array([row for row, _ in known], dtype=np.int64)
        return DatedImages(rows, [day for _, day in known])


def _first_uncalibrated(flux_images: Sequence[FluxImage]) -> date | None:
    """Return the day of the first photograph with motors after all calibrations of mounts."""
    mounts = [p.setup.heliostat.mount for p in flux_images]
    if not any(mount.is_calibrated for mount in mounts):
        return None
    until = [mount.calibrated_until for mount in mounts if mount.calibrated_until is not None]
    days = [
        p.taken_at.date()
        for p in flux_images
        if p.setup.angles is not None and p.taken_at is not None
    ]
    return min((day for day in days if day > max(until, default=date.max)), default=None)


def most_promising(found: Sequence[ScopeCandidate], known: Sequence[Term]) -> list[Term]:
    """Return the most promising new scopes, of effects that only move spots apart from others.

    A target that moved costs more than any change of a shape.
    """
    new = [candidate for candidate in found if candidate.term not in known]
    return [
        term
        for only_moves in (False, True)
        for term in _screened([one for one in new if one.term.kind.only_moves == only_moves])
    ]


def _screened(found: Sequence[ScopeCandidate]) -> list[Term]:
    best = sorted(found, key=lambda one: -one.saved)[:MAX_SCREENED]
    return [one.term for one in best if one.saved > MIN_SHARE_OF_BEST * best[0].saved]
