"""Export the store as a measurement folder in PAINT's layout: ``heliotwin export DIR``.

The module `importing` reads this layout.
"""

import io
import json
from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel
from sqlalchemy import select

from model.errors import InvalidInputError
from model.plant import Plant
from model.surface import DEGREE
from service import store
from service.base.arrays import unpack
from service.base.errors import StoreDamagedError
from service.base.fields import JsonObject
from service.base.plant import PlantFacts
from service.base.progress import Progress, no_progress
from service.sources.documents import SUFFIXES, parse_declared
from service.sources.paint_documents import (
    CATALOGUE,
    When,
    measurement_json,
    stac_catalog,
    stac_item,
    tower_json,
)
from service.sources.photograph import IncomingPhotograph
from service.sources.plant_export import export_plant
from service.store.columns import EPOCH
from service.store.measurements import EXCLUDED
from service.store.model_versions import declared_of, find_current
from service.store.tables import HeliostatRow, MeasurementRow, SurfaceRow
from service.twin import history
from service.twin.photographs.metadata import photograph_from_row
from service.twin.runtime import Runtime
from service.twin.surfaces.accuracy import photograph_name


class _Writer:
    """Write and count files under a folder.

    ``skipped`` are the files that were left out, with the reasons.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.counts, self.skipped, self.items = Counter[str](), dict[str, str](), list[str]()

    def bytes(self, path: str, content: bytes, what: str) -> None:
        place = self.root / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
        self.counts[what] += 1

    def json(self, path: str, document: Any, what: str) -> None:
        self.bytes(path, json.dumps(document, indent=1).encode(), what)

    def model(self, path: str, document: BaseModel, what: str) -> None:
        self.bytes(path, document.model_dump_json(indent=1).encode(), what)

    def item(self, path: str, identifier: str, when: When, *about: Any, **more: Any) -> None:
        self.json(path, stac_item(path, identifier, when, *about, **more), "STAC items")
        self.items.append(path)


def export_folder(
    runtime: Runtime, root: Path, progress: Progress = no_progress
) -> dict[str, object]:
    """Write all data that cannot be computed again to a new folder.

    Return the numbers of files, and what was left out. PAINT's layout holds plant, heliostats,
    original photographs and the measured surface. `service.twin.history` holds the rest. A
    predicted active surface is in the folder ``surfaces``, because in PAINT's place it would be
    taken for a measured one.

    Raises
    ------
    InvalidInputError
        If the folder is not empty.
    """
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise InvalidInputError(f"{root}: is there already, and not empty; name a new folder")
    writer = _Writer(root)
    plant, names = _write_plant(runtime, writer)
    for name in names:
        progress(name)
        _write_heliostat(runtime, writer, plant, name)
    writer.json(CATALOGUE, stac_catalog(plant.name, writer.items), "catalogues")
    return {"counts": dict(sorted(writer.counts.items())), "skipped": writer.skipped}


def _write_plant(runtime: Runtime, writer: _Writer) -> tuple[Plant, Sequence[str]]:
    with runtime.database.reading() as session:
        row, targets, receivers = (
            store.get_plant(session),
            store.list_targets(session),
            store.list_receivers(session),
        )
        version = find_current(session)
        declared = declared_of(session, version) or {}
        heliostats = select(HeliostatRow.name, HeliostatRow.properties).order_by(HeliostatRow.name)
        properties: dict[str, JsonObject] = dict(session.execute(heliostats).all())
        document = history.plant_history(session)
        facts = PlantFacts(store.stored_tower(session), row.time_zone, row.heliostat_types)
    if version is not None and version.effects:  # adopted effects are part of the model, too
        declared = declared | {"effects": [*declared.get("effects", []), *version.effects]}
    planes = {target.name: store.target_plane(target) for target in targets}
    surfaces = {receiver.name: store.stored_receiver(receiver) for receiver in receivers}
    plant = Plant(row.name, np.array(row.origin), planes, {}, surfaces)
    tower = tower_json(plant, {target.name: target.corners for target in targets}, facts)
    writer.json(f"{row.name}-tower-measurements.json", tower, "plants")
    writer.model(history.PLANT, document, "histories")
    if declared:
        writer.json("twin.json", {"declared": declared}, "declared models")
    exported = export_plant(plant, facts, parse_declared(declared, "declared").optics, properties)
    for path, text in exported.files.items():
        writer.bytes(path, text.encode(), "files of plant.yaml")
    writer.skipped.update(exported.skipped)
    return plant, list(properties)


def _write_heliostat(runtime: Runtime, writer: _Writer, plant: Plant, name: str) -> None:
    with runtime.database.reading() as session:
        row = store.get_heliostat(session, name)
        rows = store.list_measurements(session, row, None)
        measured, today = (
            store.find_measured_surface(session, row),
            store.find_surface_at(session, row),
        )
    place, file = (
        plant.to_wgs84([row.east_m, row.north_m, row.up_m]).tolist(),
        f"{name}-heliostat-properties",
    )
    writer.json(f"{name}/Properties/{file}.json", row.properties, "heliostats")
    assets = {"properties": (f"{file}.json", "application/json")}
    about = {"heliotwin:heliostat": name}
    writer.item(
        f"{name}/Properties/{file}-item-stac.json", file, row.updated_at, place, assets, **about
    )
    if measured is not None:
        _write_surface(writer, f"{name}/Deflectometry", row, measured, place)
    if today is not None and today.source != "measured":
        _write_surface(writer, f"surfaces/{name}/Deflectometry", row, today, place)
    files: dict[str, str] = {}
    for identifier, images in _photographs(rows).items():
        files |= _write_photograph(runtime, writer, name, identifier, images, place)
    for one in (one for one in rows if one.reason == EXCLUDED and one.image is not None):
        files |= _write_image(runtime, writer, name, f"{one.identifier}-{one.kind}", one)
    _write_history(runtime, writer, name, files)


def _write_history(runtime: Runtime, writer: _Writer, name: str, files: dict[str, str]) -> None:
    folder = history.heliostat_folder(name)
    with runtime.database.reading() as session:
        row = store.get_heliostat(session, name)
        writer.model(
            f"{folder}/{history.HISTORY}",
            history.heliostat_history(session, row, files),
            "histories",
        )
        for surface in store.list_surfaces(session, row, None, arrays=True):
            writer.bytes(
                f"{folder}/{history.surface_file(surface.version)}",
                surface.arrays,
                "versions of surfaces",
            )


def _write_surface(
    writer: _Writer, folder: str, row: HeliostatRow, surface: SurfaceRow, place: list[float]
) -> None:
    file, buffer = f"{row.name}-nurbs-surface.npz", io.BytesIO()
    np.savez_compressed(buffer, degrees=np.array([DEGREE, DEGREE]), **unpack(surface.arrays))  # type: ignore[arg-type]
    writer.bytes(f"{folder}/{file}", buffer.getvalue(), "surfaces")
    about = {
        "heliotwin:heliostat": row.name,
        "heliotwin:source": surface.source,
        "heliotwin:version": surface.version,
    }
    identifier, assets = (
        f"{row.name}-surface-{surface.version}",
        {"surface": (file, "application/x-npz")},
    )
    path = f"{folder}/{row.name}-surface-item-stac.json"
    when = surface.valid_from or (EPOCH, surface.created_at)
    writer.item(path, identifier, when, place, assets, **about)


def _photographs(
    rows: Sequence[MeasurementRow],
) -> dict[str, list[tuple[MeasurementRow, IncomingPhotograph]]]:
    """Images by the photograph's name that they are written under.

    An image with metadata other than the first one's has its identifier instead.
    """
    found: dict[str, list[tuple[MeasurementRow, IncomingPhotograph]]] = {}
    for row in rows:
        if row.reason != EXCLUDED:
            photograph, name = photograph_from_row(row), photograph_name(row)
            fits = name not in found or _known(found[name][0][1]) == _known(photograph)
            found.setdefault(name if fits else row.identifier, []).append((row, photograph))
    return found


def _known(photograph: IncomingPhotograph) -> tuple[Any, datetime | None]:
    return measurement_json(photograph), photograph.taken_at


def _write_photograph(
    runtime: Runtime,
    writer: _Writer,
    heliostat: str,
    identifier: str,
    images: list[tuple[MeasurementRow, IncomingPhotograph]],
    place: list[float],
) -> dict[str, str]:
    """Write a photograph with its item; return image files by measurement identifier."""
    path = f"{heliostat}/Calibration/{identifier}"
    document, taken_at = _known(images[0][1])
    writer.json(f"{path}-calibration-properties.json", document, "measurements")
    assets = {
        "calibration-properties": (f"{identifier}-calibration-properties.json", "application/json")
    }
    files: dict[str, str] = {}
    for row, _ in images:
        written = _write_image(runtime, writer, heliostat, f"{identifier}-{row.kind}", row)
        for file in written.values():
            assert row.image is not None, "it was written"
            assets[row.kind] = file, row.image.media_type
        files |= written
    # A photograph of unknown time was certainly taken before it came.
    when = taken_at or (EPOCH, min(row.created_at for row, _ in images))
    row = images[0][0]
    about = {
        "heliotwin:heliostat": heliostat,
        "heliotwin:target": row.target.name,
        "heliotwin:sun_azimuth_deg": row.sun_azimuth_deg,
        "heliotwin:sun_elevation_deg": row.sun_elevation_deg,
    }
    item = f"{path}-calibration-item-stac.json"
    writer.item(item, f"{heliostat}-{identifier}", when, place, assets, **about)
    return files


def _write_image(
    runtime: Runtime, writer: _Writer, heliostat: str, name: str, row: MeasurementRow
) -> dict[str, str]:
    """Write an original image; return its file by measurement identifier.

    The result is empty if the store has no image, or the image is deleted or damaged.
    """
    if row.image is None:
        return {}
    folder = history.image_folder(heliostat, row.reason == EXCLUDED)
    file = f"{name}.{SUFFIXES[row.image.media_type]}"
    if row.image.pruned_at is not None:
        writer.skipped[f"{folder}/{name}"] = f"image kept until {row.image.pruned_at:%Y-%m-%d}"
        return {}
    try:
        writer.bytes(f"{folder}/{file}", runtime.images.read(row.image.sha256), "images")
    except StoreDamagedError as error:
        writer.skipped[f"{folder}/{name}"] = str(error)
        return {}
    return {row.identifier: file}
