"""Write ``plant.yaml`` of a plant in the store; `service.sources.plant_file` reads it."""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from model.errors import InvalidInputError
from model.locating import BracketMarks, locator_to_json
from model.plant import Cylinder, Plant, TargetPlane
from model.receivers import Cavity, Panels
from model.sunshape import Buie
from model.tracing import Optics
from service.base.fields import JsonObject
from service.base.plant_facts import PlantFacts
from service.base.receivers import AnyReceiver
from service.sources.documents import sun_to_json
from service.sources.plant_formats.imported import LAYOUT, PLANT, plant_text, site

_LAYOUT = ("name", "type", "east_m", "north_m", "up_m", "receiver", "focal_length_m")

_LEVEL = 1e-9
"""Largest slope of the axis of a cylinder that counts as upright."""


@dataclass(frozen=True, eq=False)
class ExportedPlant:
    """A plant's files by name, and what they leave out with the reasons."""

    files: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


def export_plant(
    plant: Plant, facts: PlantFacts, optics: Optics, properties: Mapping[str, JsonObject]
) -> ExportedPlant:
    """The files of a plant that came from ``plant.yaml``; none of another one.

    ``properties`` are the stored documents of its heliostats by name.
    """
    made = ExportedPlant()
    if facts.heliostat_types is None:
        return made
    types = facts.heliostat_types["types"]
    rows = [
        _placed(name, document)
        for name, document in properties.items()
        if _is_placed(name, document, types, made)
    ]
    if optics.reflectivity != 1:
        made.skipped[f"{PLANT}: reflectivity {optics.reflectivity:g}"] = (
            "only heliostat types have one there; twin.json has it"
        )
    parts: dict[str, object] = {
        "plant": site(plant.name, plant.site.origin, facts.time_zone or "UTC"),
        "heliostat_types": types,
        "layout": {"file": LAYOUT},
        "receivers": _entries(plant.receivers, made),
        "targets": {name: _target(target) for name, target in plant.targets.items()},
        "sun": _sun(optics),
    }
    if facts.tower is not None:
        parts["tower"] = {"radius_m": facts.tower.radius, "height_m": facts.tower.height}
    if optics.attenuation:
        parts["atmosphere"] = {"attenuation": list(optics.attenuation)}
    made.files[PLANT] = plant_text(parts)
    made.files[LAYOUT] = _csv([_LAYOUT, *rows])
    made.files.update(facts.heliostat_types["files"])
    return made


def _is_placed(
    name: str, document: Mapping[str, Any], types: Mapping[str, Any], made: ExportedPlant
) -> bool:
    """Whether a heliostat has a type of the plant; otherwise it is left out."""
    if document.get("type") in types:
        return True
    made.skipped[f"{PLANT}: {name}"] = "its properties name no heliostat type of the plant"
    return False


def _placed(name: str, document: Mapping[str, Any]) -> list[object]:
    """The line of a heliostat in the layout."""
    known = [document.get(key) for key in ("receiver", "focal_length_m")]
    return [name, document["type"], *document["position_m"], *known]


def _csv(rows: list[Any]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue()


def _sun(optics: Optics) -> dict[str, object]:
    shape = optics.sun_shape
    if isinstance(shape, Buie):
        return {"shape": "buie", "chi": float(shape.circumsolar_ratio)}
    return sun_to_json(shape)


def _entries(receivers: Mapping[str, Any], made: ExportedPlant) -> dict[str, object]:
    entries: dict[str, object] = {}
    for name, receiver in receivers.items():
        try:
            entries[name] = receiver_entry(receiver)
        except InvalidInputError as error:
            made.skipped[f"{PLANT}: receiver {name}"] = str(error)
    return entries


def receiver_entry(receiver: AnyReceiver) -> dict[str, object]:
    """The entry of a receiver in ``plant.yaml``.

    Raises
    ------
    InvalidInputError
        If it is a cylinder that leans.
    """
    if isinstance(receiver, TargetPlane):
        return _plane(receiver)
    if isinstance(receiver, Cylinder):
        return _cylinder(receiver)
    panels = [
        {key: value for key, value in _plane(panel).items() if key not in ("kind", "absorptance")}
        for panel in receiver.panels
    ]
    shared = {"panels": panels, "absorptance": receiver.absorptance}
    if isinstance(receiver, Panels):
        return {"kind": "panels", **shared}
    assert isinstance(receiver, Cavity)
    return {"kind": "cavity", "aperture_m": receiver.aperture.tolist(), **shared}


def _target(target: TargetPlane) -> dict[str, object]:
    """The entry of a target, with what locates it: marks, if it declares nothing."""
    plane = {key: value for key, value in _plane(target).items() if key != "absorptance"}
    return plane | locator_to_json(target.locator or BracketMarks())


def _plane(plane: TargetPlane) -> dict[str, object]:
    return {
        "kind": "plane",
        "center_m": plane.center.tolist(),
        "normal": plane.normal.tolist(),
        "up": plane.up.tolist(),
        "width_m": plane.width,
        "height_m": plane.height,
        "absorptance": plane.absorptance,
    }


def _cylinder(cylinder: Cylinder) -> dict[str, object]:
    east, north, _ = cylinder.normal.tolist()
    if np.abs(cylinder.up - [0, 0, 1]).max() > _LEVEL:
        raise InvalidInputError("a cylinder of plant.yaml is upright, and this one leans")
    return {
        "kind": "cylinder",
        "center_m": cylinder.axis.tolist(),
        "radius_m": cylinder.radius,
        "height_m": cylinder.height,
        "facing_azimuth_deg": round(math.degrees(math.atan2(east, north)) % 360, 12),
        "opening_deg": cylinder.opening_deg,
        "absorptance": cylinder.absorptance,
    }
