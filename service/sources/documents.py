"""The contents of PAINT's documents: plant, heliostats, measurements, declared model.

Source: the PAINT database of the Solar Tower Juelich, https://paint-database.org.
"""

import json
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.actuator import LinearActuator
from model.effects import Effect, effects_from_json
from model.errors import InvalidInputError
from model.frames import sun_direction
from model.imaging import Camera, ImageKind
from model.imaging.light import cameras_from_json
from model.mount import Mount
from model.plant import Cylinder, Facet, Heliostat, Plant, TargetPlane, require_cylinder_shape
from model.sunshape import SHAPES, Buie, SunShape
from model.sunshape.buie import chi_of_csr, csr_of_chi
from model.tracing import Optics
from service.base.fields import JsonObject, Sun, unique_keys
from service.base.plant import AnyReceiver, PlantFacts
from service.base.validation import not_json, place_of, require_text
from service.sources.files import MAX_JSON_BYTES, MAX_JSON_VALUES, read_file
from service.sources.heliostat_document import heliostat_from_json, is_heliostat_document
from service.sources.paint_documents import azimuth_from_north
from service.sources.photograph import IncomingPhotograph
from service.sources.schema import (
    CalibrationProperties,
    CylindricalReceiver,
    DeclaredOptics,
    FocalSpots,
    HeliostatProperties,
    ItemProperties,
    KinematicsProperties,
    LinearAxis,
    PlanarTarget,
    ReceiversPart,
    TowerBase,
    parse,
)

Array = NDArray[np.float64]

# Larger than any number of PAINT.
_MAX_NUMBER = 1e15

IMAGE_KINDS: tuple[ImageKind, ...] = ("cropped", "raw", "flux", "flux-centered")
"""Kinds of image of a measurement, in order of preference.

The most processed one with a known position on the target comes first.
"""


