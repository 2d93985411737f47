"""The catalogue of effects, and effects as JSON.

The form is ``{"name": .., "parameters": {..}, "scope": {..}}``.
"""

from collections.abc import Iterable, Mapping
from datetime import date
from importlib import import_module
from typing import Any

import numpy as np

from model.effects.base import Effect, Parameter
from model.effects.correction import Correction, correction_from_json
from model.effects.scope import Always, ByDay, day_from_json, scope_from_json
from model.errors import InvalidInputError

ORDER = (
    "sun_position",
    "axis_tilt",
    "pylon_bending",
    "encoder_offset",
    "facet_canting",
    "gravity_bending",
    "soiling",
    "blocking",
    "known_neighbours",
    "sun_shape",
    "slope_error",
    "tracking_jitter",
    "background",
    "camera_blur",
    "camera_ghost",
    "camera_response",
    "camera_shoulder",
    "target_registration",
)
"""Order of the effects along the light's path; each is the file of that name in this package."""


def _effect_of(name: str) -> type[Effect]:
    """The effect class of a file in this package."""
    module = import_module(f"model.effects.{name}").__name__
    return next(effect for effect in Effect.__subclasses__() if effect.__module__ == module)


CATALOGUE: dict[str, type[Effect]] = {name: _effect_of(name) for name in ORDER}
"""All effects by name, in the order of `ORDER`."""


def in_light_order(effects: Iterable[Effect]) -> list[Effect]:
    """Sort effects by the catalogue's order; effects outside of the catalogue come last."""
    order = {name: index for index, name in enumerate(CATALOGUE)}
    return sorted(effects, key=lambda effect: order.get(effect.name, len(order)))


def light_effects(effects: Iterable[Effect]) -> list[Effect]:
    """Effects on the light itself; the others act on the camera's image."""
    return [effect for effect in effects if effect.stages != {"image"}]


def model_version(effects: Iterable[Effect]) -> str:
    """Version of the plant's model and the names of its effects, ``1:none`` without effects."""
    names = [effect.name for effect in in_light_order(effects)]
    return f"2:{'+'.join(names)}" if names else "1:none"


def effects_from_json(data: object) -> list[Effect]:
    """Parse effects from a list, or from an object with the list under ``effects``.

    Such an object is a study's report. If that has a discrepancy, this is the one effect, a
    correction: effects that explain only a part are not those of the model.

    Raises
    ------
    InvalidInputError
        If it is neither, or an effect is malformed.
    """
    if isinstance(data, Mapping) and isinstance(data.get("discrepancy"), Mapping):
        return [correction_from_json({**data, **data["discrepancy"]})]
    entries = data.get("effects") if isinstance(data, Mapping) else data
    if not isinstance(entries, list):
        raise InvalidInputError("'effects' must be a list of effects")
    return [effect_from_json(entry) for entry in entries]


def effect_from_json(data: object) -> Effect:
    """Parse one effect; missing parameters are neutral.

    Values may have the form of a report, ``{"value": ..}``.

    Raises
    ------
    InvalidInputError
        For an unknown effect, parameter or scope, and for a value out of its bounds.
    """
    if not isinstance(data, Mapping) or not isinstance(data.get("name"), str):
        raise InvalidInputError(f"an effect must be an object with a 'name', got {str(data)[:80]}")
    name, given = data["name"], data.get("parameters", {})
    if name == Correction.name:
        return correction_from_json(given, data.get("scope"))
    if name not in CATALOGUE:
        raise InvalidInputError(
            f"effect '{name}' is unknown; the catalogue has {', '.join(CATALOGUE)}; an own effect"
            " needs its file (--effects-from, HELIOTWIN_EFFECTS_FROM)"
        )
    known = {p.name: p for p in CATALOGUE[name].parameters()}
    if not isinstance(given, Mapping):
        raise InvalidInputError(f"effect {name}: 'parameters' must be an object")
    for key in given:
        if key not in known:
            raise InvalidInputError(
                f"effect {name}: no parameter '{key}'; it has {', '.join(known)}"
            )
    values = {key: _read(name, known[key], value) for key, value in given.items()}
    scope = scope_from_json(data.get("scope"), name)
    if isinstance(scope, ByDay):
        scope = ByDay(_by_day(name, known, given), scope.until)
    effect = CATALOGUE[name](**values, scope=scope)
    named = None if isinstance(scope, ByDay) else scope.heliostats
    if named is not None and effect.heliostats not in (None, list(named)):
        raise InvalidInputError(
            f"effect {name}: the scope's 'heliostats' must be those that its parameters name, or"
            f" null, got {', '.join(named)[:80]}"
        )
    return effect


def _by_day(
    effect: str, known: Mapping[str, Parameter], given: Mapping[str, Any]
) -> dict[date, dict[str, float]]:
    """Parameter values by day; missing ones are as on other days."""
    days: dict[date, dict[str, float]] = {}
    for key, data in given.items():
        by_day = data.get("by_day", {}) if isinstance(data, Mapping) else {}
        if not isinstance(by_day, Mapping):
            raise InvalidInputError(
                f"effect {effect}: 'by_day' of '{key}' must map days to numbers"
            )
        for day, value in by_day.items():
            known[key].check(effect, value)
            days.setdefault(day_from_json(day, effect), {})[key] = float(value)
    return days


def _read(effect: str, parameter: Parameter, data: Any) -> Any:
    """A parameter's value, checked before numbers become arrays."""
    value = _bare(data)
    if parameter.shared or not isinstance(value, Mapping):
        return value  # the effect itself rejects a value that is not a mapping
    by_heliostat = {name: _bare(one) for name, one in value.items()}
    for one in by_heliostat.values():
        parameter.check(effect, one)
    return {name: np.asarray(one, dtype=np.float64) for name, one in by_heliostat.items()}


def _bare(data: Any) -> Any:
    """The value of a report's ``{"value": .., "ci95": .., "unit": ..}``; other data unchanged."""
    return data["value"] if isinstance(data, Mapping) and "value" in data else data


def effect_to_json(effect: Effect) -> dict[str, Any]:
    """Convert an effect to JSON; `effect_from_json` reads it back."""
    plain = effect.parameters_to_json()
    if effect.scope == Always():
        return {"name": effect.name, "parameters": plain}
    if isinstance(effect.scope, ByDay):
        days = {day.isoformat(): values for day, values in sorted(effect.scope.by_day.items())}
        plain = {
            name: {
                "value": value,
                "by_day": {day: values[name] for day, values in days.items() if name in values},
            }
            for name, value in plain.items()
        }
    return {"name": effect.name, "parameters": plain, "scope": effect.scope.to_json()}
