"""The closed loop: add the effect with the largest gain, until none is worthwhile."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from model.effects import CATALOGUE, Always, ByDay, Effect
from model.effects.catalogue import ORDER
from model.errors import InvalidInputError
from model.forecast import align
from model.plant_model import PlantModel
from model.study.discrepancy import find_discrepancy
from model.study.flux_images import FluxImage, without_hot_pixels
from model.study.halves import find_drifts
from model.study.outcome import MIN_RIVAL, Candidate, Found, Study
from model.study.parameters import Term
from model.study.scope_search import ScopeSearch
from model.study.selection import ForwardSelection, improve_begins, prune_redundant
from model.study.trials import StudyOptions, Trial, TrialFitter

MIN_IMAGES = 4

FEWER, MIN_UNKNOWN = 4, 2
"""A generic term contradicts effects that gain no more with so many times its coefficients; the
simplest terms have two.
"""


def study(
    flux_images: Sequence[FluxImage],
    model: PlantModel,
    options: StudyOptions | None = None,
    progress: Callable[[str], None] = lambda message: None,
) -> Study:
    """Find the effects that photographs demand and the declared model lacks.

    Parameters
    ----------
    flux_images : sequence of FluxImage
        With surfaces; at least four, better of several heliostats under many suns. Effects that
        begin or end on a day, or differ by day, are found if the photographs have times.
    model : PlantModel
        The declared model.
    progress : callable
        Receives the name of what is being fitted.

    Raises
    ------
    InvalidInputError
        For too few photographs, or two with one name.
    UnreachableError
        If no attitude reflects the sun to a measured spot.
    """
    options = options or StudyOptions()
    _check(flux_images)
    flux_images = without_hot_pixels(flux_images)
    fitter = TrialFitter(flux_images, model, options)
    _check_own(flux_images, model, options)
    scopes = ScopeSearch(fitter)
    selection = ForwardSelection(fitter, scopes)
    before = current = fitter.fit([])
    found: dict[Term, Found] = {}
    candidates: list[Candidate] = []
    has_motors = any(p.setup.angles is not None for p in flux_images)
    has_neighbours = any(p.setup.neighbours is not None for p in flux_images)
    left = [
        term
        for term in _candidate_terms(scopes, model.effects, options)
        if (has_motors or not term.kind.only_moves)
        and (has_neighbours or not term.kind.needs_neighbours)
    ]
    left_to_find, is_retried = options.most, False
    while left_to_find and (not found or selection.can_improve(current)):
        left_to_find -= 1
        trials = {}
        for term in left:
            progress(term.kind.name)
            trials[term] = fitter.fit_added(term, current)
        progress("changes, days and single heliostats")
        trials |= scopes.fit_scopes(trials, current)
        trials = selection.refit_best(trials)
        candidates = candidates or _candidates(selection, trials, before)
        choice = selection.choose(trials, current)
        if choice is None:
            break
        term = choice.term
        dated, trial = scopes.refine_span(term, trials[term], current)
        shape = (
            selection.gain_where_acting(term, trials[term], current, with_position=False)
            if has_motors
            else choice.gain
        )
        found[dated] = Found(term.kind.name, choice.gain, shape, _names(term, choice.lookalikes))
        added = fitter.forecast(trial) if dated != term else trial
        current = improve_begins(selection, added)
        earlier = current.parameters.terms[:-1]
        renamed = dict(zip(added.parameters.terms, current.parameters.terms, strict=True))
        if earlier != added.parameters.terms[:-1] and not is_retried:
            # It made up for a wrong begin, too. Beside the right one another effect may be better.
            current, is_retried, left_to_find = fitter.fit(earlier, current), True, left_to_find + 1
            found = {new: found[old] for old, new in renamed.items() if old != dated}
            continue
        current = prune_redundant(selection, current)
        kept = current.parameters.terms
        found = {new: found[old] for old, new in renamed.items() if new in kept}
        left = [
            other for other in left if other.kind is not term.kind or term.heliostats is not None
        ]
    outcome = _outcome(fitter, before, current, found, candidates)
    return _contradict(fitter, outcome, before, current, progress)


def _check(flux_images: Sequence[FluxImage]) -> None:
    if len(flux_images) < MIN_IMAGES:
        raise InvalidInputError(
            f"a study takes at least {MIN_IMAGES} photographs, got {len(flux_images)}"
        )
    if len({p.key for p in flux_images}) < len(flux_images):
        raise InvalidInputError("photographs of a study must have different identifiers")


def _check_own(flux_images: Sequence[FluxImage], model: PlantModel, options: StudyOptions) -> None:
    """Let effects that a plant wrote fail in words: fits take any failure for a bad value."""
    for name in options.candidates:
        if name not in ORDER:
            (amplitude,) = CATALOGUE[name].parameters()
            slight: dict[str, Any] = {amplitude.name: 0.01 * (amplitude.high or amplitude.low)}
            effect = CATALOGUE[name](**slight)
            aligned = align([p.setup for p in flux_images], model.with_effects([effect]))
            aligned.images(options.fit_view)


def _candidate_terms(
    scopes: ScopeSearch, effects: Sequence[Effect], options: StudyOptions
) -> list[Term]:
    """Return the effects that the declared model does not have in full scope.

    An effect that has begun once may begin again, and one at a heliostat may exist at others.
    """
    declared = {
        effect.name
        for effect in effects
        if effect.scope == Always() or isinstance(effect.scope, ByDay)
    }
    kinds = [CATALOGUE[name] for name in options.candidates if name not in declared]
    return [scopes.full_scope(kind) for kind in kinds]


def _candidates(
    selection: ForwardSelection, trials: dict[Term, Trial], before: Trial
) -> list[Candidate]:
    """Return each effect alone, in its full scope."""
    return [
        Candidate(
            term.kind.name,
            float(t.accuracy.mean()),
            selection.gain(t, before),
            selection.gain(t, before, with_position=False),
        )
        for term, t in trials.items()
        if selection.scopes.has_full_scope(term)
    ]


def _outcome(
    fitter: TrialFitter,
    before: Trial,
    current: Trial,
    found: dict[Term, Found],
    candidates: list[Candidate],
) -> Study:
    judge = fitter.judge
    held_out = [fitter.flux_images[row] for row in fitter.split.held_out]
    return Study(
        images=held_out,
        n_fitted=len(fitter.flux_images) - len(held_out),
        window=fitter.window,
        measured=fitter.measured,
        before=judge.cuts([]),
        after=judge.cuts(current.effects),
        position_residuals_before=before.position_residuals,
        position_residuals_after=current.position_residuals,
        displaced_before=judge.displaced([]),
        displaced_after=judge.displaced(current.effects),
        found=[
            one.fitted(term, current.parameters, current.values, current.spread)
            for term, one in found.items()
        ],
        candidates=sorted(candidates, key=lambda c: -c.gain.mean),
        effects=current.effects,
        site=fitter.model.site,
    )


def _contradict(
    fitter: TrialFitter,
    outcome: Study,
    before: Trial,
    current: Trial,
    progress: Callable[[str], None],
) -> Study:
    """Add the discrepancy, and what contradicts the effects found."""
    reasons = []
    if outcome.leaves_little:
        progress("halves of the photographs")
        reasons = [f"{term.kind.name} drifts" for term in find_drifts(fitter, current)]
    n_unknown = len(current.parameters.all)
    is_certain = outcome.unexplained_share <= MIN_RIVAL and n_unknown < FEWER * MIN_UNKNOWN
    if outcome.found and is_certain and not reasons:
        return outcome  # no term can gain what would contradict them, nor say the same in fewer
    if not outcome.found and not outcome.has_unexplained_error:
        return outcome
    progress("terms outside the catalogue")
    discrepancy = find_discrepancy(fitter, before, outcome.noise_floor)
    least = MIN_RIVAL * outcome.excess_error
    if outcome.leaves_little and outcome.has_unexplained_error:
        added = find_discrepancy(fitter, current, outcome.noise_floor, max_terms=1)
        if (
            added is not None
            and outcome.reference.gain(added.accuracy - current.accuracy).mean >= least
        ):
            reasons.append(f"{added.described} gains more")
    if outcome.leaves_little and discrepancy is not None:
        change = outcome.reference.gain(discrepancy.accuracy - current.accuracy)
        if change.low > 0 and change.mean >= least:
            reasons.append(f"{discrepancy.described} alone gains more")
        elif change.mean >= -least and n_unknown >= FEWER * discrepancy.n_coefficients:
            reasons.append(
                f"{discrepancy.described} gains as much with {discrepancy.n_coefficients}"
                f" coefficients in place of {n_unknown}"
            )
    judged = replace(outcome, contradicted_by=reasons)
    return judged if judged.verdict == "effect" else replace(judged, discrepancy=discrepancy)


def _names(term: Term, others: Sequence[Term]) -> list[str]:
    """Return the names of look-alikes, without the same effect in another scope."""
    return list(dict.fromkeys(other.kind.name for other in others if other.kind is not term.kind))