SUFFIXES = {"image/png": "png", "image/jpeg": "jpg", "image/tiff": "tif", "image/bmp": "bmp"}
"""File suffixes of images by media type; PAINT's are PNG."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurement(IncomingPhotograph):
    """One calibration measurement of a folder.

    Attributes
    ----------
    heliostat : str
    external_id : str
        Its name in the folder.
    spot : (3,) [m] or None
        Measured centroid in ENU: PAINT's UTIS, otherwise HeliOS.
    images : dict
        Files by kind.
    """

    heliostat: str
    external_id: str
    kind: ImageKind | None = None
    spot: Array | None = None
    images: dict[ImageKind, Path] = field(default_factory=dict)

    @property
    def to_sun(self) -> Array:
        """Unit vector (3,) towards the sun."""
        return sun_direction(self.sun.azimuth_deg, self.sun.elevation_deg)

    @property
    def key(self) -> str:
        """``heliostat/external_id``."""
        return f"{self.heliostat}/{self.external_id}"

    def photograph(self, kind: ImageKind | None) -> IncomingPhotograph:
        """Metadata of the image of one kind; for None, motors and spot without an image."""
        return replace(self, kind=kind)


def get(data: Any, where: str, *keys: str | int) -> Any:
    """Get a nested value of parsed JSON; the error names a missing key."""
    for key in keys:
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            raise InvalidInputError(f"{where}: '{key}' is missing") from None
    return data


def _number(data: Any, where: str, *keys: str | int) -> float:
    value = get(data, where, *keys)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not abs(value) < _MAX_NUMBER:
        raise InvalidInputError(
            f"{where}: '{keys[-1]}' must be a finite number, got {str(value)[:80]}"
        )
    return float(value)


def read_json(path: Path) -> Any:
    """Parse a JSON file.

    Raises
    ------
    InvalidInputError
        If the file is missing, no regular file, too large, not JSON, or holds strings that are no
        text. It names the file.
    """
    data = read_file(path, MAX_JSON_BYTES)
    n_values = sum(map(data.count, (b",", b":", b"[", b"{")))  # an upper bound: strings count too
    if n_values > MAX_JSON_VALUES:
        raise InvalidInputError(
            f"{path}: holds up to {n_values} values; at most {MAX_JSON_VALUES} are read"
        )
    try:
        document = json.loads(data.decode("utf-8-sig"), object_pairs_hook=unique_keys)
    except json.JSONDecodeError as error:
        raise InvalidInputError(f"{path}: {not_json(place_of(error))}") from None
    except UnicodeDecodeError:
        raise InvalidInputError(f"{path}: {not_json('a byte that is no UTF-8')}") from None
    except (
        RecursionError,
        ValueError,
    ) as error:  # nested too deeply, or a number with thousands of digits
        raise InvalidInputError(f"{path}: cannot be read ({error})") from None
    require_text(document, f"{path}: document")
    return document


def _actuators(entries: Any, where: str) -> tuple[LinearActuator, LinearActuator] | None:
    """Both linear actuators; None for other kinds of drives."""
    if len(entries) != 2 or any(get(entry, where, "type_axis") != "linear" for entry in entries):
        return None
    axes = (parse(LinearAxis, entry, f"{where}, actuators") for entry in entries)
    first, second = (axis.actuator() for axis in axes)
    return first, second


def _mount(document: KinematicsProperties, where: str) -> Mount:
    joint = [
        document.joint_translation_e_1 + document.joint_translation_e_2,
        document.joint_translation_n_1 + document.joint_translation_n_2,
        document.joint_translation_u_1 + document.joint_translation_u_2,
    ]
    # Older files count the offset from an upright mirror, newer ones from a horizontal mirror.
    # Along the normal it is the same.
    along_normal = abs(document.concentrator_translation_n)
    return Mount.juelich(
        _actuators(document.actuators, where), joint=joint, mirror_offset=(0.0, 0.0, along_normal)
    )


def read_heliostat(
    name: str, properties: Any, origin: Array, context: object | None = None
) -> Heliostat:
    """Parse a heliostat from the contents of PAINT's ``heliostat-properties.json``, or of a
    `service.sources.heliostat_document`.

    ``origin`` (3,) is the tower base in WGS84. ``context`` is `STORED` for stored properties.
    Raises `InvalidInputError`, which names the field.
    Facets in another order are rejected, not sorted, because measured surfaces of the heliostat
    have the order of its properties.
    """
    where = f"properties of {name}"
    if is_heliostat_document(properties):
        return heliostat_from_json(name, properties)
    document = parse(HeliostatProperties, properties, where, context)
    heliostat = Heliostat(
        name=name,
        position=Plant("", origin).to_enu(np.array(document.heliostat_position)),
        mount=_mount(document.kinematics_properties, where),
        facets=tuple(
            Facet(
                position=np.array(facet.translation_vector),
                canting_x=np.array(facet.canting_e),
                canting_y=np.array(facet.canting_n),
            )
            for facet in document.facet_properties.facets
        ),
        width=document.width,
        height=document.height,
    )
    if not heliostat.has_facets_in_order:
        raise InvalidInputError(
            f"{where}: 'facets' must be listed upper left, upper right, lower left, lower right,"
            " seen from the front"
        )
    return heliostat


def read_targets(tower: Any) -> dict[str, TargetPlane]:
    """Planar targets of PAINT's ``tower-measurements.json``.

    `read_receivers` reads the receivers.
    """
    where = "tower measurements"
    plant = Plant("", read_tower_base(tower))
    targets = {}
    for name, entry in _typed(tower).items():
        if entry["type"] == "planar":
            document = parse(PlanarTarget, entry, f"{where}, {name}")
            places = document.coordinates
            corners = [
                plant.to_enu(np.array(get(places, f"{where}, {name}", corner)))
                for corner in ("upper_left", "upper_right", "lower_left", "lower_right")
            ]
            targets[name] = TargetPlane.from_corners(name, *corners)
            if document.locator is not None:
                located = document.locator.locator_document
                try:
                    targets[name] = targets[name].located_by(located)
                except InvalidInputError as error:
                    raise InvalidInputError(f"{where}, {name}, locator: {error}") from None
    if not targets:
        raise InvalidInputError(f"{where}: no target of type 'planar'")
    return targets


def read_tower_base(tower: Any) -> Array:
    """The tower base (3,) in WGS84."""
    where = "tower measurements"
    properties = get(tower, where, "power_plant_properties")
    return np.array(parse(TowerBase, properties, f"{where}, power_plant_properties").coordinates)


def read_receivers(tower: Any) -> dict[str, AnyReceiver]:
    """The receivers of ``tower-measurements.json``, by name.

    PAINT describes convex cylinders; those with coordinates are read. Their inner corners are on
    the edges of the irradiated surface, one chord apart. Receivers of every kind, in REST's form,
    are in the object ``receivers``, which exports have; they take the place of PAINT's.
    """
    where = "tower measurements"
    plant = Plant("", read_tower_base(tower))
    surveyed = {
        name: entry
        for name, entry in _typed(tower).items()
        if entry["type"] == "convex_cylinder" and "coordinates" in entry
    }
    others = parse(ReceiversPart, tower, where).receivers
    return {
        **{
            name: _receiver(name, entry, f"{where}, {name}", plant)
            for name, entry in surveyed.items()
            if name not in others
        },
        **{name: receiver.named(name) for name, receiver in others.items()},
    }


def read_facts(tower: Any) -> PlantFacts:
    """What ``tower-measurements.json`` has of a plant in addition to PAINT."""
    size = parse(ReceiversPart, tower, "tower measurements").tower_size
    return PlantFacts(None if size is None else size.tower())


def unknown_parts(tower: Any) -> dict[str, str]:
    """Parts of ``tower-measurements.json`` of a type that is not understood, with the remedy."""
    return {
        name: (
            f"type: {str(entry['type'])[:60]!r} is not understood; known are planar and"
            " convex_cylinder. Give receivers of other kinds in `receivers`, or in plant.yaml"
        )
        for name, entry in _typed(tower).items()
        if entry["type"] not in ("planar", "convex_cylinder")
    }


def _typed(tower: Any) -> dict[str, JsonObject]:
    """The parts that have a type."""
    return {
        name: entry
        for name, entry in tower.items()
        if isinstance(entry, dict) and "type" in entry and name not in _PARTS
    }


_PARTS = ("power_plant_properties", "declared", *ReceiversPart.model_fields)
"""Parts that are neither targets nor receivers of PAINT."""


def _receiver(name: str, entry: Any, where: str, plant: Plant) -> Cylinder:
    document = parse(CylindricalReceiver, entry, where)
    radius, opening = document.radius, document.opening_angle
    lower_left, lower_right, upper_left, upper_right = (
        plant.to_enu(np.array(get(document.coordinates, where, f"receiver_inner_{corner}")))
        for corner in ("lower_left", "lower_right", "upper_left", "upper_right")
    )
    normal = np.array(document.normal_vector)
    up = (upper_left + upper_right - lower_left - lower_right) / 2
    chord = (lower_left + lower_right + upper_left + upper_right) / 4
    bulge = radius * (1 - np.cos(np.radians(opening) / 2)) * normal / np.linalg.norm(normal)
    cylinder = Cylinder(name, chord + bulge, normal, up, radius, float(np.linalg.norm(up)), opening)
    try:
        require_cylinder_shape(cylinder.radius, cylinder.height, cylinder.opening_deg)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None
    return cylinder


def read_measurement(identifier: str, heliostat: str, data: Any, plant: Plant) -> Measurement:
    """Parse a measurement, without images, from PAINT's ``calibration-properties.json``."""
    where = f"measurement {heliostat}/{identifier}"
    document = parse(CalibrationProperties, data, where)
    if document.target_name not in plant.targets:
        raise InvalidInputError(
            f"{where}: target_name: {document.target_name[:80]!r} is none of"
            f" {', '.join(plant.targets)}"
        )
    spots, motors = document.focal_spot or FocalSpots(), document.motor_position
    spot = spots.HeliOS if spots.UTIS is None else spots.UTIS
    return Measurement(
        document.target_name,
        sun=Sun(
            azimuth_deg=azimuth_from_north(document.sun_azimuth),
            elevation_deg=document.sun_elevation,
        ),
        external_id=identifier,
        heliostat=heliostat,
        spot=None if spot is None else plant.to_enu(np.array(spot)),
        focal_spot_wgs84=spot,
        helios_spot_wgs84=spots.HeliOS,
        motor_position=None
        if motors is None
        else (motors.axis_1_motor_position, motors.axis_2_motor_position),
        weather=document.weather,
    )


