"""Photographs of measurement folders as inputs of the model."""

from collections.abc import Sequence
from pathlib import Path

from heliotwin.folder import observations_of
from heliotwin.folder_store import open_folder
from heliotwin.folder_study import photographs_of
from model.effects import Effect
from model.imaging import ImageKind
from model.observation import Observation
from model.pointing import Reading
from model.study import FluxImage
from service.sources.documents import IMAGE_KINDS
from service.sources.folder import MeasurementFolder
from service.twin.measurements import AcceptedMeasurement, accepted_measurement
from service.twin.photographs.readings import load_readings


def read_observations(
    folder: MeasurementFolder, heliostat: str, effects: Sequence[Effect] = ()
) -> list[Observation]:
    """Observations of one heliostat, as verbs with ``--effects`` take its images."""
    with open_folder(folder, effects=effects) as opened:
        return observations_of(opened, heliostat)[0]


def read_accepted(folder: MeasurementFolder, heliostat: str) -> list[AcceptedMeasurement]:
    """Accepted photographs of one heliostat."""
    with open_folder(folder) as opened:
        origin, (rows, _) = opened.context(heliostat).origin, opened.photographs(heliostat)
        return [accepted_measurement(row, origin) for row in rows]


def read_photographs(
    folder: MeasurementFolder, mounts: Path | None = None
) -> tuple[list[FluxImage], dict[str, str]]:
    """Photographs of a study with measured surfaces, and what is skipped, with the reasons."""
    with open_folder(folder, mounts_file=mounts) as opened:
        found = photographs_of(opened)
    return found.photographs, found.skipped


def read_readings(
    folder: MeasurementFolder, kinds: Sequence[ImageKind] = IMAGE_KINDS
) -> dict[str, list[Reading]]:
    """Readings of the mounts, by heliostat; without ``kinds`` of images by the given spots."""
    targets = folder.plant.targets
    with open_folder(folder, kinds) as opened:
        found = {
            name: load_readings(heliostat, opened.measurements(name), opened.model, targets)[0]
            for name, heliostat in folder.plant.heliostats.items()
            if heliostat.mount.actuators is not None
        }
    return {name: own for name, own in found.items() if own}
