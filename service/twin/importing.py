"""Loading a measurement folder into the store: ``heliotwin import DIR``. A second run changes nothing."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from model.errors import ImageRefusedError, InvalidInputError
from model.plant import Heliostat
from model.surface import control_points
from service import store
from service.base.faults import ConflictError, TooLargeError, UnsupportedImageError
from service.base.progress import Progress, quiet
from service.sources.documents import IMAGE_KINDS
from service.sources.files import require_regular
from service.sources.folder import MeasurementFolder, declared_json, measured_heights
from service.sources.photograph import Photograph
from service.store import audit
from service.store.columns import EPOCH
from service.store.keys import RESERVED
from service.twin import geometry, history
from service.twin.ingest import ingest
from service.twin.photographs import photograph_with
from service.twin.runtime import Runtime

UNREADABLE = (InvalidInputError, ImageRefusedError, ConflictError, TooLargeError, UnsupportedImageError)
"""What one image may be refused for without ending the import."""


@dataclass(eq=False)
class Imported:
    """How many of each were new, changed or there already, and what was skipped, with the reason."""

    counts: Counter[str] = field(default_factory=Counter)
    skipped: dict[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Both, as reports have them."""
        return {"counts": dict(sorted(self.counts.items())), "skipped": self.skipped}


def import_folder(
    runtime: Runtime,
    folder: MeasurementFolder,
    progress: Progress = quiet,
    actor: str = RESERVED,
    made: Imported | None = None,
) -> dict[str, Any]:
    """Store the plant, its targets, and every heliostat with its images and measured surface, on behalf of ``actor``.

    Returns what was ``made``, which tells whoever gives it what was done until the import ended, however that was.
    Skipped are measurements without an image, and images and measured surfaces that cannot be read.
    """
    made = Imported() if made is None else made
    made.skipped.update(folder.skipped)
    made.counts.update(_put_plant(runtime, folder, actor))
    if (folder.root / history.PLANT).exists():
        _restore(runtime, made, "plant", lambda session: history.restore_plant(session, folder.root, actor))
    for name in folder.plant.heliostats:
        progress(name)
        _import_heliostat(runtime, folder, name, made, progress, actor)
    return made.to_json()


def _import_heliostat(
    runtime: Runtime,
    folder: MeasurementFolder,
    name: str,
    made: Imported,
    progress: Progress,
    actor: str,
) -> None:
    """A heliostat with its images and, where the folder came of an export, with its history, else its surface."""
    counts, skipped, measured, told = made.counts, made.skipped, None, None
    try:
        told = history.load_heliostat(folder.root, name)
    except InvalidInputError as error:
        skipped[f"{name} history"] = str(error)
    try:
        measured = folder.measured_surface(name) if told is None else None
    except InvalidInputError as error:
        skipped[f"{name} surface"] = str(error)
    counts.update(_put_heliostat(runtime, folder, name, measured, actor))

    def put(what: str, photograph: Photograph, file: Path) -> None:
        progress(what)
        try:
            counts[_put_image(runtime, name, photograph, file)] += 1
        except UNREADABLE as error:
            skipped[what] = str(error)

    done = set[Path]()
    for one in () if told is None else told.photographs:  # in the order in which they came
        file = history.image_path(folder.root, name, one)
        done.add(file)
        put(f"{name}/{one.identifier} {one.kind}", photograph_with(one, one.target), file)
    for measurement in folder.measurements(name, with_images=False):
        if not measurement.images:
            skipped[measurement.key] = "no image"
        for kind in sorted(measurement.images, key=IMAGE_KINDS.index):
            file = measurement.images[kind]
            if file not in done:
                put(f"{measurement.key} {kind}", measurement.photograph(kind, folder.plant), file)
    if told is not None:

        def restored(session: Session) -> bool:
            row = store.get_heliostat(session, name)
            return history.restore_heliostat(session, row, told, folder.root, actor)

        _restore(runtime, made, name, restored)


def _restore(runtime: Runtime, made: Imported, whose: str, deed: Callable[[Session], bool]) -> None:
    """Bring back a history, all of it or nothing."""
    try:
        change = store.Change.NEW if runtime.database.written(deed) else store.Change.UNCHANGED
    except InvalidInputError as error:
        made.skipped[f"{whose} history"] = str(error)
    except IntegrityError as error:
        made.skipped[f"{whose} history"] = f"it contradicts itself or the store ({error.orig}); export it anew"
    else:
        made.counts[f"histories {change}"] += 1


def _put_plant(runtime: Runtime, folder: MeasurementFolder, actor: str) -> Counter[str]:
    """The plant with its targets, receivers and declared model: one deed."""
    plant, is_told = folder.plant, (folder.root / history.PLANT).exists()
    declared = None if is_told else declared_json(folder.root / "twin.json")
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


def _put_image(runtime: Runtime, heliostat: str, photograph: Photograph, file: Path) -> str:
    row, is_new = ingest(runtime, heliostat, photograph, require_regular(file).read_bytes(), is_live=False)
    state = "new" if is_new else "unchanged"
    return f"images {state}" if row.accepted else f"images {state}, refused"
