"""Camera frame -> rectified target -> separated flux -> centred, cropped, normalised flux, with a quality record."""

from model.imaging.light import Camera
from model.imaging.measure import ImageKind, MeasuredFlux, measure
from model.imaging.quality import Quality
from model.imaging.window import center_of_mass, flux_window

__all__ = ["Camera", "ImageKind", "MeasuredFlux", "Quality", "center_of_mass", "flux_window", "measure"]
