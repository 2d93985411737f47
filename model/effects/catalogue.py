"""The catalogue of effects, and effects as JSON: ``{"name": .., "parameters": {..}}`` (DESIGN.md, section 5)."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from torch import Tensor

from model.effects.axis_tilt import AxisTilt
from model.effects.background import Background
from model.effects.base import Effect, Parameter
from model.effects.blocking import Blocking
from model.effects.camera_blur import CameraBlur
from model.effects.camera_ghost import CameraGhost
from model.effects.camera_response import CameraResponse
from model.effects.camera_shoulder import CameraShoulder
from model.effects.facet_canting import FacetCanting
from model.effects.gravity_bending import GravityBending
from model.effects.slope_error import SlopeError
from model.effects.soiling import Soiling
from model.effects.sun_position import SunPosition
from model.effects.sun_shape import SunShapeEffect
from model.effects.target_registration import TargetRegistration
from model.effects.tracking_jitter import TrackingJitter
from model.errors import InvalidInputError

CATALOGUE: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        SunPosition,
        AxisTilt,
        FacetCanting,
        GravityBending,
        Soiling,
        Blocking,
        SunShapeEffect,
        SlopeError,
        TrackingJitter,
        Background,
        CameraBlur,
        CameraGhost,
        CameraResponse,
        CameraShoulder,
        TargetRegistration,
    )
}
"""Every effect by its name, in the order in which light meets them."""


def in_light_order(effects: Iterable[Effect]) -> list[Effect]:
    """Effects in the catalogue's order, however they were listed; those of no catalogue come last."""
    order = {name: index for index, name in enumerate(CATALOGUE)}
    return sorted(effects, key=lambda effect: order.get(effect.name, len(order)))


def light_effects(effects: Iterable[Effect]) -> list[Effect]:
    """Those that act on light itself; the others say how the camera's photograph of it differs."""
    return [effect for effect in effects if effect.stage != "image"]


def model_version(effects: Iterable[Effect]) -> str:
    """Version of the plant's model and the effects it holds, ``1:none`` where it holds none."""
    names = [effect.name for effect in in_light_order(effects)]
    return f"2:{'+'.join(names)}" if names else "1:none"


def effects_from_json(data: object) -> list[Effect]:
    """Effects of a list, or of an object such as a study's report that has the list under ``effects``.

    Raises
    ------
    InvalidInputError
        Where it is neither, or an effect is malformed.
    """
    entries = data.get("effects") if isinstance(data, Mapping) else data
    if not isinstance(entries, list):
        raise InvalidInputError("'effects' must be a list of effects")
    return [effect_from_json(entry) for entry in entries]


def effect_from_json(data: object) -> Effect:
    """One effect; parameters that are not given are neutral, and may come as a report's ``{"value": ..}``.

    Raises
    ------
    InvalidInputError
        For an unknown effect or parameter, and for a value out of its bounds.
    """
    if not isinstance(data, Mapping) or not isinstance(data.get("name"), str):
        raise InvalidInputError(f"an effect must be an object with a 'name', got {str(data)[:80]}")
    name, given = data["name"], data.get("parameters", {})
    if name not in CATALOGUE:
        raise InvalidInputError(f"effect '{name}' is unknown; the catalogue has {', '.join(CATALOGUE)}")
    known = {p.name: p for p in CATALOGUE[name].parameters()}
    if not isinstance(given, Mapping):
        raise InvalidInputError(f"effect {name}: 'parameters' must be an object")
    for key in given:
        if key not in known:
            raise InvalidInputError(f"effect {name}: no parameter '{key}'; it has {', '.join(known)}")
    return CATALOGUE[name](**{key: _read(name, known[key], value) for key, value in given.items()})


def _read(effect: str, parameter: Parameter, data: Any) -> Any:
    """A parameter's value, checked before numbers become arrays."""
    value = _bare(data)
    if parameter.scope in ("set", "camera") or not isinstance(value, Mapping):
        return value  # what is no mapping where one is wanted, the effect itself refuses
    by_heliostat = {name: _bare(one) for name, one in value.items()}
    for one in by_heliostat.values():
        parameter.check(effect, one)
    return {name: np.asarray(one, dtype=np.float64) for name, one in by_heliostat.items()}


def _bare(data: Any) -> Any:
    """The value of a report's ``{"value": .., "ci95": .., "unit": ..}``; anything else as it is."""
    return data["value"] if isinstance(data, Mapping) and "value" in data else data


def effect_to_json(effect: Effect) -> dict[str, Any]:
    """An effect as JSON; `effect_from_json` reads it back."""
    return {
        "name": effect.name,
        "parameters": {p.name: _plain(getattr(effect, p.name)) for p in effect.parameters()},
    }


def _plain(value: Any) -> Any:
    """Tensors and arrays as floats and lists."""
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    return np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value, dtype=np.float64).tolist()
