"""Worlds that change while a season's photographs are taken: days of haze and wind, new cantings,
new cameras.

As in `tests.undeclared.world`, at three strengths. The truth of a change is as a study ought to
report it (DESIGN.md, section 7): an effect of the catalogue with its ``scope``, and values
``by_day`` where it differs from day to day.
"""

from collections.abc import Callable, Sequence
from datetime import date
from typing import Any

import numpy as np

from tests.undeclared.plan import Plan
from tests.undeclared.world import CATALOGUE, World

Truth = list[dict[str, Any]]
Changing = tuple[list[World], Truth]
"""A world for each photograph, and the effects of the catalogue as JSON has them."""

Change = Callable[[int, Sequence[Plan], np.random.Generator], Changing]

HAZY = 0.4
"""Share of the days on which something is in the air."""


def calm(level: int, plans: Sequence[Plan], rng: np.random.Generator) -> Changing:
    """Nothing but the hours' light on the sheet changes."""
    return [World()] * len(plans), []


def always(name: str) -> Change:
    """An effect that all photographs share."""

    def change(level: int, plans: Sequence[Plan], rng: np.random.Generator) -> Changing:
        fields, parameters = CATALOGUE[name](level, _names(plans), rng)
        return [World(**fields)] * len(plans), [_truth(name, parameters, {"kind": "set"})]

    return change


def of_one(name: str) -> Change:
    """An effect that one heliostat's mirror or drive has always, and no other's."""

    def change(level: int, plans: Sequence[Plan], rng: np.random.Generator) -> Changing:
        names = _names(plans)
        fields, parameters = CATALOGUE[name](level, names, rng)
        chosen = names[rng.integers(len(names))]
        changed = World(**fields)
        worlds = [changed if plan.heliostat.name == chosen else World() for plan in plans]
        own = {key: _of([chosen], value) for key, value in parameters.items()}
        return worlds, [_truth(name, own, {"kind": "set", "heliostats": [chosen]})]

    return change


def since(name: str, of_one: bool = False) -> Change:
    """An effect that begins before some day's first photograph, perhaps of one heliostat only."""

    def change(level: int, plans: Sequence[Plan], rng: np.random.Generator) -> Changing:
        names = _names(plans)
        fields, parameters = CATALOGUE[name](level, names, rng)
        chosen = [names[rng.integers(len(names))]] if of_one else names
        begins = _begin([plan for plan in plans if plan.heliostat.name in chosen], rng)
        changed = World(**fields)
        worlds = [
            changed if plan.day >= begins and plan.heliostat.name in chosen else World()
            for plan in plans
        ]
        own = {key: _of(chosen, value) for key, value in parameters.items()}
        scope = {
            "kind": "since",
            "since": begins.isoformat(),
            "until": None,
            "heliostats": chosen if of_one else None,
        }
        return worlds, [_truth(name, own, scope)]

    return change


def law_since(level: int, plans: Sequence[Plan], rng: np.random.Generator) -> Changing:
    """A camera's settings change: sheet and spot together have another response curve.

    No effect of the catalogue is exactly like that.
    """
    begins = _begin(plans, rng)
    changed = World(law=_law(level, rng))
    scope = {"kind": "since", "since": begins.isoformat(), "until": None, "heliostats": None}
    return [changed if plan.day >= begins else World() for plan in plans], [
        _truth("camera_response", {}, scope)
    ]


def two_cameras(level: int, plans: Sequence[Plan], rng: np.random.Generator) -> Changing:
    """The camera before one of the targets has another curve from the beginning: there is no date
    to find.
    """
    other = World(law=_law(level, rng))
    target = plans[rng.integers(len(plans))].target.name
    return [other if plan.target.name == target else World() for plan in plans], []


def by_day(
    name: str,
    parameter: str,
    neutral: float,
    sizes: Sequence[float],
    fields: Callable[[float], Any],
) -> Change:
    """An effect of one parameter that has another size on some days; ``fields`` are those of
    `World` for it.
    """

    def change(level: int, plans: Sequence[Plan], rng: np.random.Generator) -> Changing:
        days = sorted({plan.day for plan in plans})
        bad = rng.choice(len(days), round(HAZY * len(days)), replace=False)
        values = dict.fromkeys(days, neutral) | {
            days[i]: round(sizes[level] * rng.uniform(0.7, 1.3), 4) for i in bad
        }
        each = {
            "value": neutral,
            "by_day": {day.isoformat(): value for day, value in values.items()},
        }
        truth = [_truth(name, {parameter: each}, {"kind": "day"})]
        return [World(**fields(values[plan.day])) for plan in plans], truth

    return change


CHANGES: dict[str, Change] = {
    "calm": calm,
    "haze_by_day": by_day(
        "sun_shape", "circumsolar_ratio", 0.02, (0.1, 0.2, 0.35), lambda v: {"circumsolar_ratio": v}
    ),
    "jitter_by_day": by_day(
        "tracking_jitter", "sigma_mrad", 0.0, (0.7, 1.0, 1.5), lambda v: {"first_axis_mrad": v}
    ),
    "background_by_day": by_day(
        "background", "level", 0.0, (0.0015, 0.003, 0.006), lambda v: {"stray": (v, 0.0, 0.0)}
    ),
    "response_since": since("camera_response"),
    "shoulder_since": since("camera_shoulder"),
    "law_since": law_since,
    "canting_since": since("facet_canting", of_one=True),
    "canting_of_all_since": since("facet_canting"),
    "soiling_since": since("soiling", of_one=True),
    "two_cameras": two_cameras,
    "slope_error_of_one": of_one("slope_error"),
    "jitter_of_one": of_one("tracking_jitter"),
    **{
        f"{name}_always": always(name)
        for name in ("sun_shape", "slope_error", "facet_canting", "camera_response")
    },
}

MOVED: dict[str, Change] = {"encoder_since": since("encoder_offset", of_one=True)}
"""Changes that are visible by motor positions, but not by shapes."""

WITHOUT_SHEET = ("background_by_day", *MOVED)
"""Changes that a sheet's own light would hide: their images are of light alone."""


def changing(case: str, level: int, plans: Sequence[Plan], rng: np.random.Generator) -> Changing:
    """The worlds of a season's photographs, and the truth."""
    return {**CHANGES, **MOVED}[case](level, plans, rng)


def _names(plans: Sequence[Plan]) -> list[str]:
    """Heliostats in the order of their index."""
    return [name for _, name in sorted({(plan.index, plan.heliostat.name) for plan in plans})]


def _of(names: Sequence[str], value: Any) -> Any:
    """A parameter of these heliostats, where it belongs to heliostats."""
    return {name: value[name] for name in names} if isinstance(value, dict) else value


def _begin(plans: Sequence[Plan], rng: np.random.Generator) -> date:
    """The day of one of the photographs in the middle third."""
    third = len(plans) // 3
    return plans[rng.integers(third, len(plans) - third)].day


def _law(level: int, rng: np.random.Generator) -> float:
    return float((1.2, 1.4, 1.7)[level] ** rng.choice([-1.0, 1.0]))


def _truth(name: str, parameters: dict[str, Any], scope: dict[str, Any]) -> dict[str, Any]:
    return {"name": name, "parameters": parameters, "scope": scope}
