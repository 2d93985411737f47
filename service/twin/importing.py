"""Loading a measurement folder into the store: ``heliotwin import DIR``. A second run changes nothing."""

from collections import Counter
from typing import Any

import numpy as np

from model.errors import ImageRefusedError, InvalidInputError
from model.imaging import ImageKind
from model.plant import Heliostat
from model.surface import control_points
from service import store
from service.base.faults import ConflictError, TooLargeError, UnsupportedImageError
from service.base.progress import Progress, quiet
from service.sources.documents import IMAGE_KINDS, Measurement
from service.sources.files import require_regular
from service.sources.folder import MeasurementFolder, declared_json, measured_heights
from service.store import audit
from service.store.columns import EPOCH
from service.store.keys import RESERVED
from service.twin import geometry
from service.twin.ingest import ingest
from service.twin.runtime import Runtime

UNREADABLE = (InvalidInputError, ImageRefusedError, ConflictError, TooLargeError, UnsupportedImageError)
"""What one image may be refused for without ending the import."""


def import_folder(
    runtime: Runtime, folder: MeasurementFolder, progress: Progress = quiet, actor: str = RESERVED
) -> dict[str, Any]:
    """Store the plant, its targets, and every heliostat with its images and measured surface, on behalf of ``actor``.

    Returns how many of each were new, changed or there already; measurements without an image, and images and
    measured surfaces that cannot be read, are listed with the reason.
    """
    counts, skipped = _put_plant(runtime, folder, actor), dict[str, str]()
    for name in folder.plant.heliostats:
        progress(name)
        try:
            measured = folder.measured_surface(name)
        except InvalidInputError as error:
            measured, skipped[f"{name} surface"] = None, str(error)
        counts.update(_put_heliostat(runtime, folder, name, measured, actor))
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


def _put_plant(runtime: Runtime, folder: MeasurementFolder, actor: str) -> Counter[str]:
    """The plant with its targets, receivers and declared model: one deed."""
    plant, declared = folder.plant, declared_json(folder.root / "twin.json")
    targets, receivers = plant.targets.values(), plant.receivers.values()
    done = runtime.database.written(
        lambda session: geometry.set_plant(session, actor, plant.name, plant.origin, targets, receivers, declared)
    )
    counts = Counter([f"plants {done.plant}"])
    counts.update(f"targets {change}" for change in done.targets.values())
    counts.update(f"receivers {change}" for change in done.receivers.values())
    if done.declared is not None:
        counts[f"declared models {done.declared}"] += 1
    return counts


def _put_heliostat(
    runtime: Runtime, folder: MeasurementFolder, name: str, measured: tuple[Any, int] | None, actor: str
) -> list[str]:
    """A heliostat with its measured surface, where it has one: one deed."""
    with runtime.database.writing() as session:
        row, change = geometry.set_heliostat(session, actor, name, folder.properties[name])
        outcomes = [f"heliostats {change}"]
        if measured is not None:
            _, is_new = store.add_surface(session, row, _measured(folder.plant.heliostats[name], measured), once=True)
            outcomes.append(f"surfaces {store.Change.NEW if is_new else store.Change.UNCHANGED}")
            if is_new:
                audit.record(session, actor, "surface.imported", f"heliostat {name}")
    return outcomes


def _measured(heliostat: Heliostat, measured: tuple[Any, int]) -> store.NewSurface:
    """A measured surface describes the mirror from before anything else is known of it."""
    z = measured_heights(heliostat, measured)
    return store.NewSurface("measured", z, np.zeros_like(z), control_points(heliostat, z), valid_from=EPOCH)


def _put_image(runtime: Runtime, folder: MeasurementFolder, measurement: Measurement, kind: ImageKind) -> str:
    photograph = measurement.photograph(kind, folder.plant)
    content = require_regular(measurement.images[kind]).read_bytes()
    row, is_new = ingest(runtime, measurement.heliostat, photograph, content, is_live=False)
    state = "new" if is_new else "unchanged"
    return f"images {state}" if row.accepted else f"images {state}, refused"
