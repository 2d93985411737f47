"""Fit a set of effects to one part of the photographs and forecast the held-out part."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.effects import CATALOGUE, Effect
from model.forecast import View
from model.images import FLUX_SIZE
from model.metrics import flux_accuracies
from model.plant_model import PlantModel
from model.progress import nothing_between
from model.study.fitting import Fitter
from model.study.flux_images import FluxImage, Forecaster, spot_window
from model.study.judging import Rows, Split, split
from model.study.parameters import ParameterVector, Term
from model.study.position import NAT, loss
from model.study.scopes import days_of

Array = NDArray[np.float64]


# Parts of the photographs whose last forecasts stay in memory: fits alternate between a few.
_RECENT = 3


@dataclass(frozen=True)
class StudyOptions:
    """Options of a study.

    ``min_gain`` is the smallest gain of accuracy for which an effect is added; at most ``most``
    effects are added. ``window`` [m] is by default that of the spots. ``candidates`` are names of
    the catalogue. ``between`` is called before each forecast; what it raises ends the study.
    """

    candidates: tuple[str, ...] = field(default_factory=lambda: tuple(CATALOGUE))
    min_gain: float = 0.004
    most: int = 3
    window: float | None = None
    fit_view: View = field(default_factory=lambda: View(64, 64, samples=12, padding=0.125))
    view: View = field(default_factory=lambda: View(128, 128, samples=24))
    between: Callable[[], None] = nothing_between


@dataclass(frozen=True, eq=False)
class Trial:
    """A fitted model with some effects.

    Attributes
    ----------
    parameters : ParameterVector
    values, spread : (P,)
        Of the parameters, and their standard deviations.
    cuts : (H, 64, 64)
        Forecasts of the held-out images.
    accuracy : (H,)
        Of the held-out images.
    position_residuals : (H, 2)
        Of the held-out spots to the places where their motors sent them, in independent standard
        deviations; NaN if unknown.
    """

    parameters: ParameterVector
    values: Array
    spread: Array
    cuts: Array
    accuracy: Array
    position_residuals: Array

    @property
    def score(self) -> Array:
        """Accuracy (H,) of the held-out images minus the loss by position."""
        return self.scores(with_position=True)

    def scores(self, with_position: bool) -> Array:
        """Return `score`, or accuracy alone."""
        return self.accuracy - with_position * NAT * loss(self.position_residuals)

    @property
    def effects(self) -> list[Effect]:
        """The fitted effects."""
        return self.parameters.effects(self.values)

    def with_scope(self, term: Term, scoped: Term) -> "Trial":
        """Return the trial with one effect in another scope of as many values."""
        terms = tuple(scoped if other == term else other for other in self.parameters.terms)
        return replace(self, parameters=self.parameters.of_terms(terms))


class Forecasters(NamedTuple):
    """Forecasters of the same images: coarse ones for fits, and fine ones."""

    coarse: Forecaster
    fine: Forecaster


class TrialFitter:
    """Fits models to the photographs of one study and forecasts those that are held out."""

    def __init__(
        self, flux_images: Sequence[FluxImage], model: PlantModel, options: StudyOptions
    ) -> None:
        self.flux_images, self.model, self.options = flux_images, model, options
        self.window = options.window or spot_window(flux_images)
        self.split: Split = split(flux_images)
        facets = sorted({(p.heliostat, len(p.setup.control_points)) for p in flux_images})
        mounts = [p.setup.heliostat.mount for p in flux_images]
        unseen = {(name, p) for name, kind in CATALOGUE.items() for p in kind.unseen(mounts)}
        self.unknowns = ParameterVector((), tuple(facets), frozenset(unseen))
        self.is_estimated = all(p.is_estimated for p in flux_images)
        self.days = days_of(flux_images)
        self.heliostats = np.array([p.heliostat for p in flux_images])
        self.judged_heliostats = self.heliostats[self.split.held_out]
        self.judge = self.forecaster(self.split.held_out, options.view)
        self.measured = self.judge.measured(FLUX_SIZE)
        self._forecasters: dict[bytes, Forecasters] = {}

    def forecaster(self, rows: Rows, view: View) -> Forecaster:
        """Return a forecaster of some images."""
        chosen = [self.flux_images[row] for row in rows]
        return Forecaster(chosen, self.model, self.window, view, self.options.between)

    def forecasters(self, rows: Rows) -> Forecasters:
        """Return the forecasters of some images; those that were used longest ago free memory."""
        key, views = rows.tobytes(), (self.options.fit_view, self.options.view)
        made = self._forecasters.pop(key, None)
        if made is None:
            made = Forecasters(*(self.forecaster(rows, view) for view in views))
        self._forecasters[key] = made
        for coarse, fine in list(self._forecasters.values())[:-_RECENT]:
            coarse.forget()
            fine.forget()
        return made

    def forget(self) -> None:
        """Free the memory of all forecasters of fits; the next fits make them again."""
        self._forecasters.clear()

    def touched(self, rows: Rows, terms: Iterable[Term]) -> Rows:
        """Select the images that at least one term may change."""
        images, some = [self.flux_images[row] for row in rows], list(terms)
        return rows[[any(term.touches(p.heliostat, p.taken_at) for term in some) for p in images]]

    def fit(self, terms: Sequence[Term], start: Trial | None = None, joint: bool = True) -> Trial:
        """Fit effects and forecast the held-out images.

        The fit begins at the values of ``start``. Unless ``joint``, the effects of ``start`` are
        kept as they are.
        """
        full = self.unknowns.of_terms(terms)
        trial = Trial(full, full.neutral, np.zeros(len(full.all)), *(np.empty(0) for _ in range(3)))
        known: set[Term] = set()
        if start is not None:
            values, spread = (
                start.parameters.transfer(v, full) for v in (start.values, start.spread)
            )
            trial, known = replace(trial, values=values, spread=spread), set(start.parameters.terms)
        for rows, parameters in self._parts(full):
            moving = parameters if joint else parameters.without(known)
            trial = self.fit_rows(trial, self.touched(rows, moving.terms), moving, known)
        return self.forecast(trial)

    def fit_added(self, term: Term, current: Trial) -> Trial:
        """Fit one more effect and keep those of the current model as they are."""
        return self.fit([*current.parameters.terms, term], current, joint=False)

    def _parts(self, full: ParameterVector) -> list[tuple[Rows, ParameterVector]]:
        """Return which parameters are fitted to which images.

        Only parameters of a heliostat are fitted to the heliostat that is held out. No heliostat is
        held out with an effect by day: all heliostats share the haze of a day.
        """
        if any(term.days for term in full.terms):
            return [(self.split.fitted, full)]
        return [(self.split.fit, full), (self.split.own, full.per_heliostat)]

    def forecast(self, trial: Trial) -> Trial:
        """Return the trial with its forecasts of the held-out images."""
        cuts = self.judge.cuts(trial.effects)
        residuals = self.judge.position_residuals(trial.effects)
        accuracy = flux_accuracies(self.measured, cuts)
        return replace(trial, cuts=cuts, accuracy=accuracy, position_residuals=residuals)

    def fit_rows(
        self, trial: Trial, rows: Rows, parameters: ParameterVector, known: set[Term]
    ) -> Trial:
        """Fit those parameters that some images depend on; all others of the trial are fixed."""
        local = parameters.for_heliostats(sorted(set(self.heliostats[rows].tolist())))
        if not local.all or not len(rows):
            return trial
        fixed = trial.parameters.without(parameters.terms)
        fitter = Fitter(
            *self.forecasters(rows),
            fixed=fixed.effects(trial.parameters.transfer(trial.values, fixed)),
        )
        free = np.array([u.term not in known for u in local.all], dtype=bool)
        fit = fitter.fit(local, trial.parameters.transfer(trial.values, local), free)
        values, spread = trial.values.copy(), trial.spread.copy()
        places = [trial.parameters.all.index(u) for u in local.all]
        values[places], spread[places] = fit.values, fit.spread
        return replace(trial, values=values, spread=spread)

    def costs(self, rows: Rows, parameters: ParameterVector, values: Array) -> Array:
        """Return the cost of each image (M, n) for several vectors of values (M, P)."""
        return Fitter(*self.forecasters(rows)).energies_of(parameters, values) / 2
