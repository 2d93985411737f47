"""Import a measurement folder into the store: ``heliotwin import DIR``.

A second import changes nothing.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

import numpy as np
from sqlalchemy.exc import DataError, IntegrityError
from sqlalchemy.orm import Session

from model.errors import ImageRefusedError, InvalidInputError, ModelError
from model.surface import control_points
from service import store
from service.base.errors import (
    BusyError,
    ConflictError,
    NotFoundError,
    TooLargeError,
    UnsupportedImageError,
    list_reasons,
)
from service.base.progress import Progress, no_progress
from service.base.validation import escape_control_characters
from service.sources.documents import IMAGE_KINDS
from service.sources.files import read_file
from service.sources.folder import MeasurementFolder, measured_heights
from service.sources.photograph import IncomingPhotograph
from service.store.keys import RESERVED
from service.twin import history, plant_setup
from service.twin.photographs.metadata import photograph_with_target
from service.twin.photographs.repeats import receive
from service.twin.runtime import Runtime
from service.twin.surfaces.prediction import import_surface

UNREADABLE = (
    InvalidInputError,
    ImageRefusedError,
    BusyError,
    ConflictError,
    NotFoundError,
    TooLargeError,
    UnsupportedImageError,
)
"""Errors of one image that do not end the import."""


class ImportReport(TypedDict):
    """Counts, skipped items with reasons, and their number by reason."""

    counts: dict[str, int]
    skipped: dict[str, str]
    skipped_by_reason: dict[str, int]


@dataclass(eq=False)
class Imported:
    """Counts of new, changed and unchanged items, and skipped items with reasons."""

    counts: Counter[str] = field(default_factory=Counter)
    skipped: dict[str, str] = field(default_factory=dict)

    def to_json(self) -> ImportReport:
        """The same as in reports."""
        skipped = {
            escape_control_characters(what): escape_control_characters(why)
            for what, why in self.skipped.items()
        }
        return {
            "counts": dict(sorted(self.counts.items())),
            "skipped": skipped,
            "skipped_by_reason": dict(Counter(skipped.values()).most_common()),
        }


def import_folder(
    runtime: Runtime,
    folder: MeasurementFolder,
    progress: Progress = no_progress,
    actor: str = RESERVED,
    imported: Imported | None = None,
) -> ImportReport:
    """Import the plant, its targets, and all heliostats with images and measured surfaces.

    ``actor`` is who imports. The result is also in ``imported``, so that the caller has it even if
    the import fails. Measurements without an image are skipped if they lack motors or a spot. Items
    that cannot be read are skipped alone.

    Raises
    ------
    ModelError
        If no heliostat could be imported.
    """
    imported = Imported() if imported is None else imported
    imported.skipped.update(folder.skipped)
    imported.counts.update(_put_plant(runtime, folder, actor))
    if (folder.root / history.PLANT).exists():
        _restore(
            runtime,
            imported,
            "plant",
            lambda session: history.restore_plant(session, folder.root, actor),
        )
    for name in folder.plant.heliostats:
        progress(name)
        try:
            _import_heliostat(runtime, folder, name, imported, progress, actor)
        except UNREADABLE as error:
            imported.skipped[name] = str(error)
    if not any(what.startswith("heliostats ") for what in imported.counts):
        reasons = list_reasons(imported.to_json()["skipped"])
        raise ModelError(f"no heliostat could be imported ({reasons})")
    return imported.to_json()


def _import_heliostat(
    runtime: Runtime,
    folder: MeasurementFolder,
    name: str,
    imported: Imported,
    progress: Progress,
    actor: str,
) -> None:
    """Import a heliostat with its images, and with its history or measured surface.

    Only an export has a history.
    """
    counts, skipped, measured, document = imported.counts, imported.skipped, None, None
    try:
        document = history.load_heliostat(folder.root, name)
    except InvalidInputError as error:
        skipped[f"{name} history"] = str(error)
    try:
        measured = _measured_surface(folder, name) if document is None else None
    except InvalidInputError as error:
        skipped[f"{name} surface"] = str(error)
    counts.update(_put_heliostat(runtime, folder, name, actor))

    def put(key: str, photograph: IncomingPhotograph, file: Path | None) -> None:
        progress(key)
        try:
            counts[_put(runtime, name, photograph, file, actor)] += 1
        except UNREADABLE as error:
            skipped[key] = str(error)

    stored = set[Path | str]()  # files of images, and names of positions without one
    for one in () if document is None else document.photographs:  # in the order in which they came
        file = history.image_path(folder.root, name, one)
        stored |= {one.identifier, one.external_id or ""} if file is None else {file}
        put(f"{name}/{one.identifier} {one.kind}", photograph_with_target(one, one.target), file)
    for measurement in folder.measurements(name, with_images=False):
        if not measurement.images and measurement.external_id not in stored:
            put(measurement.key, measurement, None)
        for kind in sorted(measurement.images, key=IMAGE_KINDS.index):
            file = measurement.images[kind]
            if file not in stored:
                put(f"{measurement.key} {kind}", measurement.photograph(kind), file)
    if measured is not None:  # after the photographs that judge it
        try:
            is_new = import_surface(runtime, name, measured, actor)
            counts[f"surfaces {store.Change.NEW if is_new else store.Change.UNCHANGED}"] += 1
        except (ModelError, *UNREADABLE) as error:
            skipped[f"{name} surface"] = str(error)
    if document is not None:
        n_facets = len(folder.plant.heliostats[name].facets)

        def restored(session: Session) -> bool:
            row = store.get_heliostat(session, name)
            return history.restore_heliostat(session, row, document, folder.root, actor, n_facets)

        _restore(runtime, imported, name, restored)


def _restore(
    runtime: Runtime, imported: Imported, owner: str, restore: Callable[[Session], bool]
) -> None:
    """Restore a history in one transaction."""
    try:
        is_new = runtime.database.run_in_transaction(restore)
        change = store.Change.NEW if is_new else store.Change.UNCHANGED
    except InvalidInputError as error:
        imported.skipped[f"{owner} history"] = str(error)
    except (IntegrityError, DataError) as error:
        imported.skipped[f"{owner} history"] = (
            f"it contradicts itself or the store ({error.orig}); export it again"
        )
    else:
        imported.counts[f"histories {change}"] += 1


def _put_plant(runtime: Runtime, folder: MeasurementFolder, actor: str) -> Counter[str]:
    """Store the plant with targets, receivers and declared model in one transaction."""
    plant, has_history = folder.plant, (folder.root / history.PLANT).exists()
    declared = None if has_history else folder.declared()
    changes = runtime.database.run_in_transaction(
        lambda session: plant_setup.set_plant(
            session, _authorship(folder, actor), plant, declared, facts=folder.facts
        )
    )
    counts = Counter([f"plants {changes.plant}"])
    counts.update(f"targets {change}" for change in changes.targets.values())
    counts.update(f"receivers {change}" for change in changes.receivers.values())
    if changes.declared is not None:
        counts[f"declared models {changes.declared}"] += 1
    return counts


def _put_heliostat(runtime: Runtime, folder: MeasurementFolder, name: str, actor: str) -> list[str]:
    """Store a heliostat in one transaction."""

    def put(session: Session) -> list[str]:
        by = _authorship(folder, actor)
        _, change = plant_setup.set_heliostat(session, by, name, folder.properties[name])
        return [f"heliostats {change}"]

    return runtime.database.run_in_transaction(put)


def _authorship(folder: MeasurementFolder, actor: str) -> plant_setup.Authorship:
    return plant_setup.Authorship(actor, f"import of {folder.root.name}"[:200])


def _measured_surface(folder: MeasurementFolder, name: str) -> store.NewSurface | None:
    """The measured surface of a heliostat, or None; since when it is valid is unknown."""
    heliostat, measured = folder.plant.heliostats[name], folder.measured_surface(name)
    if measured is None:
        return None
    z = measured_heights(heliostat, measured)
    if not np.isfinite(z).all():
        raise InvalidInputError(
            f"the measured surface of {name} has no finite heights; leave it out"
        )
    return store.NewSurface("measured", z, np.zeros_like(z), control_points(heliostat, z))


def _put(
    runtime: Runtime, heliostat: str, photograph: IncomingPhotograph, file: Path | None, actor: str
) -> str:
    """Store an image, or a position without one; return the outcome to count."""
    data = None if file is None else read_file(file, runtime.settings.max_image_bytes)
    received = receive(runtime, heliostat, photograph, data, is_live=False, actor=actor)
    what = "positions" if data is None else "images"
    state = "new" if received.is_new else "changed" if received.filled else "unchanged"
    return f"{what} {state}" if received.row.accepted else f"{what} {state}, refused"
