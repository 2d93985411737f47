"""Effects that a plant's model may lack: one file an effect, found by studies, adopted into forecasts."""

from model.effects.base import Effect, Parameter, Stage, acting, parameter
from model.effects.catalogue import (
    CATALOGUE,
    effect_from_json,
    effect_to_json,
    effects_from_json,
    in_light_order,
    light_effects,
    model_version,
)
from model.effects.scope import Always, ByDay, Scope, Since

__all__ = [
    "CATALOGUE",
    "Always",
    "ByDay",
    "Effect",
    "Parameter",
    "Scope",
    "Since",
    "Stage",
    "acting",
    "effect_from_json",
    "effect_to_json",
    "effects_from_json",
    "in_light_order",
    "light_effects",
    "model_version",
    "parameter",
]