def read_item(item: Any, where: str) -> ItemProperties:
    """Time and weather of a measurement from PAINT's STAC item.

    The time is in UTC if the item names no time zone. It is None if the item has only a period.
    """
    properties = parse(ItemProperties, get(item, where, "properties"), where)
    if properties.taken_at is None and properties.start_datetime is None:
        raise InvalidInputError(f"{where}: datetime: must be an ISO 8601 time, got null")
    return properties


def _sun_shape(declared: Any, where: str) -> SunShape:
    name = get(declared, where, "shape")
    if not isinstance(name, str) or name not in SHAPES:
        *names, last = SHAPES
        raise InvalidInputError(
            f"{where}: 'shape' must be {', '.join(names)} or {last}, got {name!r}"
        )
    shape = SHAPES[name]
    if shape is Buie and isinstance(declared, dict):
        given = sorted({"chi", "csr", "circumsolar_ratio"} & set(declared))
        if len(given) > 1:
            raise InvalidInputError(f"{where}: {' and '.join(given)} are the same; give one")
        if given == ["csr"]:
            return Buie(chi_of_csr(_number(declared, where, "csr")))
        if given == ["chi"]:
            return Buie(_number(declared, where, "chi"))
    return shape(*(_number(declared, where, key) * unit for key, unit in shape.units.items()))


