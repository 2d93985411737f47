"""What has no name: corrections of forecasts by generic terms, located and scaled.

Notes
-----
A term is a kind (`model.effects.generic_kinds`), a scaling and an owner. The coefficients of a
photograph n are linear in a covariate z of zero mean and unit variance::

    c_n = b_0[owner] + b_1[owner] z_n                      b_0 alone for the scaling "constant"
    b   = argmin sum_n |r_n - D_n c_n|**2 + ridge |b|**2   r, D in shares of photographs' peaks

All terms are compared by cross-validation on the fitted photographs, those of the best kinds after
Gauss-Newton with exact changes of the forecasts. Further terms are added to the best. Held-out
photographs judge the sum. Source of the ridge and its cross-validation: Hastie, Tibshirani and
Friedman, *The Elements of Statistical Learning* (2009), sections 3.4.1 and 7.10.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.covariates import SCALINGS, Covariate, covariates_of
from model.effects import Effect
from model.effects.generic_kinds import GenericKind, Owner, Place
from model.images import COARSE_SIZE, FLUX_SIZE, binned
from model.metrics import flux_accuracies
from model.study.generic_terms import GenericModel
from model.study.judging import BeforeAfter, Gain, Rows, gain_to_json, paired_gain
from model.study.trials import Trial, TrialFitter

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PLACES = {
    "mirror": "the mirrors",
    "angle": "the angles of sun and mount",
    "camera": "the camera",
    "target": "the target's surface",
    "geometry": "the geometry of the image",
    "added_light": "light that is added",
}
"""Where a discrepancy lives, in words."""

RIDGES = (0.01, 0.1, 1.0)
"""Prior precisions of coefficients, of components that change photographs by one on the average."""

FOLDS = 4
"""Parts of the fitted photographs for cross-validation."""

ITERATIONS = 3
"""Steps of Gauss-Newton."""

MAX_TERMS = 3
"""Largest number of terms of a discrepancy."""

MIN_SHARE = 0.1
"""Smallest share of the excess error that a further term must gain in cross-validation."""

SCREENED = 8
"""Number of the best kinds whose best terms are fitted by Gauss-Newton, with all ridges."""

MIN_PROGRESS = 1e-4
"""Smallest gain of accuracy by a step of Gauss-Newton after the first."""

SIMPLER, SIMPLER_LINEAR = 0.98, 0.95
"""Shares of the best term's gain for which a term of fewer coefficients is preferred, after
Gauss-Newton and in the linear model, which is rough.
"""

MIN_VARIED = 0.1
"""Smallest deviation of a covariate within an owner, of that of all, with which it may scale."""

LOCATED = 0.2
"""Largest share of the excess error that may stay unexplained where a discrepancy is located."""


ROUGHLY = 0.25
"""Share of the least gain that a further term must have in the linear model to be fitted."""

MIN_RIVALRY = 0.5
"""Smallest share of the best term's gain with which another term is its rival."""

VARIED: dict[Place, str] = {
    "mirror": "several heliostats under the same sun",
    "angle": "heliostats near and far from the target",
    "camera": "by another camera or setting",
    "target": "on another target",
    "geometry": "with spots at other places of the target",
    "added_light": "of the target without a spot",
}
"""Photographs that a correction of a place predicts, and others do not."""


@dataclass(frozen=True)
class GenericTerm:
    """A kind of generic term with a scaling, None for a constant one, and an owner."""

    kind: GenericKind
    scaling: Covariate | None
    owner: Owner

    @property
    def described(self) -> str:
        """The term in words."""
        scaling = f" that scales with {self.scaling.name}" if self.scaling else ""
        owner = "" if self.owner in ("all", "camera") else f", separate for each {self.owner}"
        return f"a correction of {PLACES[self.kind.lives_in]}{scaling}{owner}"

    def competes_with(self, other: "GenericTerm") -> bool:
        """Whether the other acts elsewhere, or scales with something else."""
        return self.kind.lives_in != other.kind.lives_in or self.scaling != other.scaling


