"""Effects that a plant's model may lack: one file for each effect.

Studies find effects, and forecasts use the adopted ones.
"""

from model.effects.application import (
    apply_image_effects,
    apply_mount_effects,
    apply_optics_effects,
    apply_sun_effects,
    effects_of_stage,
)
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
    "apply_image_effects",
    "apply_mount_effects",
    "apply_optics_effects",
    "apply_sun_effects",
    "effect_from_json",
    "effect_to_json",
    "effects_from_json",
    "effects_of_stage",
    "in_light_order",
    "light_effects",
    "model_version",
    "parameter",
]
