"""What a study found: DESIGN.md, section 7, and what an operator wants to know besides."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from model.effects import Always, Effect
from model.metrics import flux_accuracies
from model.study.advice import told_apart_by
from model.study.covariates import covariates_of
from model.study.flux_images import FluxImage, noise_floor
from model.study.judging import Gain, rank_correlation
from model.study.pattern import Pattern, pattern_of
from model.study.position import EXPECTED, NAT, is_known, loss
from model.study.unknowns import Term, Unknowns

Array = NDArray[np.float64]
Verdict = Literal["effect", "none", "unexplained"]

TOLERANCE = 0.006
"""Error beyond the images' noise up to which nothing is to be explained: undeclared sets that hold no effect, and sets
whose effects are known, keep less (two tracers, resampling, surfaces of finite resolution)."""

SHARE = 1 / 3
"""Share of that error which the effects found must remove for the verdict to rest on them."""

SHARED = 0.02
"""Standard deviation, of a parameter's distance from neutral, of what all images of a study err by together.

Faint light that 8 bits round away, say, or the tracer's grid: images do not disagree about these. Chosen by sets of
known effects (`tests.benchmarks.study`), where the median error of most parameters is 0.2 to 2 %.
"""


LISTED = 4
"""How many days or heliostats a conclusion names."""


@dataclass(frozen=True)
class Candidate:
    """One effect of the catalogue, fitted alone: mean accuracy of held-out images, its gain, and that of accuracy."""

    name: str
    accuracy_after: float
    gain: Gain
    accuracy_gain: Gain


@dataclass(frozen=True)
class Found:
    """An effect that was found, what it gained when it was added, and what could not be told from it.

    Attributes
    ----------
    name : str
    gain : Gain
        That it was added for: of accuracy, and by where spots lie (`model.study.position`).
    accuracy_gain : Gain
    lookalikes : list of str
    parameters : dict
        Nested as in the report: name, then heliostat where it belongs to one, then a list over facets.
    scope : dict
        When it acts, as in the report.
    days : list of date
        Those on which an effect that comes and goes by day differs most from what changes nothing.
    """

    name: str
    gain: Gain
    accuracy_gain: Gain
    lookalikes: list[str]
    parameters: dict[str, Any] = field(default_factory=dict)
    scope: dict[str, Any] = field(default_factory=lambda: Always().to_json())
    days: list[date] = field(default_factory=list)

    def fitted(self, term: Term, unknowns: Unknowns, values: Array, spread: Array) -> "Found":
        """With its final parameters and their 95 % intervals, cut to their bounds."""
        low, high = unknowns.bounds
        spread = np.hypot(spread, SHARED * (values - unknowns.neutral))
        intervals = np.stack([values - 1.96 * spread, values + 1.96 * spread], axis=-1)
        intervals = np.clip(intervals, low[:, None], high[:, None])
        value = unknowns.nested(term, [round(float(v), 6) for v in values])
        ci95 = unknowns.nested(term, [[round(float(v), 6) for v in interval] for interval in intervals])
        parameters = {p.name: _fitted(value[p.name], ci95[p.name], p.unit, term) for p in term.kind.parameters()}
        away = dict.fromkeys(term.days, 0.0)
        for place, unknown in enumerate(unknowns.all):
            if unknown.term == term and unknown.day is not None:
                away[unknown.day] += abs(values[place] - unknown.parameter.neutral) / (high - low)[place]
        most = sorted(day for day in away if away[day] > max(away.values()) / 2)
        return replace(self, parameters=parameters, scope=_scope(term, unknowns), days=most)

    @property
    def described(self) -> str:
        """What it is and when, in a few words."""
        name, scope = _plain(self.name), self.scope
        if scope["kind"] == "day":
            return f"{name} by day (most on {_listed([day.isoformat() for day in self.days])})"
        of = f" of {_listed(scope['heliostats'])}" if scope.get("heliostats") else ""
        return f"{name}{of}" + (f" since {scope['since']}" if scope["kind"] == "since" else "")


def _fitted(value: Any, ci95: Any, unit: str, term: Term) -> dict[str, Any]:
    """A parameter in the report; one by day has the median of its days for all others."""
    if not term.days:
        return {"value": value, "ci95": ci95, "unit": unit}
    usual = round(float(np.median(list(value.values()))), 6)
    spread = [round(float(v), 6) for v in np.median(list(ci95.values()), axis=0)]
    return {"value": usual, "ci95": spread, "unit": unit, "by_day": value, "ci95_by_day": ci95}


def _scope(term: Term, unknowns: Unknowns) -> dict[str, Any]:
    """When and where an effect acts, as DESIGN.md, section 7, has it."""
    if term.since is not None and term.own and len(unknowns.facets) == 1:
        term = replace(term, heliostats=tuple(name for name, _ in unknowns.facets))
    return term.scope.to_json()


def _listed(names: Sequence[str]) -> str:
    """Some names, the first few where they are many."""
    return ", ".join(names[:LISTED]) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")


@dataclass(frozen=True, eq=False)
class Study:
    """The outcome of a study.

    Attributes
    ----------
    images : sequence of FluxImage
        The H held-out ones, by which it was judged.
    fitted : int
        How many others were fitted.
    window : float [m]
        Side of the squares that were compared.
    measured, before, after : (H, 64, 64)
        Cuts of sum one: photographs, forecasts of the declared model, forecasts with the effects found.
    off_before, off_after : (H, 2)
        How far their spots lie from where motors sent them, in independent standard deviations; NaN where motors are
        not known.
    displaced_before, displaced_after : (H, 2) [rad]
        The same as it was measured.
    found : list of Found
    candidates : list of Candidate
        Every effect alone, the best first.
    effects : list of Effect
        The effects found, ready to be adopted.
    latitude_deg : float [deg]
        Of the plant.
    """

    images: Sequence[FluxImage]
    fitted: int
    window: float
    measured: Array
    before: Array
    after: Array
    off_before: Array
    off_after: Array
    displaced_before: Array
    displaced_after: Array
    found: list[Found]
    candidates: list[Candidate]
    effects: list[Effect]
    latitude_deg: float

    @cached_property
    def accuracy_before(self) -> Array:
        """Accuracy (H,) of the declared model."""
        return flux_accuracies(self.measured, self.before)

    @cached_property
    def accuracy_after(self) -> Array:
        """Accuracy (H,) with the effects found."""
        return flux_accuracies(self.measured, self.after)

    @property
    def placed(self) -> NDArray[np.bool_]:
        """Which images (H,) tell how far their spots lie from where motors sent them."""
        return is_known(self.off_before)

    @property
    def position_error_mrad(self) -> tuple[float, float] | None:
        """Median angle [mrad] at the heliostat of those, before and after; None where there is none."""
        if not self.placed.any():
            return None
        both = (self.displaced_before[self.placed], self.displaced_after[self.placed])
        before, after = (1e3 * float(np.median(np.linalg.norm(displaced, axis=-1))) for displaced in both)
        return before, after

    @cached_property
    def noise_floor(self) -> float:
        """Mean error that the images' noise and the sheets behind the spots make alone."""
        return noise_floor(self.images, self.window)

    @property
    def unexplained_share(self) -> float:
        """Share of the error beyond noise that the effects found leave; zero where there is none to speak of."""
        first = self._excess(self.accuracy_before) + self._excess_of_place(self.off_before)
        return min(1.0, self._left / first) if first > TOLERANCE else 0.0

    @property
    def _left(self) -> float:
        return self._excess(self.accuracy_after) + self._excess_of_place(self.off_after)

    def _excess(self, accuracy: Array) -> float:
        """Mean error beyond noise."""
        return max(0.0, 1 - float(accuracy.mean()) - self.noise_floor)

    def _excess_of_place(self, off: Array) -> float:
        """The same of where spots lie."""
        return max(0.0, NAT * float((loss(off) - EXPECTED * self.placed).mean()))

    @property
    def verdict(self) -> Verdict:
        """Whether an effect explains the residual, there is none to explain, or none does."""
        if self.found and self.unexplained_share <= 1 - SHARE:
            return "effect"
        return "unexplained" if self.incomplete and not self.is_pattern else "none"

    @cached_property
    def pattern(self) -> Pattern:
        """What the photographs' residuals have in common, place by place."""
        return pattern_of(self.images, self.measured, self.after, self.window)

    @property
    def is_pattern(self) -> bool:
        """Whether most of what is left is the target's own pattern, which no model of the light can explain.

        Of deviations of standard deviation ``depth`` the mean magnitude is 0.8 of that.
        """
        left = self._left
        return left > 0 and self.pattern.is_targets and 0.8 * self.pattern.depth >= left / 2

    @property
    def flattered(self) -> int:
        """How many of the judging images a surface was predicted from, for want of others."""
        return sum(p.seen for p in self.images)

    @property
    def incomplete(self) -> bool:
        """Whether more error than noise makes is left, whatever was found."""
        return self._left > TOLERANCE

    def covariates(self) -> dict[str, float]:
        """Rank correlation of the error that is left with what may drive it, the strongest first."""
        error = 1 - self.accuracy_after
        known = covariates_of(self.images, self.latitude_deg)
        found = {covariate.name: round(rank_correlation(error, v), 3) for covariate, v in known.items()}
        return dict(sorted(found.items(), key=lambda item: -abs(item[1])))

    def residual_map(self) -> Array:
        """Mean of forecast minus measured (64, 64) with the effects found, in shares of the measured peaks."""
        peaks = self.measured.max(axis=(1, 2), keepdims=True)
        return np.asarray(((self.after - self.measured) / peaks).mean(axis=0))

    def conclusion(self) -> str:
        """One plain sentence, and others where a pattern is left, or the images that judge are not independent."""
        said = self._conclusion()
        if self.incomplete and self.is_pattern:
            said += (
                f" What is left is the target's own pattern, its marks and grid lines: {self.pattern.depth:.1%} of the "
                "light, at the same places of the target in all photographs."
            )
        if not self.flattered:
            return said
        return (
            f"{said} {self.flattered} of the {len(self.images)} images that judge are among those "
            "that the surfaces were predicted from, which flatters both accuracies: predict from fewer, or take more."
        )

    def _conclusion(self) -> str:
        before, after = float(self.accuracy_before.mean()), float(self.accuracy_after.mean())
        names = " and ".join(f.described for f in self.found)
        if self.verdict == "effect":
            doubts = [
                f"{_plain(f.name)} from {', '.join(map(_plain, f.lookalikes))}" for f in self.found if f.lookalikes
            ]
            doubt = f"; these images cannot tell {' nor '.join(doubts)}" if doubts else ""
            rest = (
                f"; {self.unexplained_share:.0%} of the error beyond noise stays unexplained" if self.incomplete else ""
            )
            return (
                f"The images demand {names}: accuracy on held-out images {'rises' if after > before else 'goes'} from "
                f"{before:.1%} to {after:.1%}{self._said_of_place()}{doubt}{rest}."
            )
        if self.verdict == "none":
            return (
                f"The declared model explains the images: accuracy {before:.1%}, no effect improves it significantly."
            )
        part = f"; {names} explains part of it ({after:.1%})" if names else ""
        said = f"accuracy {before:.1%}{part}{self._said_of_place()}"
        return f"Something is missing that no effect of the catalogue explains: {said}."

    def _said_of_place(self) -> str:
        if self.position_error_mrad is None:
            return ""
        before, after = self.position_error_mrad
        change = f", {before:.1f} mrad before" if self.found else ""
        return f", and the light lies {after:.1f} mrad from where motors sent it{change}"

    def to_json(self) -> dict[str, Any]:
        """The report of DESIGN.md, section 7."""
        return {
            "verdict": self.verdict,
            "conclusion": self.conclusion(),
            "images": {
                "fit": self.fitted,
                "held_out": len(self.images),
                **({"held_out_but_predicted_from": self.flattered} if self.flattered else {}),
                **({"held_out_with_motors": int(self.placed.sum())} if self.placed.any() else {}),
            },
            "window_m": self.window,
            "before": self._summary(self.accuracy_before) | self._place(0),
            "after": self._summary(self.accuracy_after) | self._place(1),
            "noise_floor": round(self.noise_floor, 5),
            "unexplained_share": round(self.unexplained_share, 4),
            "effects": [_effect(f) | self._gain_of_all(f) for f in self.found],
            "candidates": [
                {
                    "name": c.name,
                    "accuracy_after": round(c.accuracy_after, 5),
                    "score": round(c.gain.score, 2),
                    "accuracy_gain": _gain(c.accuracy_gain),
                    **self._gain_of_all(c),
                }
                for c in self.candidates
            ],
            "residual": {
                "covariates": self.covariates(),
                "pattern": {
                    "is_targets": bool(self.is_pattern),
                    "on_target": round(float(self.pattern.on_target), 4),
                    "on_spot": round(float(self.pattern.on_spot), 4),
                    "depth": round(float(self.pattern.depth), 5),
                },
                "sign": "forecast minus photograph",
                "mean_map_8x8": self.residual_map().reshape(8, 8, 8, 8).mean(axis=(1, 3)).round(4).tolist(),
            },
        }

    def _place(self, when: int) -> dict[str, float]:
        known = self.position_error_mrad
        return {} if known is None else {"position_error_mrad": round(known[when], 3)}

    def _gain_of_all(self, one: Candidate | Found) -> dict[str, Any]:
        """The gain by shape and place, which is that of accuracy where no place is known."""
        return {"gain": _gain(one.gain)} if self.placed.any() else {}

    def _summary(self, accuracy: Array) -> dict[str, Any]:
        return {
            "accuracy_mean": round(float(accuracy.mean()), 5),
            "accuracy_median": round(float(np.median(accuracy)), 5),
            "per_image": {p.key: round(float(a), 5) for p, a in zip(self.images, accuracy, strict=True)},
        }


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _gain(gain: Gain) -> dict[str, Any]:
    return {"mean": round(gain.mean, 5), "ci95": [round(gain.low, 5), round(gain.high, 5)]}


def _effect(found: Found) -> dict[str, Any]:
    return {
        "name": found.name,
        "scope": found.scope,
        "parameters": found.parameters,
        "accuracy_gain": _gain(found.accuracy_gain),
        "lookalikes": found.lookalikes,
        "told_apart_by": {name: told_apart_by(found.name, name) for name in found.lookalikes},
    }
