"""Heliostat types, receivers and targets of ``plant.yaml``."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from model.actuator import Actuator, RotaryActuator
from model.errors import InvalidInputError
from model.frames import sun_direction
from model.heliostat_type import Canting, FacetDesign, Focus, HeliostatType, MountDesign, facet_grid
from model.plant import REFERENCE_SINE, Cylinder, MirrorOptics, TargetPlane
from service.base.fields import JsonObject
from service.base.plant import NAMES_WITH_UNITS, receiver_from_json, receiver_to_json
from service.base.plant import AnyReceiver as AnyReceiver
from service.sources.files import read_text
from service.sources.plant_errors import PlantText, mistakes_at
from service.sources.plant_schema import (
    UP,
    CantingEntry,
    CylinderReceiver,
    FacetFileEntry,
    FacetGridEntry,
    FocusEntry,
    HeliostatTypeEntry,
    IdealDrive,
    LinearDrive,
    MountEntry,
    ReceiverEntry,
    RotaryDrive,
)
from service.sources.plant_tables import MAX_CSV_BYTES, parse_facets, read_facets
from service.sources.text_lines import KeyPath


def read_type(plant: PlantText, name: str) -> HeliostatType:
    """The heliostat type of this name."""
    path: KeyPath = ("heliostat_types", name)

    def facets_of(file: str) -> Sequence[FacetDesign]:
        return read_facets(plant.file(file, *path, "facets", "file"))

    return _type(name, plant.entries.heliostat_types[name], partial(plant.place, *path), facets_of)


def type_of_entry(name: str, entry: HeliostatTypeEntry, files: Mapping[str, str]) -> HeliostatType:
    """The heliostat type of an entry; ``files`` are texts of facets files by name.

    Raises
    ------
    InvalidInputError
        It names the field of `service.sources.heliostat_document.HeliostatOfType`.
    """

    def facets_of(file: str) -> Sequence[FacetDesign]:
        if file not in files:
            known = f", which has {', '.join(files)}" if files else ""
            raise InvalidInputError(
                f"facets.file: {file[:60]!r} is no facets file of the imported plant{known}; give"
                " rows and columns, or import a plant.yaml that names the file"
            )
        return parse_facets(file, files[file])

    return _type(name, entry, lambda *path: ".".join(map(str, path)) or "type", facets_of)


def _type(
    name: str,
    entry: HeliostatTypeEntry,
    place: Callable[..., str],
    facets_of: Callable[[str], Sequence[FacetDesign]],
) -> HeliostatType:
    """The type of an entry, whose keys have a ``place`` in messages."""
    facets = _facets(entry.facets, facets_of)
    optics = MirrorOptics(
        entry.reflectance, entry.slope_error_mrad / 1e3, entry.pointing_error_mrad / 1e3
    )
    canting = _canting(entry.canting, facets, place("canting"))
    with mistakes_at(place()):
        return HeliostatType(
            name,
            facets,
            _mount(entry.mount),
            _focus(entry),
            canting,
            optics,
            _sine(entry.reference_elevation_deg),
        )


def _sine(elevation_deg: float) -> float:
    """Sine of an elevation [deg]; that of 30 degrees is exact."""
    return REFERENCE_SINE if elevation_deg == 30 else math.sin(math.radians(elevation_deg))


def types_to_json(path: Path) -> JsonObject:
    """Heliostat types of a plant's file: the entries as ``types``, and the text of the ``files``
    that they name.
    """
    text = PlantText.read(path)
    types, files = text.entries.heliostat_types, {}
    for name, entry in types.items():
        if isinstance(entry.facets, FacetFileEntry):
            file = text.file(entry.facets.file, "heliostat_types", name, "facets", "file")
            files[entry.facets.file] = read_text(file, MAX_CSV_BYTES)
    entries = {name: one.model_dump(mode="json", exclude_unset=True) for name, one in types.items()}
    return {"types": entries, "files": files}


def _facets(
    grid: FacetGridEntry | FacetFileEntry, facets_of: Callable[[str], Sequence[FacetDesign]]
) -> Sequence[FacetDesign]:
    if isinstance(grid, FacetFileEntry):
        return facets_of(grid.file)
    return facet_grid(grid.rows, grid.columns, grid.width_m, grid.height_m, grid.gap_m)


def _canting(
    chosen: str | CantingEntry | None, facets: Sequence[FacetDesign], place: str
) -> Canting:
    """The canting; that of the facets' file is individual."""
    has_normals = facets[0].normal is not None
    given = chosen or ("individual" if has_normals else "on_axis")
    if has_normals and given != "individual":
        raise InvalidInputError(
            f"{place}: the facets' file has their normals; write"
            " individual, or leave them out of it"
        )
    if given == "individual" and not has_normals:
        raise InvalidInputError(
            f"{place}: individual needs each facet's normal; write a"
            " facets file with normal_x, normal_y, normal_z, or another canting"
        )
    return _model_canting(given)


def _mount(entry: MountEntry) -> MountDesign:
    """The mount of an entry, with its drives if they are given."""
    drives = [_actuator(drive) for drive in entry.drives or ()]
    return MountDesign(
        entry.kind,
        entry.pivot_height_m,
        entry.mirror_offset_m,
        (drives[0], drives[1]) if len(drives) == 2 else None,
        jitter_axis=entry.jitter_axis,
    )


def _actuator(drive: LinearDrive | RotaryDrive | IdealDrive) -> Actuator:
    """The model's drive; the motor position of an ideal one is its angle in radians."""
    if isinstance(drive, IdealDrive):
        return RotaryActuator()
    if isinstance(drive, RotaryDrive):
        increment = drive.steps_per_rad or (drive.gear or 1.0) / (2 * math.pi)
        return RotaryActuator(increment, drive.initial_angle_rad, drive.clockwise)
    return drive.actuator()


def _focus(entry: HeliostatTypeEntry) -> Focus:
    shape = entry.facet_shape
    return shape.focal_length_m if isinstance(shape, FocusEntry) else shape


def _model_canting(given: str | CantingEntry) -> Canting:
    if not isinstance(given, CantingEntry):
        return Canting(given)  # type: ignore[arg-type]
    if given.off_axis is None:
        return Canting("on_axis", focal_length=given.focal_length_m)
    sun = given.off_axis
    return Canting("off_axis", sun_deg=(sun.azimuth_deg, sun.elevation_deg))


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
