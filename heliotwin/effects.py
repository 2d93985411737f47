"""Functions that make effects of a plant: see `model.effects.own` and the guide of studies.

Examples
--------
>>> import torch
>>> from heliotwin.effects import mirror_effect
>>> focus = mirror_effect(
...     "focus_by_hour",
...     "Focus by hour: facets bend as the sun warms one side of them.",
...     lambda x, y, X, Y, seen: 1e-3 / 2 * (x**2 + y**2) * torch.sin(seen.hour_angle),
...     low=-4, high=4, unit="mrad/m",
... )
>>> focus.name
'focus_by_hour'
"""

from model.effects.own import (
    Circumstances,
    blur_effect,
    image_effect,
    load_effects,
    mirror_effect,
    mount_effect,
)

__all__ = [
    "Circumstances",
    "blur_effect",
    "image_effect",
    "load_effects",
    "mirror_effect",
    "mount_effect",
]
