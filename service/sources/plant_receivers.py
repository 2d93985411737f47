"""Receivers and targets of ``plant.yaml``."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from model.errors import InvalidInputError
from model.frames import sun_direction
from model.plant import Cylinder, TargetPlane
from model.receivers import Cavity, Panels
from service.base.receivers import AnyReceiver as AnyReceiver
from service.sources.plant_errors import PlantText, mistakes_at
from service.sources.plant_schema import (
    UP,
    CavityReceiver,
    CylinderReceiver,
    PanelEntry,
    PanelsReceiver,
    ReceiverEntry,
)
from service.sources.yaml_text import KeyPath

Array = NDArray[np.float64]


def read_receivers(plant: PlantText) -> dict[str, AnyReceiver]:
    """Receivers by name."""
    receivers = {}
    for name, entry in plant.entries.receivers.items():
        with mistakes_at(plant.place("receivers", name)):
            receivers[name] = _receiver(name, entry)
    return receivers


def read_targets(plant: PlantText) -> dict[str, TargetPlane]:
    """Targets by name, with how photographs show where they are."""
    targets = {}
    for name, entry in plant.entries.targets.items():
        place = plant.place("targets", name)
        if name in plant.entries.receivers:
            raise InvalidInputError(f"{place}: is a receiver's name too; rename one of them")
        with mistakes_at(place):
            target = _plane(name, entry)
        with _camera_mistakes_at(plant, name):
            targets[name] = target.located_by(entry.locator_document)
    return targets


@contextmanager
def _camera_mistakes_at(plant: PlantText, target: str) -> Iterator[None]:
    """Prefix a mistake of a target's camera with its line and key."""
    try:
        yield
    except InvalidInputError as error:
        key, _, said = str(error).partition(": ")
        camera: KeyPath = ("targets", target, "camera")
        known = [(*camera, "pose", key), (*camera, key), camera]
        path = next(path for path in known if path in plant.document.lines)
        message = said if key in (path[-1], "camera") else error
        raise InvalidInputError(f"{plant.place(*path)}: {message}") from None


def _plane(name: str, entry: PanelEntry, absorptance: float = 1.0) -> TargetPlane:
    return TargetPlane(
        name,
        np.array(entry.center_m),
        np.array(entry.normal),
        np.array(entry.up),
        entry.width_m,
        entry.height_m,
        absorptance,
    )


def _receiver(name: str, entry: ReceiverEntry) -> AnyReceiver:
    """The receiver of an entry."""
    if isinstance(entry, CylinderReceiver):
        facing = sun_direction(entry.facing_azimuth_deg, 0.0)
        return Cylinder(
            name,
            np.array(entry.center_m) + entry.radius_m * facing,
            facing,
            np.array(UP),
            entry.radius_m,
            entry.height_m,
            entry.opening_deg,
            entry.absorptance,
        )
    if isinstance(entry, PanelsReceiver | CavityReceiver):
        panels = tuple(
            _plane(f"{name}-{number}", panel, entry.absorptance)
            for number, panel in enumerate(entry.panels, start=1)
        )
        if isinstance(entry, PanelsReceiver):
            return Panels(name, panels, entry.absorptance)
        return Cavity(name, panels, entry.absorptance, aperture=np.array(entry.aperture_m))
    return _plane(name, entry, entry.absorptance)
