"""The contents of PAINT's documents: plant, heliostats, measurements, declared model.

Source: the PAINT database of the Solar Tower Juelich, https://paint-database.org.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.effects import Effect, effects_from_json
from model.errors import InvalidInputError
from model.frames import sun_direction
from model.imaging import Camera, ImageKind
from model.imaging.light import cameras_from_json
from model.mount import LinearActuator, Mount
from model.plant import Cylinder, Facet, Heliostat, Plant, TargetPlane
from model.pointing import Weather
from model.sunshape import SHAPES, SunShape
from model.tracing import Optics
from service.base.wording import not_json, place_of
from service.sources.files import require_regular
from service.sources.photograph import Photograph

Array = NDArray[np.float64]

# Coefficients that an attenuation may have: published ones have four.
_MAX_COEFFICIENTS = 8

IMAGE_KINDS: tuple[ImageKind, ...] = ("cropped", "raw", "flux", "flux-centered")
"""Kinds of image that a measurement may hold, the most worked-out one with a known place on the target first."""


SUFFIXES = {"image/png": "png", "image/jpeg": "jpg", "image/tiff": "tif", "image/bmp": "bmp"}
"""Of the files of images, by their media types; PAINT's are PNG."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """One calibration measurement.

    Attributes
    ----------
    identifier : str
    heliostat, target : str
    azimuth_deg, elevation_deg : float [deg]
        The sun, azimuth from south and positive to the east.
    spot : (3,) [m] or None
        Measured centre of mass in ENU: PAINT's UTIS, else HeliOS.
    helios_spot : (3,) [m] or None
        That of HeliOS.
    motor_position : (2,) [steps] or None
    images : dict
        Files by kind.
    taken_at : datetime or None
        With time zone; from PAINT's STAC item ``ID-calibration-item-stac.json`` where there is one.
    weather : Weather
        Of its properties, or of those of the STAC item.
    """

    identifier: str
    heliostat: str
    target: str
    azimuth_deg: float
    elevation_deg: float
    spot: Array | None = None
    helios_spot: Array | None = None
    motor_position: Array | None = None
    images: dict[ImageKind, Path] = field(default_factory=dict)
    taken_at: datetime | None = None
    weather: Weather = field(default_factory=Weather)

    @property
    def sun(self) -> Array:
        """Unit vector (3,) towards the sun."""
        return sun_direction(self.azimuth_deg, self.elevation_deg)

    @property
    def key(self) -> str:
        """``heliostat/identifier``."""
        return f"{self.heliostat}/{self.identifier}"

    def photograph(self, kind: ImageKind, plant: Plant) -> Photograph:
        """What it says of its image of one kind."""
        motors = None if self.motor_position is None else self.motor_position.tolist()
        return Photograph(
            target_name=self.target,
            kind=kind,
            sun_azimuth_deg=self.azimuth_deg,
            sun_elevation_deg=self.elevation_deg,
            external_id=self.identifier,
            taken_at=self.taken_at,
            motor_position=None if motors is None else (motors[0], motors[1]),
            focal_spot_wgs84=_wgs84(self.spot, plant),
            helios_spot_wgs84=_wgs84(self.helios_spot, plant),
            weather=self.weather,
        )


def _wgs84(place: Array | None, plant: Plant) -> tuple[float, float, float] | None:
    if place is None:
        return None
    latitude, longitude, altitude = plant.to_wgs84(place).tolist()
    return latitude, longitude, altitude


def get(data: Any, where: str, *keys: str | int) -> Any:
    """Walk into parsed JSON; a missing key is named with its file."""
    for key in keys:
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            raise InvalidInputError(f"{where}: '{key}' is missing") from None
    return data


def _is_number(value: Any) -> bool:
    """Neither text nor a truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(data: Any, where: str, *keys: str | int, count: int) -> Array:
    value = get(data, where, *keys)
    is_list = isinstance(value, list | tuple) and all(map(_is_number, value))
    numbers = np.array(value if is_list else [np.nan], dtype=np.float64)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise InvalidInputError(f"{where}: '{keys[-1]}' must be {count} finite numbers, got {str(value)[:80]}")
    return numbers