@dataclass(frozen=True, eq=False)
class Fields:
    """Changes (N, K, P) by a kind's components, of unit mean square, in shares of peaks.

    ``sizes`` (K,) are the root mean squares before.
    """

    values: NDArray[np.float32]
    sizes: Array

    @cached_property
    def gram(self) -> Array:
        """Products (N, K, K) of the components."""
        return np.asarray(self.values @ self.values.transpose(0, 2, 1), dtype=np.float64)

    def total(self, amounts: Array) -> Array:
        """Changes (N, P) by amounts (N, K) of components of unit size."""
        total = amounts.astype(np.float32)[:, None] @ self.values
        return np.asarray(total[:, 0], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Design:
    """How the coefficients of a term make its amounts in photographs.

    Attributes
    ----------
    factors : (N, J)
        One, and the covariate.
    owners : (N,)
        Index of each photograph's owner, of ``n_owners``.
    """

    factors: Array
    owners: NDArray[np.int64]
    n_owners: int

    def amounts(self, coefficients: Array) -> Array:
        """Amounts (N, K) of the components in each photograph, by coefficients (owners, M)."""
        own = coefficients[self.owners].reshape(len(self.owners), self.factors.shape[1], -1)
        return np.asarray(np.einsum("ni,nik->nk", self.factors, own))


@dataclass(frozen=True, eq=False)
class Regression:
    """Ridge regression of residuals (N, P), without any of a term's changes, on the term."""

    fields: Fields
    residual: Array
    design: Design

    @cached_property
    def gram(self) -> Array:
        """Products (N, M, M) of the M coefficients' changes."""
        factors = self.design.factors
        pairs = np.einsum("ni,nj,nkl->nikjl", factors, factors, self.fields.gram)
        size = pairs.shape[1] * pairs.shape[2]
        return np.asarray(pairs.reshape(-1, size, size))

    def _products(self, images: Array) -> Array:
        """Products (N, M) of the coefficients' changes with images (N, P)."""
        each = (self.fields.values @ images.astype(np.float32)[:, :, None])[:, :, 0]
        products = np.einsum("ni,nk->nik", self.design.factors, each)
        return np.asarray(products.reshape(len(images), -1))

    @cached_property
    def right(self) -> Array:
        """Products (N, M) with the residual."""
        return self._products(self.residual)

    def solve(self, training: Mask, ridge: float) -> Array:
        """Coefficients (owners, M) by the photographs of ``training`` (N,)."""
        found = np.zeros((self.design.n_owners, self.gram.shape[-1]))
        for owner in range(len(found)):
            own = training & (self.design.owners == owner)
            gram = self.gram[own].sum(axis=0) + ridge * np.eye(found.shape[1])
            found[owner] = np.linalg.solve(gram, self.right[own].sum(axis=0))
        return found

    def in_units(self, coefficients: Array) -> Array:
        """Coefficients (owners, M) of components of unit size, in the components' units."""
        return coefficients / np.tile(self.fields.sizes, self.design.factors.shape[1])

    def left(self, coefficients: Array) -> Array:
        """What of the residual (N, P) is left."""
        return self.residual - self.fields.total(self.design.amounts(coefficients))

    def left_without(self, groups: NDArray[np.int64], ridge: float) -> Array:
        """What of the residual (N, P) is left by fits to the photographs of other ``groups``."""
        amounts = np.empty(self.fields.values.shape[:2])
        for group in np.unique(groups):
            out = groups == group
            amounts[out] = self.design.amounts(self.solve(~out, ridge))[out]
        return self.residual - self.fields.total(amounts)

    def deviations(self, coefficients: Array, training: Mask, ridge: float) -> Array:
        """Standard deviations (owners, M) by the sandwich estimator over photographs."""
        scores, found = self._products(self.left(coefficients)), np.zeros_like(coefficients)
        for owner in range(len(found)):
            own = training & (self.design.owners == owner)
            bread = np.linalg.inv(self.gram[own].sum(axis=0) + ridge * np.eye(found.shape[1]))
            filling = scores[own].T @ scores[own] * own.sum() / max(1, own.sum() - 1)
            found[owner] = np.sqrt(np.diag(bread @ filling @ bread))
        return found


class Linearised(NamedTuple):
    """Changes by a kind's components about some amounts, and the residual (N, P) without those."""

    fields: Fields
    residual: Array


class Iterated(NamedTuple):
    """Coefficients (owners, M) of a fitted term in its units, and the linear model there."""

    coefficients: Array
    point: Linearised


@dataclass(frozen=True)
class Rival:
    """A term that gains nearly as much as the best one, and what would distinguish them.

    Attributes
    ----------
    term : GenericTerm
    gain_share : float [1]
        Its gain in cross-validation, of that of the best one.
    photographs : str
        Those in which the two differ.
    """

    term: GenericTerm
    gain_share: float
    photographs: str

    def to_json(self) -> dict[str, Any]:
        """As in a study's report."""
        return {
            "in_words": self.term.described,
            "gain_share": round(self.gain_share, 3),
            "distinguished_by": self.photographs,
        }


class TermGain(NamedTuple):
    """A term, and its gain in cross-validation."""

    term: GenericTerm
    gain: float


@dataclass(frozen=True, eq=False)
class TermChoice:
    """A term to add, its ridge, its gain in cross-validation, and its linear model."""

    term: GenericTerm
    ridge: float
    gain: float
    point: Linearised
    rival: "Rival | None" = None


@dataclass(frozen=True, eq=False)
class FittedTerm:
    """A fitted generic term.

    Attributes
    ----------
    choice : TermChoice
    regression : Regression
        Of all photographs, linear about the fit.
    cuts : (N, 64, 64)
        Forecasts with this term and those before it.
    training : (N,)
        Which photographs were fitted.
    """

    choice: TermChoice
    regression: Regression
    cuts: Array
    training: Mask

    @cached_property
    def coefficients(self) -> Array:
        """Coefficients (owners, M) of components of unit size."""
        return self.regression.solve(self.training, self.choice.ridge)

    @property
    def deviations(self) -> Array:
        """Standard deviations (owners, M) of the coefficients."""
        return self.regression.deviations(self.coefficients, self.training, self.choice.ridge)


class Scale(NamedTuple):
    """Mean, standard deviation and limits of a covariate, in its unit."""

    mean: float
    std: float
    limits: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """A correction of forecasts that no effect of the catalogue describes.

    Attributes
    ----------
    terms : list of FittedTerm
        In the order in which they change forecasts.
    owners : dict of list of str
        Names of the heliostats or targets that have coefficients.
    scales : dict of Scale
        Of the covariates.
    accuracy : (H,)
        Of the held-out photographs.
    change : (64, 64)
        Mean change of their forecasts, in shares of the photographs' peaks.
    gain : Gain
        Of accuracy, by held-out photographs.
    explained_share : float [1]
        Share of the excess error that the correction removes.
    place_share : float [1]
        The same of all terms in the first one's place.
    transfer : dict of BeforeAfter or None
        By heliostats, days and targets that were left out in turn; None where it cannot be tested.
    """

    terms: list[FittedTerm]
    owners: dict[Owner, list[str]]
    scales: dict[Covariate, Scale]
    accuracy: Array
    change: Array
    gain: Gain
    explained_share: float
    place_share: float
    transfer: dict[str, BeforeAfter | None]

    @property
    def lives_in(self) -> Place | None:
        """Where it acts, if terms of one place leave little."""
        is_located = 1 - self.place_share <= LOCATED
        return self.terms[0].choice.term.kind.lives_in if is_located else None

    @property
    def n_coefficients(self) -> int:
        """Number of coefficients of all terms."""
        return sum(one.coefficients.size for one in self.terms)

    @property
    def described(self) -> str:
        """The first term in words."""
        return self.terms[0].choice.term.described

    def in_words(self) -> str:
        """What the report says."""
        located = (
            f"What has no name lives in {PLACES[self.lives_in]}."
            if self.lives_in is not None
            else "Where it acts cannot be said."
        )
        unseen = [
            f"{name} that no fit saw ({one.before:.1%} before) to {one.after:.1%}"
            for name, one in self.transfer.items()
            if one is not None
        ]
        transfer = f" The forecasts of {', of '.join(unseen)}." if unseen else ""
        correction = self.described[0].upper() + self.described[1:]
        return (
            f"{located} {correction} explains {self.explained_share:.0%} of the error beyond noise:"
            f" accuracy on held-out images {self.accuracy.mean():.1%}.{transfer} It is a correction"
            " and no cause."
        )

    def to_json(self) -> dict[str, Any]:
        """The discrepancy of a report (DESIGN.md, section 7)."""
        term, rival = self.terms[0].choice.term, self.terms[0].choice.rival
        return {
            "lives_in": self.lives_in,
            "scaling": term.scaling.key if term.scaling else "constant",
            "owner": term.owner,
            "explained_share": round(self.explained_share, 4),
            "accuracy_after": round(float(self.accuracy.mean()), 5),
            "accuracy_gain": gain_to_json(self.gain),
            "transfer": {
                name: None if one is None else {k: round(v, 5) for k, v in one._asdict().items()}
                for name, one in self.transfer.items()
            },
            "rival": None if rival is None else rival.to_json(),
            "coefficients": [entry for one in self.terms for entry in self._coefficients(one)],
            "in_words": self.in_words(),
        }

    def _coefficients(self, fitted: FittedTerm) -> Iterator[dict[str, Any]]:
        """Coefficients of a term with their 95 % intervals, in the components' units."""
        term = fitted.choice.term
        shape = len(self.owners[term.owner]), -1, len(term.kind.components)
        values, deviations = (
            part.reshape(shape) / fitted.regression.fields.sizes
            for part in (fitted.coefficients, fitted.deviations)
        )
        for index, owner in enumerate(self.owners[term.owner]):
            for factor in range(values.shape[1]):
                scaling = term.scaling if factor else None
                scale = self.scales[scaling] if scaling else Scale(0.0, 1.0)
                for number, component in enumerate(term.kind.components):
                    value = values[index, factor, number] / scale.std
                    reach = 1.96 * deviations[index, factor, number] / scale.std
                    yield {
                        "kind": term.kind.name,
                        "name": component.name,
                        "of": owner if term.owner in ("heliostat", "target") else None,
                        "unit": component.unit,
                        "value": float(f"{value:.5g}"),
                        "ci95": [float(f"{value - reach:.5g}"), float(f"{value + reach:.5g}")],
                        "per": scaling.per(scale.mean, scale.limits) if scaling else None,
                    }


class _Sample:
    """Which photographs are fitted, their owners, covariates, and parts for cross-validation."""

    def __init__(self, fitter: TrialFitter) -> None:
        count = len(fitter.flux_images)
        self.is_fitted = np.isin(np.arange(count), fitter.split.fitted)
        names = {
            "all": ["all"] * count,
            "camera": ["camera"] * count,
            "heliostat": fitter.heliostats.tolist(),
            "target": [p.setup.plane.name for p in fitter.flux_images],
        }
        self.owners = {owner: np.unique(of, return_inverse=True) for owner, of in names.items()}
        self.covariates = {
            covariate: values
            for covariate, values in covariates_of(
                [p.setup for p in fitter.flux_images], fitter.model.site, SCALINGS
            ).items()
            if np.ptp(values[self.is_fitted]) > 0
        }
        self.folds = np.zeros(count, dtype=np.int64)
        for own in range(len(self.owners["heliostat"][0])):
            (some,) = np.nonzero(self.is_fitted & (self.owners["heliostat"][1] == own))
            self.folds[some] = np.arange(len(some)) % FOLDS

    def scale(self, covariate: Covariate) -> Scale:
        """Mean and deviation of a covariate of the fitted photographs."""
        values = self.covariates[covariate][self.is_fitted]
        limits = float(values.min()), float(values.max())
        return Scale(float(values.mean()), float(values.std()), limits)

    def varies(self, covariate: Covariate, owner: Owner) -> bool:
        """Whether a covariate varies in the fitted photographs of an owner."""
        values, own = self.covariates[covariate], self.owners[owner][1]
        each = [values[self.is_fitted & (own == one)] for one in np.unique(own)]
        usual = float(np.median([np.std(some) for some in each if len(some)]))
        return usual > MIN_VARIED * self.scale(covariate).std

    def terms(self, kind: GenericKind) -> list[GenericTerm]:
        """All terms of a kind that the photographs may show."""
        return [
            GenericTerm(kind, scaling, owner)
            for owner in kind.owners
            if owner in ("all", "camera") or len(self.owners[owner][0]) > 1
            for scaling in (None, *(self.covariates if kind.is_smooth else []))
            if scaling is None or self.varies(scaling, owner)
        ]

    def count(self, term: GenericTerm) -> int:
        """Number of a term's coefficients."""
        of_owner = len(term.kind.components) * (1 + (term.scaling is not None))
        return of_owner * len(self.owners[term.owner][0])

    def design(self, term: GenericTerm, rows: Rows) -> Design:
        """How a term's coefficients make its amounts in some photographs."""
        factors = [np.ones(len(rows))]
        if term.scaling is not None:
            mean, std, _ = self.scale(term.scaling)
            factors.append((self.covariates[term.scaling][rows] - mean) / std)
        names, owners = self.owners[term.owner]
        return Design(np.stack(factors, axis=1), owners[rows], len(names))

    def simplest(self, choices: Sequence[TermChoice], share: float) -> TermChoice:
        """The one of fewest coefficients among those that gain this share of the best one's."""
        best = max(choices, key=lambda one: one.gain)
        good = [one for one in choices if one.gain >= share * best.gain]
        return min(good or [best], key=lambda one: (self.count(one.term), -one.gain))


class _Search(_Sample):
    """Forward selection of generic terms on top of a trial's effects."""

    def __init__(self, fitter: TrialFitter, effects: Sequence[Effect]) -> None:
        super().__init__(fitter)
        self.all, options = np.arange(len(fitter.flux_images)), fitter.options
        self.fitted = fitter.split.fitted
        forecaster = fitter.forecaster(self.all, options.view)
        self.model = GenericModel(forecaster, effects, options.fit_view)
        self.measured = forecaster.measured(FLUX_SIZE)
        self.peaks = binned(self.measured, COARSE_SIZE).max(axis=(1, 2))[:, None]

    def residual(self, cuts: Array, rows: Rows) -> Array:
        """Measured minus forecast (n, P) of some photographs, in shares of peaks."""
        difference = binned(self.measured[rows] - cuts, COARSE_SIZE)
        return np.asarray(difference.reshape(len(cuts), -1) / self.peaks[rows])

    def accuracy(self, left: Array, rows: Rows) -> float:
        """Mean accuracy of photographs with an error (n, P) in shares of peaks."""
        return 1 - float((np.abs(left) * self.peaks[rows]).sum(axis=1).mean())

    def linear(
        self, model: GenericModel, kind: GenericKind, rows: Rows, cuts: Array, amounts: Array
    ) -> Linearised:
        """The linear model of a kind at cuts (n, 64, 64) that have amounts (n, K) of it."""
        values = model.derivatives(kind, rows, cuts, amounts)
        values = values.reshape(*amounts.shape, -1) / self.peaks[rows, None].astype(np.float32)
        is_fitted = self.is_fitted[rows]
        sizes = np.sqrt((values[is_fitted] ** 2).sum(axis=2).mean(axis=0)) + 1e-12
        fields = Fields(values / sizes[:, None], sizes.astype(np.float64))
        return Linearised(fields, self.residual(cuts, rows) + fields.total(amounts * fields.sizes))

    def cross_validated(self, term: GenericTerm, point: Linearised, ridge: float) -> float:
        """Accuracy of the fitted photographs, each by a fit without it."""
        regression = Regression(*point, self.design(term, self.fitted))
        left = regression.left_without(self.folds[self.fitted], ridge)
        return self.accuracy(left, self.fitted)

    def best(self, cuts: Array, least: float = -np.inf) -> TermChoice:
        """The simplest of the best terms.

        All are compared in the linear model of their kind. If one gains ``least`` there, the best
        term of each of the best kinds is fitted by Gauss-Newton, for strong changes of mirrors are
        not linear.
        """
        cuts = cuts[self.fitted]
        before = self.accuracy(self.residual(cuts, self.fitted), self.fitted)

        def choices(
            terms: Iterable[GenericTerm], point: Linearised, ridges: Sequence[float]
        ) -> list[TermChoice]:
            pairs = ((term, ridge) for term in terms for ridge in ridges)
            return [
                TermChoice(term, ridge, self.cross_validated(term, point, ridge) - before, point)
                for term, ridge in pairs
            ]

        screened: list[TermChoice] = []  # only their linear models stay in memory
        gains: list[TermGain] = []
        for kind in self.model.kinds:
            own = choices(self.terms(kind), self.linearise(kind, cuts), RIDGES[1:2])
            gains += [TermGain(one.term, one.gain) for one in own]
            screened.append(self.simplest(own, SIMPLER_LINEAR))
            screened = sorted(screened, key=lambda one: -one.gain)[:SCREENED]
        if screened[0].gain < least:
            return screened[0]
        finalists: list[TermChoice] = []
        for one in screened:
            point = self.iterate(one.term, one.ridge, cuts, one.point).point
            finalists += choices([one.term], point, RIDGES)
        chosen = self.simplest(finalists, SIMPLER)
        gains += [TermGain(one.term, one.gain) for one in finalists]
        others = sorted(gains, key=lambda one: -one.gain)
        return replace(chosen, rival=find_rival(self, chosen, others))

    def linearise(self, kind: GenericKind, cuts: Array) -> Linearised:
        """The linear model of a kind at the fitted photographs' cuts, about its best constant
        amounts if those are fast to find.
        """
        none = np.zeros((len(cuts), len(kind.components)))
        point = self.linear(self.model, kind, self.fitted, cuts, none)
        if kind.basis is None:
            return point
        term = GenericTerm(kind, None, kind.owners[0])
        return self.iterate(term, RIDGES[1], cuts, point).point

    def iterate(self, term: GenericTerm, ridge: float, cuts: Array, point: Linearised) -> Iterated:
        """Fit a term by Gauss-Newton, with exact changes of the fitted photographs' cuts."""
        rows, everything = self.fitted, np.full(len(cuts), True)
        best, design = self.accuracy(self.residual(cuts, rows), rows), self.design(term, rows)
        found = Iterated(np.zeros((design.n_owners, self.count(term) // design.n_owners)), point)
        for _ in range(ITERATIONS):
            regression = Regression(*found.point, design)
            coefficients = regression.in_units(regression.solve(everything, ridge))
            amounts = design.amounts(coefficients)
            changed = self.model.apply(term.kind, rows, cuts, amounts)
            accuracy = self.accuracy(self.residual(changed, rows), rows)
            if accuracy <= best + MIN_PROGRESS:
                break
            best = accuracy
            point = self.linear(self.model, term.kind, rows, changed, amounts)
            found = Iterated(coefficients, point)
        return found

    def fit(self, choice: TermChoice, cuts: Array) -> FittedTerm:
        """Fit a chosen term, and apply it to all photographs."""
        term, design = choice.term, self.design(choice.term, self.all)
        found = self.iterate(term, choice.ridge, cuts[self.fitted], choice.point)
        amounts, model = design.amounts(found.coefficients), self.model.of_kind(term.kind)
        changed = model.apply(term.kind, self.all, cuts, amounts)
        point = self.linear(model, term.kind, self.all, changed, amounts)
        return FittedTerm(choice, Regression(*point, design), changed, self.is_fitted)

    def transfer(self, found: Sequence[FittedTerm], groups: Sequence[object]) -> BeforeAfter | None:
        """Accuracy of photographs of each group by fits to the other groups; None for one group."""
        names, index = np.unique([str(group) for group in groups], return_inverse=True)
        if len(names) < 2:
            return None
        left = self.residual(found[-1].cuts, self.all)
        for fitted in found:
            whole = fitted.regression.left(fitted.coefficients)
            left = left + fitted.regression.left_without(index, fitted.choice.ridge) - whole
        before = self.residual(self.model.cuts, self.all)
        return BeforeAfter(self.accuracy(before, self.all), self.accuracy(left, self.all))


def find_rival(search: _Search, best: TermChoice, others: Sequence[TermGain]) -> Rival | None:
    """The best of ``others``, the best first, that competes; None if it gains little."""
    other = next(one for one in others if one.term.competes_with(best.term))
    if other.gain < MIN_RIVALRY * best.gain:
        return None
    pair = best.term.scaling, other.term.scaling
    both = [search.covariates[s][search.is_fitted] for s in pair if s is not None]
    related = float(np.asarray(np.corrcoef(both))[0, 1]) if len(both) == 2 else 0.0
    photographs = photographs_to_compare(best.term, other.term, related)
    return Rival(other.term, other.gain / best.gain, photographs)


def photographs_to_compare(first: GenericTerm, second: GenericTerm, related: float) -> str:
    """Photographs in which two terms differ.

    ``related`` is the correlation of their covariates in the photographs that were compared.
    """
    names = [term.scaling.name for term in (first, second) if term.scaling is not None]
    if first.scaling == second.scaling:
        places = {VARIED[term.kind.lives_in]: None for term in (first, second)}
        return f"photographs {', and '.join(places)}"
    if len(names) == 1:
        return f"photographs beyond the range of {names[0]} that is covered"
    ends = ("high", "low") if related > 0 else ("high", "high")
    return (
        f"photographs of a {ends[0]} {names[0]} with a {ends[1]} {names[1]}, and the reverse: so"
        f" far the two vary together (correlation {related:+.2f})"
    )


def find_discrepancy(
    fitter: TrialFitter, base: Trial, noise: float, max_terms: int = MAX_TERMS
) -> Discrepancy | None:
    """Find the generic terms that correct the forecasts of a trial; None if none is worthwhile.

    ``noise`` is the error that even the truth leaves.
    """
    fitter.forget()
    search = _Search(fitter, base.effects)
    cuts, held_out = search.model.cuts, fitter.split.held_out
    excess = 1 - noise - float(base.accuracy.mean())
    found: list[FittedTerm] = []
    least = max(MIN_SHARE * excess, fitter.options.min_gain)
    for _ in range(max_terms):
        choice = search.best(cuts, ROUGHLY * least if found else -np.inf)
        if choice.gain < least:
            break
        found.append(search.fit(choice, cuts))
        cuts = found[-1].cuts
    if not found:
        return None
    accuracies = [flux_accuracies(fitter.measured, one.cuts[held_out]) for one in found]
    gain = paired_gain(accuracies[-1] - base.accuracy, fitter.heliostats[held_out])
    if gain.low <= 0:
        return None
    change = found[-1].cuts[held_out] - search.model.cuts[held_out]
    steps = np.diff([base.accuracy.mean(), *(accuracy.mean() for accuracy in accuracies)])
    place = found[0].choice.term.kind.lives_in
    in_place = sum(
        step
        for step, one in zip(steps, found, strict=True)
        if one.choice.term.kind.lives_in == place
    )
    owned = {one.choice.term.owner for one in found}
    days: Sequence[object] = fitter.days or [None]
    transfer = {
        "heliostats": fitter.heliostats.tolist() if "heliostat" not in owned else [None],
        "days": days if None not in days else [None],
        "targets": [p.setup.plane.name for p in fitter.flux_images]
        if "target" not in owned
        else [None],
    }
    return Discrepancy(
        terms=found,
        owners={owner: search.owners[owner][0].tolist() for owner in owned},
        scales={c: search.scale(c) for one in found if (c := one.choice.term.scaling) is not None},
        accuracy=accuracies[-1],
        change=(change / fitter.measured.max(axis=(1, 2), keepdims=True)).mean(axis=0),
        gain=gain,
        explained_share=float(np.clip(steps.sum() / excess, 0, 1)),
        place_share=float(np.clip(in_place / excess, 0, 1)),
        transfer={name: search.transfer(found, groups) for name, groups in transfer.items()},
    )
