"""Receivers and targets of ``plant.yaml``."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from model.errors import InvalidInputError
from model.frames import sun_direction
from model.plant import Cylinder, TargetPlane
from service.base.fields import JsonObject
from service.base.plant import NAMES_WITH_UNITS, receiver_from_json, receiver_to_json
from service.base.plant import AnyReceiver as AnyReceiver
from service.sources.plant_errors import PlantText, mistakes_at
from service.sources.plant_schema import UP, CylinderReceiver, ReceiverEntry
from service.sources.yaml_text import KeyPath

_LEVEL = 1e-9
"""Largest slope of the axis of a cylinder that counts as upright."""


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
            target = entry.named(name)
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


def _receiver(name: str, entry: ReceiverEntry) -> AnyReceiver:
    """The receiver of an entry."""
    document = entry.model_dump(by_alias=False)
    if isinstance(entry, CylinderReceiver):
        facing = sun_direction(document.pop("facing_azimuth_deg"), 0.0)
        center = np.array(entry.center) + entry.radius * facing
        document |= {"center": center, "normal": facing, "up": UP}
    return receiver_from_json(name, document)


def receiver_entry(receiver: AnyReceiver) -> JsonObject:
    """The entry of a receiver in ``plant.yaml``.

    Raises
    ------
    InvalidInputError
        If it is a cylinder that leans.
    """
    document = receiver_to_json(receiver)
    if isinstance(receiver, Cylinder):
        if np.abs(receiver.up - UP).max() > _LEVEL:
            raise InvalidInputError("a cylinder of plant.yaml is upright, and this one leans")
        east, north, _ = document.pop("normal")
        del document["up"]
        document["center"] = receiver.axis.tolist()
        document["facing_azimuth_deg"] = round(math.degrees(math.atan2(east, north)) % 360, 12)
    return _entry(document)


def _entry(document: JsonObject) -> JsonObject:
    """A receiver or panel with the keys of ``plant.yaml``."""
    return {
        NAMES_WITH_UNITS.get(name, name): [*map(_entry, value)] if name == "panels" else value
        for name, value in document.items()
    }
