"""The loop: fit every candidate, keep the one that images it never saw gain from, and go on from there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from model.effects import CATALOGUE, Effect
from model.errors import InvalidInputError
from model.forecast import View
from model.images import FLUX_SIZE
from model.metrics import flux_accuracies
from model.study.fitting import Fitter
from model.study.flux_images import FluxImage, Forecaster, spot_window
from model.study.judging import Gain, Split, paired_gain, split
from model.study.report import Candidate, Found, Study
from model.study.unknowns import Unknowns
from model.tracing import Optics

Array = NDArray[np.float64]

LEAST_IMAGES = 4

REFITTED = 3
"""How many of the best candidates are fitted once more, jointly with the effects found before."""


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
    """A model with some kinds of effect, fitted: values (P,), their spread (P,), accuracy (H,) of held-out images."""

    unknowns: Unknowns
    values: Array
    spread: Array
    accuracy: Array

    @property
    def effects(self) -> list[Effect]:
        """The fitted effects."""
        return self.unknowns.effects(self.values)


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
        self.window = options.window or spot_window(flux_images)
        self.split: Split = split(flux_images)
        self.facets = tuple(sorted({(p.heliostat, len(p.setup.control_points)) for p in flux_images}))

        def forecaster(rows: NDArray[np.int64], view: View) -> Forecaster:
            chosen = [flux_images[row] for row in rows]
            return Forecaster(chosen, optics, declared, self.window, view, latitude_deg=latitude_deg)

        self.fit, self.own = (
            (forecaster(rows, options.fit_view), forecaster(rows, options.view)) if len(rows) else None
            for rows in (self.split.fit, self.split.own)
        )
        self.judge = forecaster(self.split.held_out, options.view)
        self.measured = self.judge.measured(FLUX_SIZE)
        self.heliostats = np.array([flux_images[row].heliostat for row in self.split.held_out])
        self.noise = float(np.mean([flux_images[row].noise_share(self.window) for row in self.split.held_out]))

    def trial(self, kinds: Sequence[type[Effect]], start: Trial | None = None, joint: bool = True) -> Trial:
        """Fit kinds of effect, from where ``start`` has fitted some of them, and judge them.

        All of them, unless ``joint`` is false: then those that ``start`` knows stay as they are.
        """
        whole = Unknowns(tuple(kinds), self.facets)
        trial = Trial(whole, whole.neutral, np.zeros(len(whole.all)), np.empty(0))
        known: set[type[Effect]] = set()
        if start is not None:
            values, spread = (start.unknowns.put(v, whole) for v in (start.values, start.spread))
            trial, known = replace(trial, values=values, spread=spread), set(start.unknowns.kinds)
        for pair, unknowns in ((self.fit, whole), (self.own, whole.own)):
            moving = unknowns if joint else unknowns.without(known)
            if pair is not None and moving.kinds:
                trial = self._fitted(trial, pair, moving, known)
        return replace(trial, accuracy=self.accuracy(trial.effects))

    @staticmethod
    def _fitted(
        trial: Trial, pair: tuple[Forecaster, Forecaster], unknowns: Unknowns, known: set[type[Effect]]
    ) -> Trial:
        """The trial with those unknowns fitted that the photographs of a pair can tell of."""
        fixed = [effect for effect in trial.effects if type(effect) not in unknowns.kinds]
        fitter = Fitter(*pair, fixed=fixed)
        local = unknowns.of(sorted(set(fitter.heliostats.tolist())))
        free = np.array([u.effect not in known for u in local.all], dtype=bool)
        fit = fitter.fit(local, trial.unknowns.put(trial.values, local), free)
        values, spread = trial.values.copy(), trial.spread.copy()
        places = [trial.unknowns.all.index(u) for u in local.all]
        values[places], spread[places] = fit.values, fit.spread
        return replace(trial, values=values, spread=spread)

    def added(self, name: str, current: Trial) -> Trial:
        """The current model with one more effect, fitted beside what is known."""
        return self.trial([*current.unknowns.kinds, CATALOGUE[name]], current, joint=False)

    def refitted(self, trials: dict[str, Trial]) -> dict[str, Trial]:
        """Trials, the best of them fitted once more from where they are, jointly with what was known before."""
        best = sorted(trials, key=lambda name: -trials[name].accuracy.mean())[:REFITTED]
        return trials | {name: self.trial(trials[name].unknowns.kinds, trials[name]) for name in best}

    def worth_adding_to(self, current: Trial) -> bool:
        """Whether even the truth, which leaves the images' noise, could bring the gain that an effect must bring."""
        return 1 - float(current.accuracy.mean()) - self.noise >= self.options.least_gain

    def accuracy(self, effects: Sequence[Effect]) -> Array:
        """Accuracy (H,) of the held-out images under effects."""
        return flux_accuracies(self.measured, self.judge.cuts(effects))

    def gain(self, after: Trial, before: Trial) -> Gain:
        """What ``after`` is better by on held-out images."""
        return paired_gain(after.accuracy - before.accuracy, self.heliostats)

    def counts(self, gain: Gain) -> bool:
        """Whether a gain is both significant and worth having."""
        return gain.low > 0 and gain.mean >= self.options.least_gain

    @staticmethod
    def distinguishes(gain: Gain) -> bool:
        """Whether a gain of one effect over another is significant, and more than what fits may differ by."""
        return gain.low > 0 and gain.mean >= LEAST_DIFFERENCE

    def choose(self, trials: dict[str, Trial], current: Trial) -> tuple[str, list[str]] | None:
        """The candidate to add and its look-alikes, or None.

        Of those that no held-out image tells from the best one the simplest is taken.
        """
        significant = {name: t for name, t in trials.items() if self.counts(self.gain(t, current))}
        if not significant:
            return None
        best = max(significant.values(), key=lambda t: t.accuracy.mean())
        alike = [name for name, t in significant.items() if t is best or not self.distinguishes(self.gain(best, t))]
        alike.sort(key=lambda name: (len(significant[name].values), -significant[name].accuracy.mean()))
        return alike[0], alike[1:]

    def without_idle(self, current: Trial) -> Trial:
        """The trial without effects that a later one has made idle."""
        for kind in current.unknowns.kinds[:-1]:
            rest = [k for k in current.unknowns.kinds if k is not kind]
            less = self.trial(rest, current)
            if not self.counts(self.gain(current, less)):
                current = less
        return current


