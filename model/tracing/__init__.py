"""Ray tracing of heliostat flux: scenes, a convolution tracer and a Monte Carlo reference."""

from model.tracing.convolution import TracedFlux, trace
from model.tracing.scene import Optics, Scene, Window

__all__ = ["Optics", "Scene", "TracedFlux", "Window", "trace"]
