"""The outcome of a study: the effects found, their gains, and the error that is left."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from model.effects import Always, Effect
from model.metrics import flux_accuracies
from model.site import Site
from model.study.discrepancy import Discrepancy
from model.study.flux_images import FluxImage, noise_floor
from model.study.judging import BeforeAfter, Gain, paired_gain
from model.study.parameters import ParameterVector, Term
from model.study.pattern import Pattern, pattern_of
from model.study.position import EXPECTED, NAT, is_known, loss

Array = NDArray[np.float64]
Verdict = Literal["effect", "none", "unexplained"]

TOLERANCE = 0.006
"""Largest error beyond the images' noise that needs no explanation. Sets without an undeclared
effect have less (two tracers, resampling, surfaces of finite resolution).
"""

MAX_LEFT, MAX_LEFT_OF_SEVERAL = 2 / 3, 0.2
"""Largest shares of that error that the effects found may leave for the verdict "effect".

True effects leave up to 0.02 of pure light, but 0.4 of photographs of a target's sheet, whose marks
move light about. So what imitates a true effect is found by what gains more. Several effects
together imitate nearly anything: of pure light such imitations leave 0.26 and more.
"""

MIN_RIVAL = 0.1
"""Smallest share of that error that a generic term must gain to contradict the effects found."""

MIN_REFERENCE = 8
"""Smallest number of images of estimated surfaces, without the effects found, as a reference."""

SHARED = 0.02
"""Standard deviation of the error that all images share, in shares of a parameter's distance from
neutral.

