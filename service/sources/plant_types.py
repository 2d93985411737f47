"""Heliostat types of ``plant.yaml``."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from model.actuator import Actuator, RotaryActuator
from model.errors import InvalidInputError
from model.heliostat_type import Canting, FacetDesign, Focus, HeliostatType, MountDesign, facet_grid
from model.plant import REFERENCE_SINE, MirrorOptics
from service.base.fields import JsonObject
from service.sources.files import read_text
from service.sources.plant_errors import PlantText, mistakes_at
from service.sources.plant_schema import (
    CantingEntry,
    FacetFileEntry,
    FacetGridEntry,
    FocusEntry,
    HeliostatTypeEntry,
    IdealDrive,
    LinearDrive,
    MountEntry,
    RotaryDrive,
)
from service.sources.plant_tables import MAX_CSV_BYTES, parse_facets, read_facets
from service.sources.yaml_text import KeyPath


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
        It names the field of `service.sources.heliostat_of_type.HeliostatOfType`.
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
