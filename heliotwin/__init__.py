"""Mirror surfaces from target photographs, and flux forecasts on any plane, for researchers.

Lengths are in metres, irradiances in W/m2. Positions are east, north, up of the tower base. The sun
is a time with a zone, or its azimuth from north over east and its elevation in degrees.

Examples
--------
>>> import heliotwin
>>> plant = heliotwin.open_plant("out/demo/plant")
>>> surface = plant.predict("AB12", method="refined")
>>> flux = plant.forecast(surface, on="calibration_target", sun=(200.0, 45.0))
>>> flux.flux.shape
(256, 256)

A wrong argument raises `InvalidInputError`, a ``ValueError`` that names it and the remedy. All
errors of the library are `HeliotwinError`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from heliotwin.plant import PlantFolder, make_demo, open_plant, plane
    from heliotwin.results import Comparison, Flux, Photograph, StudyResult, Surface, to_frame
    from model.errors import InvalidInputError
    from model.errors import ModelError as HeliotwinError

__version__ = "1.0.0"

__all__ = [
    "Comparison",
    "Flux",
    "HeliotwinError",
    "InvalidInputError",
    "Photograph",
    "PlantFolder",
    "StudyResult",
    "Surface",
    "make_demo",
    "open_plant",
    "plane",
    "to_frame",
]

_PLACES = {
    "HeliotwinError": ("model.errors", "ModelError"),
    "InvalidInputError": ("model.errors", "InvalidInputError"),
    **{name: ("heliotwin.plant", name) for name in ("PlantFolder", "make_demo", "open_plant")},
    "plane": ("heliotwin.plant", "plane"),
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: PyTorch takes seconds to load."""
    if name not in __all__:
        raise AttributeError(f"module 'heliotwin' has no attribute {name!r}")
    module, attribute = _PLACES.get(name, ("heliotwin.results", name))
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    """The public names."""
    return list(__all__)
