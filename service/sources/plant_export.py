"""Write ``plant.yaml`` of a plant in the store; `service.sources.plant_file` reads it."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from model.errors import InvalidInputError
from model.locating import BracketMarks, locator_to_json
from model.plant import Plant, TargetPlane
from model.sunshape import Buie
from model.tracing import Optics
from service.base.fields import JsonObject
from service.base.plant import PlantFacts
from service.sources.documents import sun_to_json
from service.sources.plant_formats.imported import LAYOUT, PLANT, plant_text, site
from service.sources.plant_parts import receiver_entry

_LAYOUT = ("name", "type", "east_m", "north_m", "up_m", "receiver", "focal_length_m")


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


def _target(target: TargetPlane) -> dict[str, object]:
    """The entry of a target, with what locates it: marks, if it declares nothing."""
    plane = {key: value for key, value in receiver_entry(target).items() if key != "absorptance"}
    return plane | locator_to_json(target.locator or BracketMarks())