def _optics(declared: Any, where: str) -> Optics:
    """Declared ``reflectivity`` (0 to 1) and ``attenuation`` (`Optics.attenuation`)."""
    document = parse(DeclaredOptics, declared, f"{where}: optics")
    attenuation = tuple(document.attenuation)
    return Optics(reflectivity=document.reflectivity, attenuation=attenuation)


def sun_to_json(sun: SunShape) -> dict[str, object]:
    """A declarable sun shape in the form of ``twin.json``."""
    name = next(name for name, shape in SHAPES.items() if isinstance(sun, shape))
    values = (getattr(sun, field.name) for field in fields(sun))  # type: ignore[arg-type]
    given = zip(sun.units.items(), values, strict=True)
    return {"shape": name, **{key: float(value) / unit for (key, unit), value in given}}


def describe_sun(sun: SunShape) -> dict[str, object]:
    """A sun shape by the names of plant.yaml; Buie's by the chi of the formula and by ``csr``, the
    true circumsolar share.
    """
    known = sun_to_json(sun)
    if not isinstance(sun, Buie):
        return known
    chi = float(sun.circumsolar_ratio)
    return {"shape": "buie", "chi": round(chi, 6), "csr": round(csr_of_chi(chi), 6)}


def optics_to_json(optics: Optics) -> dict[str, object]:
    """Reflectivity and attenuation in the form of ``twin.json``, with defaults."""
    return {"reflectivity": optics.reflectivity, "attenuation": list(optics.attenuation)}


class Declared(NamedTuple):
    """A declared model."""

    optics: Optics
    effects: tuple[Effect, ...]
    cameras: tuple[Camera, ...]


def parse_declared(declared: Any, where: str) -> Declared:
    """Parse a declared model; missing parts have the model's default, ``where``
    names it in errors.
    """
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
    """Read effects from a JSON file: a list, or an object with ``effects``, such as a study's
    report.
    """
    return _effects(read_json(path), str(path))


def _effects(data: Any, where: str) -> tuple[Effect, ...]:
    try:
        return tuple(effects_from_json(data))
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None
