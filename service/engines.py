"""Engines that work at the tiles of a fleet forecast."""

from functools import partial

from model.fleet import Engine, Threads
from service.runtime import Runtime


def engine_of(runtime: Runtime) -> Engine:
    """The engine that the settings name."""
    return Threads(runtime.settings.parallel_computations, partial(runtime.computing, "superpose"))
