"""From a photograph to a centered, normalised flux with a quality record.

The steps are: rectify the target, separate the flux, center it, crop it and normalise it.
"""

from model.imaging.light import Camera
from model.imaging.measure import ImageKind, MeasuredFlux, measure
from model.imaging.quality import Quality
from model.imaging.window import center_of_mass, flux_window

__all__ = [
    "Camera",
    "ImageKind",
    "MeasuredFlux",
    "Quality",
    "center_of_mass",
    "flux_window",
    "measure",
]
