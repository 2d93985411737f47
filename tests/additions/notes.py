"""Folders of a plant that keeps notes: ``notes.json`` holds it all."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.plant import Plant, TargetPlane
from model.plant_model import PlantModel
from model.surface import control_points
from service.base.fields import Sun
from service.sources.documents import Measurement, read_heliostat, read_json
from service.sources.folder import Importer, MeasurementFolder, read_declared


@dataclass(frozen=True, eq=False)
class NotesFolder(MeasurementFolder):
    def read_measurements(self, heliostat: str) -> Iterator[Measurement]:
        for number, (azimuth, elevation) in enumerate(read_json(self.root / "notes.json")["suns"]):
            sun = Sun(azimuth_deg=azimuth, elevation_deg=elevation)
            yield Measurement("wall", sun=sun, external_id=str(number), heliostat=heliostat)

    def measured_surface(self, heliostat: str):
        return control_points(self.plant.heliostats[heliostat], np.zeros((4, 8, 8))), 3


def read(root: Path, heliostats: list[str] | None) -> NotesFolder:
    notes = read_json(root / "notes.json")
    origin = np.array(notes["origin"])
    names = [name for name in notes["heliostats"] if heliostats is None or name in heliostats]
    properties = {name: notes["heliostats"][name] for name in names}
    wall = TargetPlane(
        "wall", np.array([0.0, 0, 40]), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8, 8
    )
    found = {name: read_heliostat(name, document, origin) for name, document in properties.items()}
    plant = Plant("notes", origin, {"wall": wall}, found)
    return NotesFolder(
        root, plant, PlantModel(plant.site, *read_declared(root / "twin.json")), {}, properties
    )


IMPORTER = Importer(
    lambda root: (root / "notes.json").is_file(), read, "no 'notes.json' at the root"
)