Examples are faint light that 8 bits round away, and the tracer's grid. Chosen by sets of known
effects (`benchmarks.study`), where the median error of most parameters is 0.2 to 2 %.
"""

MAX_LISTED = 4
"""Largest number of days or heliostats that a conclusion names."""


@dataclass(frozen=True)
class Candidate:
    """An effect of the catalogue, fitted alone: mean accuracy of held-out images, and gains."""

    name: str
    accuracy_after: float
    gain: Gain
    accuracy_gain: Gain


@dataclass(frozen=True)
class Found:
    """An effect that was found, its gain when it was added, and effects that look alike.

    Attributes
    ----------
    name : str
    gain : Gain
        Gain for which it was added: in accuracy and in spot position (`model.study.position`).
    accuracy_gain : Gain
    lookalikes : list of str
    parameters : dict
        Nested as in the report: by name, then by heliostat if it has one, then a list over facets.
    scope : dict
        When it acts, as in the report.
    days : list of date
        Days on which an effect with values by day is largest.
    """

    name: str
    gain: Gain
    accuracy_gain: Gain
    lookalikes: list[str]
    parameters: dict[str, Any] = field(default_factory=dict)
    scope: dict[str, Any] = field(default_factory=lambda: Always().to_json())
    days: list[date] = field(default_factory=list)

    def fitted(
        self, term: Term, unknowns: ParameterVector, values: Array, spread: Array
    ) -> "Found":
        """Add the final parameters and their 95 % intervals, clipped to their bounds."""
        low, high = unknowns.bounds
        spread = np.hypot(spread, SHARED * (values - unknowns.neutral))
        intervals = np.stack([values - 1.96 * spread, values + 1.96 * spread], axis=-1)
        intervals = np.clip(intervals, low[:, None], high[:, None])
        value = unknowns.nested(term, [round(float(v), 6) for v in values])
        ci95 = unknowns.nested(
            term, [[round(float(v), 6) for v in interval] for interval in intervals]
        )
        parameters = {
            p.name: _fitted(value[p.name], ci95[p.name], p.unit, term)
            for p in term.kind.parameters()
            if p.name in value
        }
        away = dict.fromkeys(term.days, 0.0)
        for place, unknown in enumerate(unknowns.all):
            if unknown.term == term and unknown.day is not None:
                away[unknown.day] += (
                    abs(values[place] - unknown.parameter.neutral) / (high - low)[place]
                )
        most = sorted(day for day in away if away[day] > max(away.values()) / 2)
        return replace(self, parameters=parameters, scope=_scope(term, unknowns), days=most)

    @property
    def plain_name(self) -> str:
        """The name in words."""
        return self.name.replace("_", " ")

    @property
    def described(self) -> str:
        """Name and scope in a few words."""
        name, scope = self.plain_name, self.scope
        if scope["kind"] == "day":
            return f"{name} by day (most on {_listed([day.isoformat() for day in self.days])})"
        of = f" of {_listed(scope['heliostats'])}" if scope.get("heliostats") else ""
        ended = f", ended by {scope['until']}" if scope.get("until") else ""
        return f"{name}{of}" + (
            f" since {scope['since']}{ended}" if scope["kind"] == "since" else ""
        )


def _fitted(value: Any, ci95: Any, unit: str, term: Term) -> dict[str, Any]:
    """A parameter in the report; one by day has the median of its days for all other days."""
    if not term.days:
        return {"value": value, "ci95": ci95, "unit": unit}
    usual = round(float(np.median(list(value.values()))), 6)
    spread = [round(float(v), 6) for v in np.median(list(ci95.values()), axis=0)]
    return {"value": usual, "ci95": spread, "unit": unit, "by_day": value, "ci95_by_day": ci95}


def _scope(term: Term, unknowns: ParameterVector) -> dict[str, Any]:
    """When and where an effect acts, as in DESIGN.md, section 7."""
    if term.since is not None and term.is_per_heliostat and len(unknowns.facets) == 1:
        term = replace(term, heliostats=tuple(name for name, _ in unknowns.facets))
    return term.scope.to_json()


def _listed(names: Sequence[str]) -> str:
    """List up to `MAX_LISTED` names."""
    n_more = len(names) - MAX_LISTED
    return ", ".join(names[:MAX_LISTED]) + (f" and {n_more} more" if n_more > 0 else "")


@dataclass(frozen=True, eq=False)
class Reference:
    """What errors are compared with.

    Attributes
    ----------
    heliostats : (H,)
        Of the held-out images.
    free : bool (H,) or None
        Images on which no effect acts that was found: they show what estimated surfaces leave. None
        for exact surfaces, and below `MIN_REFERENCE` such images: then it is no error.
    """

    heliostats: NDArray[np.str_]
    free: NDArray[np.bool_] | None

    @classmethod
    def of(cls, images: Sequence[FluxImage], effects: Sequence[Effect]) -> "Reference":
        """The reference of images with the effects that were found."""
        names = np.array([one.heliostat for one in images])
        acts = [[e.at(p.taken_at, p.heliostat) is not None for e in effects] for p in images]
        free = ~np.any(acts, axis=1)
        is_shown = all(one.is_estimated for one in images) and free.sum() >= MIN_REFERENCE
        return cls(names, free if is_shown and not free.all() else None)

    def beyond(self, values: Array) -> Array:
        """Values (H,) where effects act, less the mean of the others; all without others."""
        return values if self.free is None else values[~self.free] - values[self.free].mean()

    def gain(self, changes: Array) -> Gain:
        """The gain by changes of accuracy (H,), beyond that of the others."""
        names = self.heliostats if self.free is None else self.heliostats[~self.free]
        return paired_gain(self.beyond(changes), names)


@dataclass(frozen=True, eq=False)
class Study:
    """The outcome of a study.

    Attributes
    ----------
    images : sequence of FluxImage, n_fitted : int
        The H held-out images, which judge, and the number of those that were fitted.
    window : float [m]
        Side of the squares that were compared.
    measured, before, after : (H, 64, 64)
        Cuts of sum one: photographs, and forecasts without and with the effects found.
    position_residuals_before, position_residuals_after : (H, 2)
        Offsets of spots from where motors sent them, in standard deviations; NaN if unknown.
    displaced_before, displaced_after : (H, 2) [rad]
        The same offsets as angles.
    found : list of Found
    candidates : list of Candidate
        Each effect alone, the best first.
    effects : list of Effect
        The effects found, ready to be adopted.
    site : Site
    discrepancy : Discrepancy or None
        What terms outside the catalogue correct, where no effect is the cause.
    contradicted_by : list of str
        Why the effects found are not the cause, although they leave little.
    """

    images: Sequence[FluxImage]
    n_fitted: int
    window: float
    measured: Array
    before: Array
    after: Array
    position_residuals_before: Array
    position_residuals_after: Array
    displaced_before: Array
    displaced_after: Array
    found: list[Found]
    candidates: list[Candidate]
    effects: list[Effect]
    site: Site
    discrepancy: Discrepancy | None = None
    contradicted_by: list[str] = field(default_factory=list)

    @cached_property
    def accuracy_before(self) -> Array:
        """Accuracy (H,) of the declared model."""
        return flux_accuracies(self.measured, self.before)

    @cached_property
    def accuracy_after(self) -> Array:
        """Accuracy (H,) with the effects found."""
        return flux_accuracies(self.measured, self.after)

    @property
    def has_position(self) -> NDArray[np.bool_]:
        """Which images (H,) have a known offset of the spot from where motors sent it."""
        return is_known(self.position_residuals_before)

    @property
    def position_error_mrad(self) -> BeforeAfter | None:
        """Median angle [mrad] of those offsets; None if none is known."""
        if not self.has_position.any():
            return None
        both = (self.displaced_before[self.has_position], self.displaced_after[self.has_position])
        return BeforeAfter(*(1e3 * float(np.median(np.linalg.norm(d, axis=-1))) for d in both))

    @cached_property
    def noise_floor(self) -> float:
        """Mean error that the images' noise and the sheets behind the spots make alone."""
        return noise_floor(self.images, self.window)

    @cached_property
    def reference(self) -> "Reference":
        """What errors are compared with."""
        return Reference.of(self.images, self.effects)

    @property
    def unexplained_share(self) -> float:
        """Share of the error beyond noise that the effects found leave; zero if it is small."""
        first = self.excess_error
        return min(1.0, self._error_left / first) if first > TOLERANCE else 0.0

    @property
    def excess_error(self) -> float:
        """Mean error of the declared model beyond noise, of shape and of position."""
        return self._excess_error(self.accuracy_before, self.position_residuals_before)

    @property
    def _error_left(self) -> float:
        return self._excess_error(self.accuracy_after, self.position_residuals_after)

    def _excess_error(self, accuracy: Array, position_residuals: Array) -> float:
        """Mean error beyond noise, of shape and of position."""
        of_position = self.reference.beyond(loss(position_residuals) - EXPECTED * self.has_position)
        return self._shape_error(accuracy) + max(0.0, NAT * float(of_position.mean()))

    def _shape_error(self, accuracy: Array) -> float:
        """Mean error of shape beyond noise."""
        noise = self.noise_floor if self.reference.free is None else 0.0
        return max(0.0, float(self.reference.beyond(1 - accuracy).mean()) - noise)

    @property
    def leaves_little(self) -> bool:
        """Whether the effects found leave so little that they may be the cause.

        A target that moved or a motor that slipped explains no shape. So effects that change
        shapes may also be the cause of the shapes alone.
        """
        on_sheet = any(image.sheet_share for image in self.images)
        most = MAX_LEFT if len(self.found) < 2 or on_sheet else MAX_LEFT_OF_SEVERAL
        of_shape = self._shape_error(self.accuracy_before)
        explains_shape = (
            of_shape > TOLERANCE
            and not any(effect.only_moves for effect in self.effects)
            and self._shape_error(self.accuracy_after) <= most * of_shape
        )
        is_little = self.unexplained_share <= most or not self.has_unexplained_error
        return bool(self.found) and (is_little or explains_shape)

    @property
    def verdict(self) -> Verdict:
        """Whether an effect explains the error, the error needs no explanation, or none does."""
        if self.leaves_little and not self.contradicted_by:
            return "effect"
        return "unexplained" if self.found or self.has_unexplained_error else "none"

    @property
    def partly(self) -> list[str]:
        """Names of effects that gain, but are not the cause."""
        return [found.name for found in self.found] if self.verdict == "unexplained" else []

    @cached_property
    def pattern(self) -> Pattern:
        """The pattern that the photographs' residuals have in common."""
        return pattern_of(self.images, self.measured, self.after, self.window)

    @property
    def is_pattern(self) -> bool:
        """Whether most of the error that is left is a pattern of the target, not of the light."""
        left = self._error_left
        # The mean magnitude of deviations is 0.8 of their standard deviation.
        return left > 0 and self.pattern.is_targets and 0.8 * self.pattern.depth >= left / 2

    @property
    def has_unexplained_error(self) -> bool:
        """Whether more error is left than noise makes."""
        return self._error_left > TOLERANCE
