"""Folders of the PAINT database of the Solar Tower Juelich, https://paint-database.org."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from model.errors import InvalidInputError
from model.plant import Heliostat, Plant
from model.plant_model import PlantModel
from model.pointing import Weather
from service.base.plant import PlantFacts
from service.sources.documents import (
    IMAGE_KINDS,
    SUFFIXES,
    Measurement,
    read_facts,
    read_heliostat,
    read_item,
    read_json,
    read_measurement,
    read_receivers,
    read_targets,
    read_tower_base,
    unknown_parts,
)
from service.sources.folder import Importer, MeasurementFolder, read_declared
from service.sources.plant_errors import PlantText
from service.sources.plant_formats.imported import PLANT
from service.sources.plant_parts import types_to_json


@dataclass(frozen=True, eq=False)
class PaintFolder(MeasurementFolder):
    """A folder in PAINT's layout."""

    def read_measurements(self, heliostat: str) -> Iterator[Measurement]:
        """Iterate over the measurements of ``H/Calibration``; STAC items give their times."""
        folder = self.root / heliostat / "Calibration"
        for path in sorted(folder.glob("*calibration-properties.json")):
            identifier = path.name.removesuffix("calibration-properties.json").removesuffix("-")
            if not identifier:
                continue  # PAINT has a sample without a number, which has no identifier
            try:
                measurement = read_measurement(identifier, heliostat, read_json(path), self.plant)
                item = folder / f"{identifier}-calibration-item-stac.json"
                if item.is_file():
                    measurement = _with_item(measurement, read_json(item), str(item))
            except InvalidInputError as error:
                self.skipped[f"{heliostat}/{identifier}"] = str(error)
                continue
            for kind in IMAGE_KINDS:
                files = [folder / f"{identifier}-{kind}.{suffix}" for suffix in SUFFIXES.values()]
                found = next(filter(Path.is_file, files), None)
                if found is not None:
                    measurement.images[kind] = found
            yield measurement


def _with_item(measurement: Measurement, item: Any, where: str) -> Measurement:
    """Add the time of a STAC item, and its weather if the measurement has none."""
    dated, own = read_item(item, where), measurement.weather
    weather = dated.weather if own == Weather() else own
    return replace(measurement, taken_at=dated.taken_at, weather=weather)


def _towers(root: Path) -> list[Path]:
    return sorted(root.glob("*tower-measurements.json"))


def _read(root: Path, heliostats: list[str] | None) -> PaintFolder:
    file, *others = _towers(root)
    if others:
        names = ", ".join(entry.name for entry in (file, *others))
        raise InvalidInputError(f"{root}: more than one tower file ({names}); leave the right one")
    tower = read_json(file)
    origin, targets = read_tower_base(tower), read_targets(tower)
    found: dict[str, Heliostat] = {}
    skipped = unknown_parts(tower)
    broken: dict[str, str] = {}
    properties: dict[str, dict[str, object]] = {}
    for own in sorted(filter(Path.is_dir, root.iterdir())):
        name, folder = own.name, own / "Properties"
        files = sorted(folder.glob("*heliostat-properties.json"))
        is_one = bool(files) or (own / "Calibration").is_dir()
        if not is_one or (heliostats is not None and name not in heliostats):
            continue
        try:
            if not files:
                raise InvalidInputError(
                    f"{folder}: no '{name}-heliostat-properties.json'; add it, or leave {name} out"
                )
            if len(files) > 1:
                names = ", ".join(entry.name for entry in files)
                raise InvalidInputError(
                    f"{folder}: more than one file of properties ({names}); leave the right one"
                )
            document = read_json(files[0])
            found[name], properties[name] = read_heliostat(name, document, origin), document
        except InvalidInputError as error:
            skipped[name] = str(error)
            if files:
                said = str(error)
                broken[name] = said if str(folder) in said else f"{files[0]}: {said}"
    if not found:
        why = next(iter(broken.values()), "")
        raise InvalidInputError(
            f"{root}: no heliostat with a readable"
            f" 'Properties/*heliostat-properties.json'{why and f': {why}'}"
        )
    plant = Plant(_plant_name(tower, file), origin, targets, found, read_receivers(tower))
    model = PlantModel(plant.site, *read_declared(root / "twin.json"))
    facts = _with_types(read_facts(tower), root, skipped)
    return PaintFolder(root, plant, model, skipped, properties, broken, facts)


def _with_types(facts: PlantFacts, root: Path, skipped: dict[str, str]) -> PlantFacts:
    """Add time zone and heliostat types of ``plant.yaml``, which exports have."""
    path = root / PLANT
    if not path.is_file():
        return facts
    try:
        zone, types = PlantText.read(path).entries.plant.time_zone, types_to_json(path)
    except InvalidInputError as error:
        skipped[PLANT] = str(error)
        return facts
    return replace(facts, time_zone=zone, heliostat_types=types)


def _plant_name(tower: Any, file: Path) -> str:
    """PAINT's ID of the plant; without an ID, the prefix of the file name."""
    name = tower["power_plant_properties"].get("ID")
    return (
        name
        if isinstance(name, str) and name
        else file.name.removesuffix("-tower-measurements.json")
    )


IMPORTER = Importer(
    recognises=lambda root: bool(_towers(root)),
    read=_read,
    otherwise="no '*tower-measurements.json' at the root; is it a PAINT folder?",
)
