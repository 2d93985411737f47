"""Loading a measurement folder into the store: ``heliotwin import DIR``. A second run changes nothing."""

from collections import Counter
from datetime import UTC, datetime
from typing import Any

import numpy as np

from model.errors import ImageRefusedError, InvalidInputError
from model.surface import control_points
from service import store
from service.base.faults import ConflictError, TooLargeError, UnsupportedImageError
from service.base.progress import Progress, quiet
from service.sources.documents import IMAGE_KINDS, Measurement, read_json
from service.sources.folder import MeasurementFolder, declared_json, measured_heights
from service.twin.ingest import Photograph, ingest
from service.twin.runtime import Runtime

UNREADABLE = (InvalidInputError, ImageRefusedError, ConflictError, TooLargeError, UnsupportedImageError)
"""What one image may be refused for without ending the import."""


def import_folder(runtime: Runtime, folder: MeasurementFolder, progress: Progress = quiet) -> dict[str, Any]:
    """Store the plant, its targets, and every heliostat with its images and measured surface.

    Returns how many of each were new, changed or there already; measurements without an image, and images that cannot
    be read, are listed with the reason.
    """
    counts: Counter[str] = Counter()
    skipped: dict[str, str] = {}
    with runtime.database.writing() as session:
        counts[f"plants {store.put_plant(session, folder.plant.name, folder.plant.origin)}"] += 1
        declared = declared_json(folder.root / "twin.json")
        if declared:
            counts[f"declared models {store.put_declared(session, declared)}"] += 1
        for plane in folder.plant.targets.values():
            counts[f"targets {store.put_target(session, plane)[1]}"] += 1
        for cylinder in folder.plant.receivers.values():
            counts[f"receivers {store.put_receiver(session, cylinder)[1]}"] += 1
    for name in folder.plant.heliostats:
        progress(name)
        counts[f"heliostats {_put_heliostat(runtime, folder, name)}"] += 1
        for outcome in _put_surface(runtime, folder, name):
            counts[outcome] += 1
        for measurement in folder.measurements(name, with_images=False):
            if not measurement.images:
                skipped[measurement.key] = "no image"
            for kind in sorted(measurement.images, key=IMAGE_KINDS.index):
                progress(f"{measurement.key} {kind}")
                try:
                    counts[_put_image(runtime, folder, measurement, kind)] += 1
                except UNREADABLE as error:
                    skipped[f"{measurement.key} {kind}"] = str(error)
    return {"counts": dict(sorted(counts.items())), "skipped": {**folder.skipped, **skipped}}


def _put_heliostat(runtime: Runtime, folder: MeasurementFolder, name: str) -> store.Change:
    path = next((folder.root / name / "Properties").glob("*heliostat-properties.json"))
    with runtime.database.writing() as session:
        position = folder.plant.heliostats[name].position
        return store.put_heliostat(session, name, read_json(path), position)[1]


def _put_surface(runtime: Runtime, folder: MeasurementFolder, name: str) -> list[str]:
    measured = folder.measured_surface(name)
    if measured is None:
        return []
    heliostat = folder.plant.heliostats[name]
    z = measured_heights(heliostat, measured)
    # A measured surface describes the mirror from before anything else is known of it.
    surface = store.NewSurface(
        "measured", z, np.zeros_like(z), control_points(heliostat, z), valid_from=datetime(1970, 1, 1, tzinfo=UTC)
    )
    with runtime.database.writing() as session:
        _, new = store.add_surface(session, store.get_heliostat(session, name), surface, once=True)
    return [f"surfaces {store.Change.NEW if new else store.Change.UNCHANGED}"]


def _put_image(runtime: Runtime, folder: MeasurementFolder, measurement: Measurement, kind: str) -> str:
    motors, spot = measurement.motor_position, measurement.spot
    photograph = Photograph(
        target_name=measurement.target,
        kind=kind,  # type: ignore[arg-type]
        sun_azimuth_deg=measurement.azimuth_deg,
        sun_elevation_deg=measurement.elevation_deg,
        external_id=measurement.identifier,
        taken_at=measurement.taken_at,
        motor_position=None if motors is None else (float(motors[0]), float(motors[1])),
        focal_spot_wgs84=None if spot is None else tuple(float(v) for v in folder.plant.to_wgs84(spot)),  # type: ignore[arg-type]
    )
    row, new = ingest(runtime, measurement.heliostat, photograph, measurement.images[kind].read_bytes())
    state = "new" if new else "unchanged"
    return f"images {state}" if row.accepted else f"images {state}, refused"
