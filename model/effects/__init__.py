"""Effects that a plant's model may lack: one file an effect, found by studies, adopted into forecasts."""

from model.effects.base import Effect, Parameter, Scope, Stage, parameter
from model.effects.catalogue import (
    CATALOGUE,
    effect_from_json,
    effect_to_json,
    effects_from_json,
    in_light_order,
    light_effects,
    model_version,
)

__all__ = [
    "CATALOGUE",
    "Effect",
    "Parameter",
    "Scope",
    "Stage",
    "effect_from_json",
    "effect_to_json",
    "effects_from_json",
    "in_light_order",
    "light_effects",
    "model_version",
    "parameter",
]
