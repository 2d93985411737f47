"""Folders in the layout of the PAINT database of the Solar Tower Juelich, https://paint-database.org."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from model.errors import InvalidInputError
from model.plant import Heliostat, Plant
from model.pointing import Weather
from service.sources.documents import (
    IMAGE_KINDS,
    SUFFIXES,
    Measurement,
    read_heliostat,
    read_json,
    read_measurement,
    read_moment,
    read_receivers,
    read_targets,
    read_weather,
)
from service.sources.folder import Importer, MeasurementFolder, read_declared


@dataclass(frozen=True, eq=False)
class PaintFolder(MeasurementFolder):
    """A folder in PAINT's layout."""

    def read_measurements(self, heliostat: str) -> Iterator[Measurement]:
        """Those of ``H/Calibration``, with their moments where there are STAC items."""
        folder = self.root / heliostat / "Calibration"
        for path in sorted(folder.glob("*calibration-properties.json")):
            identifier = path.name.removesuffix("calibration-properties.json").removesuffix("-")
            if not identifier:
                continue  # a sample that PAINT ships without a number; nothing could refer to it
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
    """With the moment of its STAC item, and its weather where the measurement tells none."""
    taken_at, weather = read_moment(item, where), measurement.weather
    if weather == Weather():
        weather = read_weather(item["properties"], where)
    return replace(measurement, taken_at=taken_at, weather=weather)


def _towers(root: Path) -> list[Path]:
    return sorted(root.glob("*tower-measurements.json"))


def _read(root: Path, heliostats: list[str] | None) -> PaintFolder:
    file = _towers(root)[0]
    tower = read_json(file)
    origin, targets = read_targets(tower)
    found: dict[str, Heliostat] = {}
    skipped: dict[str, str] = {}
    properties: dict[str, Any] = {}
    for own in sorted(filter(Path.is_dir, root.iterdir())):
        name, folder = own.name, own / "Properties"
        files = sorted(folder.glob("*heliostat-properties.json"))
        is_one = bool(files) or (own / "Calibration").is_dir()
        if not is_one or (heliostats is not None and name not in heliostats):
            continue
        try:
            if not files:
                raise InvalidInputError(f"{folder}: no '{name}-heliostat-properties.json'; add it, or leave {name} out")
            if len(files) > 1:
                names = ", ".join(entry.name for entry in files)
                raise InvalidInputError(f"{folder}: more than one file of properties ({names}); leave the right one")
            document = read_json(files[0])
            found[name], properties[name] = read_heliostat(name, document, origin), document
        except InvalidInputError as error:
            skipped[name] = str(error)
    if not found:
        raise InvalidInputError(f"{root}: no heliostat with a readable 'Properties/*heliostat-properties.json'")
    plant = Plant(_plant_name(tower, file), origin, targets, found, read_receivers(tower))
    return PaintFolder(root, plant, *read_declared(root / "twin.json"), skipped, properties)


def _plant_name(tower: Any, file: Path) -> str:
    """PAINT's ID of the plant; older files have none, and bear the name themselves."""
    name = tower["power_plant_properties"].get("ID")
    return name if isinstance(name, str) and name else file.name.removesuffix("-tower-measurements.json")


IMPORTER = Importer(
    recognises=lambda root: bool(_towers(root)),
    read=_read,
    otherwise="no '*tower-measurements.json' at the root; is it a PAINT folder?",
)