def study(
    flux_images: Sequence[FluxImage],
    optics: Optics,
    effects: Sequence[Effect] = (),
    options: StudyOptions | None = None,
    progress: Callable[[str], None] = lambda message: None,
    *,
    latitude_deg: float,
) -> Study:
    """Which effects photographs demand that a model with these optics and effects lacks, and what they buy.

    Parameters
    ----------
    flux_images : sequence of FluxImage
        With surfaces that are believed; at least four, better several heliostats under many suns.
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
    declared = {effect.name for effect in effects}
    before = current = loop.trial([])
    found: list[Found] = []
    candidates: list[Candidate] = []
    left = [name for name in options.candidates if name not in declared]
    for _ in range(options.most):
        if found and not loop.worth_adding_to(current):
            break
        trials = {}
        for name in left:
            progress(name)
            trials[name] = loop.added(name, current)
        trials = loop.refitted(trials)
        candidates = candidates or [
            Candidate(n, float(t.accuracy.mean()), loop.gain(t, before)) for n, t in trials.items()
        ]
        chosen = loop.choose(trials, current)
        if chosen is None:
            break
        name, others = chosen
        found.append(Found(name, loop.gain(trials[name], current), others))
        current = loop.without_idle(trials[name])
        found = [f for f in found if CATALOGUE[f.name] in current.unknowns.kinds]
        left.remove(name)
    held_out = [flux_images[row] for row in loop.split.held_out]
    return Study(
        images=held_out,
        fitted=len(flux_images) - len(held_out),
        window=loop.window,
        measured=loop.measured,
        before=loop.judge.cuts([]),
        after=loop.judge.cuts(current.effects),
        found=[f.fitted(current.unknowns, current.values, current.spread) for f in found],
        candidates=sorted(candidates, key=lambda c: -c.accuracy_after),
        effects=current.effects,
        latitude_deg=latitude_deg,
    )
