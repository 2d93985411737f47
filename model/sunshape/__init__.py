"""Sun shapes: the radiance of the sun and its aureole over the angle from the disc's centre."""

from importlib import import_module

from model.sunshape.base import (
    FREQUENCY_COUNT,
    FREQUENCY_STEP,
    SOLAR_DISC,
    SunShape,
    half_angle,
    random_angles,
    transfer_table,
)
from model.sunshape.buie import AUREOLE_EDGE, Buie
from model.sunshape.gaussian import Gaussian
from model.sunshape.hazy import CLEAR_SKY, Hazy
from model.sunshape.pillbox import Pillbox
from model.sunshape.tabulated import Tabulated

__all__ = [
    "AUREOLE_EDGE",
    "CLEAR_SKY",
    "FREQUENCY_COUNT",
    "FREQUENCY_STEP",
    "SHAPES",
    "SOLAR_DISC",
    "Buie",
    "Gaussian",
    "Hazy",
    "Pillbox",
    "SunShape",
    "Tabulated",
    "half_angle",
    "random_angles",
    "transfer_table",
]

DECLARABLE = ("buie", "pillbox", "gaussian")
"""Those that ``twin.json`` may name; each is the file of that name in this package."""


def _shape_of(name: str) -> type[SunShape]:
    """The class that a file of this package has for its shape."""
    module = import_module(f"model.sunshape.{name}").__name__
    return next(shape for shape in SunShape.__subclasses__() if shape.__module__ == module)


SHAPES: dict[str, type[SunShape]] = {name: _shape_of(name) for name in DECLARABLE}
"""The shapes that ``twin.json`` may name, by the name that it has for them."""
