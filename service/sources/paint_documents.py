"""Write PAINT's documents, which `service.sources.documents` reads, and STAC items."""

from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Any

import numpy as np

from model.locating import locator_to_json
from model.plant import Cylinder, Plant, TargetPlane
from model.times import format_time
from service.base.plant import NO_FACTS, PlantFacts, receiver_to_json
from service.sources.photograph import IncomingPhotograph

STAC_VERSION = "1.1.0"
"""Version of https://github.com/radiantearth/stac-spec.

Its Item has a ``datetime`` or, if that is null, a period.
"""

CATALOGUE = "catalog.json"
Corners = dict[str, list[float]]
"""WGS84 corners of a target by name."""


def azimuth_from_north(paint_deg: float) -> float:
    """Convert PAINT's azimuth, from south and positive to the east, to one from north over east.

    Both directions round to 1e-12 degrees, so that a value that is written and read is the same.
    """
    return round(180 - paint_deg, 12) % 360


def azimuth_from_south(azimuth_deg: float) -> float:
    """Convert an azimuth from north over east to PAINT's; inverts `azimuth_from_north`."""
    return round(180 - azimuth_deg, 12)


When = datetime | tuple[datetime, datetime]
"""A time, or the first and the last possible time."""


def tower_json(
    plant: Plant, corners: Mapping[str, Corners | None], facts: PlantFacts = NO_FACTS
) -> dict[str, object]:
    """``tower-measurements.json`` of a plant.

    ``corners`` are the WGS84 corners of targets as they were received, or None. PAINT knows convex
    cylinders; ``receivers`` has all of them, and ``tower_size`` the tower.
    """
    receivers = {name: receiver_to_json(one) for name, one in plant.receivers.items()}
    tower = facts.columns()["tower"]
    return {
        "power_plant_properties": {"ID": plant.name, "coordinates": plant.origin.tolist()},
        **{
            name: _target_json(plane, plant, corners.get(name))
            for name, plane in plant.targets.items()
        },
        **{
            name: _receiver_json(receiver, plant)
            for name, receiver in plant.receivers.items()
            if isinstance(receiver, Cylinder)  # PAINT has no others
        },
        **({"receivers": receivers} if receivers else {}),
        **({"tower_size": tower} if tower else {}),
    }


def _target_json(plane: TargetPlane, plant: Plant, corners: Corners | None) -> dict[str, object]:
    right, up = plane.right * plane.width / 2, plane.up * plane.height / 2
    made = {
        "upper_left": up - right,
        "upper_right": up + right,
        "lower_left": -up - right,
        "lower_right": right - up,
    }
    places = corners or {
        name: plant.to_wgs84(plane.center + offset).tolist() for name, offset in made.items()
    }
    center = plant.to_wgs84(plane.center).tolist()
    document = {
        "type": "planar",
        "normal_vector": plane.normal.tolist(),
        "coordinates": {"center": center, **places},
    }
    # PAINT has no such key, and its readers ignore it.
    return document | ({} if plane.locator is None else {"locator": locator_to_json(plane.locator)})


def _receiver_json(cylinder: Cylinder, plant: Plant) -> dict[str, object]:
    half, places = np.radians(cylinder.opening_deg) / 2, {}
    for side, angle in (("left", -half), ("right", half)):
        normal = np.cos(angle) * cylinder.normal + np.sin(angle) * cylinder.right
        edge = cylinder.center + cylinder.radius * (normal - cylinder.normal)
        for level, sign in (("lower", -1), ("upper", 1)):
            corner = edge + sign * cylinder.up * cylinder.height / 2
            places[f"receiver_inner_{level}_{side}"] = plant.to_wgs84(corner).tolist()
    return {
        "type": "convex_cylinder",
        "normal_vector": cylinder.normal.tolist(),
        "radius": cylinder.radius,
        "opening_angle": cylinder.opening_deg,
        "coordinates": {"center": plant.to_wgs84(cylinder.center).tolist(), **places},
    }


def measurement_json(photograph: IncomingPhotograph) -> dict[str, object]:
    """``calibration-properties.json`` of a photograph."""
    document: dict[str, object] = {
        "target_name": photograph.target,
        "sun_azimuth": azimuth_from_south(photograph.sun.azimuth_deg),
        "sun_elevation": photograph.sun.elevation_deg,
    }
    if photograph.motor_position is not None:
        motors = zip((1, 2), photograph.motor_position, strict=True)
        document["motor_position"] = {
            f"axis_{axis}_motor_position": position for axis, position in motors
        }
    used, helios = photograph.focal_spot_wgs84, photograph.helios_spot_wgs84
    spots = {"UTIS": None if used == helios else used, "HeliOS": helios}
    if used is not None:
        document["focal_spot"] = {
            method: list(spot) for method, spot in spots.items() if spot is not None
        }
    weather = vars(photograph.weather)
    return document | {name: value for name, value in weather.items() if value is not None}


def stac_item(
    path: str,
    identifier: str,
    when: When,
    wgs84: Iterable[float],
    assets: Mapping[str, tuple[str, str]],
    **more: Any,
) -> dict[str, object]:
    """A STAC item at latitude [deg], longitude [deg], altitude [m], to be written to ``path``.

    ``when`` is its time, or the first and the last possible time. ``assets`` are names with files
    next to the item and their media types. ``more`` are its properties.
    """
    latitude, longitude, altitude = wgs84
    root = "../" * path.count("/") + CATALOGUE
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "id": identifier,
        "geometry": {"type": "Point", "coordinates": [longitude, latitude, altitude]},
        "bbox": [longitude, latitude, altitude, longitude, latitude, altitude],
        "properties": {**_when_json(when), **more},
        "links": [
            {"rel": rel, "href": root, "type": "application/json"} for rel in ("root", "parent")
        ],
        "assets": {
            name: {"href": f"./{file}", "type": kind} for name, (file, kind) in assets.items()
        },
    }


def _when_json(when: When) -> dict[str, str | None]:
    if isinstance(when, datetime):
        return {"datetime": format_time(when)}
    first, last = when
    return {
        "datetime": None,
        "start_datetime": format_time(first),
        "end_datetime": format_time(last),
    }


def stac_catalog(name: str, items: Iterable[str]) -> dict[str, object]:
    """A STAC catalogue of items, given by their paths below it."""
    links = [{"rel": "item", "href": f"./{path}", "type": "application/geo+json"} for path in items]
    return {
        "type": "Catalog",
        "stac_version": STAC_VERSION,
        "id": name,
        "description": (
            f"Heliostats of {name}: photographs, properties and surfaces, as heliotwin keeps them."
        ),
        "links": [{"rel": "root", "href": f"./{CATALOGUE}", "type": "application/json"}, *links],
    }