def _number(data: Any, where: str, *keys: str | int) -> float:
    value = get(data, where, *keys)
    if not _is_number(value) or not np.isfinite(value):
        raise InvalidInputError(f"{where}: '{keys[-1]}' must be a finite number, got {str(value)[:80]}")
    return float(value)


def read_json(path: Path) -> Any:
    """Parsed JSON of a file; one that is missing, no regular file, too large or not JSON is named."""
    try:
        return json.loads(require_regular(path).read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise InvalidInputError(f"{path}: {not_json(place_of(error))}") from None
    except UnicodeDecodeError:
        raise InvalidInputError(f"{path}: {not_json('a byte that is no UTF-8')}") from None


def _actuators(kinematics: Any, where: str) -> tuple[LinearActuator, LinearActuator] | None:
    entries = get(kinematics, where, "actuators")
    if not isinstance(entries, list) or len(entries) != 2:
        return None
    if any(get(entry, where, "type_axis") != "linear" for entry in entries):
        return None
    first, second = (
        LinearActuator(
            increment=_number(entry, where, "increment"),
            initial_stroke_length=_number(entry, where, "initial_stroke_length"),
            offset=_number(entry, where, "offset"),
            pivot_radius=_number(entry, where, "pivot_radius"),
            initial_angle=_number(entry, where, "initial_angle"),
            clockwise=bool(_number(entry, where, "clockwise_axis_movement")),
            max_increment=_number(entry, where, "max_increment"),
        )
        for entry in entries
    )
    return first, second


def _mount(kinematics: Any, where: str) -> Mount:
    joint = [
        sum(_number(kinematics, where, f"joint_translation_{axis}_{stage}") for stage in (1, 2))
        for axis in ("e", "n", "u")
    ]
    # Older files count the offset from an upright mirror, newer ones from a lying one; along the normal it is the same.
    along_normal = abs(_number(kinematics, where, "concentrator_translation_n"))
    return Mount.juelich(_actuators(kinematics, where), joint=joint, mirror_offset=(0.0, 0.0, along_normal))


def read_heliostat(name: str, properties: Any, origin: Array) -> Heliostat:
    """A heliostat of the contents of PAINT's ``heliostat-properties.json``.

    ``origin`` (3,) is the tower base in WGS84. Raises `InvalidInputError`, which names the field. Facets in another
    order are refused, not sorted: measured surfaces of the same heliostat are listed as its properties are.
    """
    where = f"properties of {name}"
    if not isinstance(properties, dict):
        raise InvalidInputError(f"{where}: must be a JSON object")
    kinematics = properties.get("kinematics_properties", properties.get("kinematic_properties"))
    if kinematics is None:
        raise InvalidInputError(f"{where}: 'kinematics_properties' is missing")
    facets = get(properties, where, "facet_properties", "facets")
    if not isinstance(facets, list):
        raise InvalidInputError(f"{where}: 'facets' must be a list")
    heliostat = Heliostat(
        name=name,
        position=Plant("", origin).to_enu(_numbers(properties, where, "heliostat_position", count=3)),
        mount=_mount(kinematics, where),
        facets=tuple(
            Facet(
                position=_numbers(facet, where, "translation_vector", count=3),
                canting_x=_numbers(facet, where, "canting_e", count=3),
                canting_y=_numbers(facet, where, "canting_n", count=3),
            )
            for facet in facets
        ),
        width=_number(properties, where, "width"),
        height=_number(properties, where, "height"),
    )
    if not heliostat.has_facets_in_order:
        raise InvalidInputError(
            f"{where}: 'facets' must be listed upper left, upper right, lower left, lower right, seen from the front"
        )
    return heliostat


def read_targets(tower: Any) -> tuple[Array, dict[str, TargetPlane]]:
    """Tower base (3,) in WGS84 and the planar targets of PAINT's ``tower-measurements.json``.

    Cylinders are no planes; `read_receivers` has them.
    """
    where = "tower measurements"
    origin = _numbers(tower, where, "power_plant_properties", "coordinates", count=3)
    plant = Plant("", origin)
    targets = {}
    for name, entry in tower.items():
        if isinstance(entry, dict) and entry.get("type") == "planar":
            corners = [
                plant.to_enu(_numbers(entry, f"{where}, {name}", "coordinates", corner, count=3))
                for corner in ("upper_left", "upper_right", "lower_left", "lower_right")
            ]
            targets[name] = TargetPlane.from_corners(name, *corners)
    if not targets:
        raise InvalidInputError(f"{where}: no target of type 'planar'")
    return origin, targets


def read_receivers(tower: Any) -> dict[str, Cylinder]:
    """The cylindrical receivers of PAINT's ``tower-measurements.json``, convex ones that are surveyed.

    Their inner corners are those of the lit surface: on its edge, a chord apart.
    """
    where = "tower measurements"
    plant = Plant("", _numbers(tower, where, "power_plant_properties", "coordinates", count=3))
    surveyed = {
        name: entry
        for name, entry in tower.items()
        if isinstance(entry, dict) and entry.get("type") == "convex_cylinder" and "coordinates" in entry
    }
    return {name: _receiver(name, entry, f"{where}, {name}", plant) for name, entry in surveyed.items()}


def _receiver(name: str, entry: Any, where: str, plant: Plant) -> Cylinder:
    lower_left, lower_right, upper_left, upper_right = (
        plant.to_enu(_numbers(entry, where, "coordinates", f"receiver_inner_{corner}", count=3))
        for corner in ("lower_left", "lower_right", "upper_left", "upper_right")
    )
    radius, opening = _number(entry, where, "radius"), _number(entry, where, "opening_angle")
    normal = _numbers(entry, where, "normal_vector", count=3)
    up = (upper_left + upper_right - lower_left - lower_right) / 2
    chord = (lower_left + lower_right + upper_left + upper_right) / 4
    bulge = radius * (1 - np.cos(np.radians(opening) / 2)) * normal / np.linalg.norm(normal)
    return Cylinder(name, chord + bulge, normal, up, radius, float(np.linalg.norm(up)), opening)


def _spots(data: Any, where: str, plant: Plant) -> tuple[Array | None, Array | None]:
    """Measured centres of mass in ENU by PAINT's two methods, UTIS and HeliOS."""
    spots = data.get("focal_spot")
    if not isinstance(spots, dict):
        return None, None
    utis, helios = (
        None if spots.get(method) is None else plant.to_enu(_numbers(spots, where, method, count=3))
        for method in ("UTIS", "HeliOS")
    )
    return utis, helios


def _motors(data: Any, where: str) -> Array | None:
    motors = data.get("motor_position")
    if motors is None:
        return None
    return np.array([_number(motors, where, f"axis_{axis}_motor_position") for axis in (1, 2)])


def read_measurement(identifier: str, heliostat: str, data: Any, plant: Plant) -> Measurement:
    """A measurement, without its images, of the contents of PAINT's ``calibration-properties.json``."""
    where = f"measurement {heliostat}/{identifier}"
    if not isinstance(data, dict):
        raise InvalidInputError(f"{where}: must be a JSON object")
    target = get(data, where, "target_name")
    if not isinstance(target, str) or target not in plant.targets:
        raise InvalidInputError(f"{where}: 'target_name' {str(target)[:80]!r} is none of {', '.join(plant.targets)}")
    elevation = _number(data, where, "sun_elevation")
    if not 0 < elevation <= 90:
        raise InvalidInputError(f"{where}: 'sun_elevation' must lie in (0, 90] degrees, got {elevation}")
    utis, helios = _spots(data, where, plant)
    return Measurement(
        identifier=identifier,
        heliostat=heliostat,
        target=target,
        azimuth_deg=_number(data, where, "sun_azimuth"),
        elevation_deg=elevation,
        spot=helios if utis is None else utis,
        helios_spot=helios,
        motor_position=_motors(data, where),
        weather=read_weather(data, where),
    )


_WEATHER = {"wind_speed_m_s": (0.0, 100.0), "wind_from_deg": (0.0, 360.0), "temperature_c": (-90.0, 60.0)}


def read_weather(data: Mapping[str, Any], where: str) -> Weather:
    """Wind and temperature among other properties; each may lack."""
    found = {name: _number(data, where, name) for name in _WEATHER if data.get(name) is not None}
    for name, value in found.items():
        least, most = _WEATHER[name]
        if not least <= value <= most:
            raise InvalidInputError(f"{where}: '{name}' must lie in {least:g} to {most:g}, got {value}")
    return Weather(**found)


def read_moment(item: Any, where: str) -> datetime | None:
    """When a measurement was taken, of the contents of PAINT's STAC item; in UTC where it names no time zone.

    None where the item gives but a period that it lies in.
    """
    moment = get(item, where, "properties", "datetime")
    if moment is None and "start_datetime" in item["properties"]:
        return None
    try:
        taken_at = datetime.fromisoformat(moment)
    except (TypeError, ValueError):
        raise InvalidInputError(f"{where}: 'datetime' must be an ISO 8601 time, got {str(moment)[:80]}") from None
    return taken_at if taken_at.tzinfo is not None else taken_at.replace(tzinfo=UTC)


def _sun_shape(declared: Any, where: str) -> SunShape:
    name = get(declared, where, "shape")
    if not isinstance(name, str) or name not in SHAPES:
        *names, last = SHAPES
        raise InvalidInputError(f"{where}: 'shape' must be {', '.join(names)} or {last}, got {name!r}")
    shape = SHAPES[name]
    return shape(*(_number(declared, where, key) * unit for key, unit in shape.units.items()))


def _optics(declared: Any, where: str) -> Optics:
    """Declared ``reflectivity`` (0 to 1) and ``attenuation`` (`Optics.attenuation`); each has the model's default."""
    if not isinstance(declared, dict):
        raise InvalidInputError(f"{where}: 'optics' must be a JSON object")
    unknown = sorted(set(declared) - {"reflectivity", "attenuation"})
    if unknown:
        raise InvalidInputError(f"{where}: 'optics' knows reflectivity and attenuation, not {unknown[0]!r}")
    plain = Optics()
    coefficients = declared.get("attenuation", [])
    if not isinstance(coefficients, list) or len(coefficients) > _MAX_COEFFICIENTS:
        raise InvalidInputError(f"{where}: 'attenuation' must be a list of up to {_MAX_COEFFICIENTS} numbers")
    return replace(
        plain,
        reflectivity=_share(declared, where, "reflectivity") if "reflectivity" in declared else plain.reflectivity,
        attenuation=tuple(_number(declared, where, "attenuation", place) for place in range(len(coefficients))),
    )


def _share(data: Any, where: str, key: str) -> float:
    value = _number(data, where, key)
    if not 0 <= value <= 1:
        raise InvalidInputError(f"{where}: '{key}' must lie in 0 to 1, got {value}")
    return value


def optics_to_json(optics: Optics) -> dict[str, Any]:
    """What besides the sun makes W/m2 of a forecast, in the form of ``twin.json``, defaults included."""
    return {"reflectivity": optics.reflectivity, "attenuation": list(optics.attenuation)}


class Declared(NamedTuple):
    """A declared model."""

    optics: Optics
    effects: tuple[Effect, ...]
    cameras: tuple[Camera, ...]


def parse_declared(declared: Any, where: str) -> Declared:
    """A declared model, which ``where`` holds; each part has the model's default."""
    if not isinstance(declared, dict):
        raise InvalidInputError(f"{where}: 'declared' must be a JSON object")
    sun = declared.get("sun")
    optics = _optics(declared.get("optics", {}), where)
    if sun is not None:
        optics = replace(optics, sun_shape=_sun_shape(sun, where))
    try:
        cameras = cameras_from_json(declared.get("cameras", []))
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None
    return Declared(optics, _effects(declared.get("effects", []), where), cameras)


def read_effects(path: Path) -> tuple[Effect, ...]:
    """Effects of a JSON file: a list, or an object with ``effects``, such as a study's report."""
    return _effects(read_json(path), str(path))


def _effects(data: Any, where: str) -> tuple[Effect, ...]:
    try:
        return tuple(effects_from_json(data))
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None
