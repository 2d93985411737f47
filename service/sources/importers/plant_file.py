"""Folders of a plant that ``plant.yaml`` describes; DESIGN.md, section 8."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field

from model.errors import InvalidInputError
from model.plant import Heliostat, Plant
from model.plant_model import PlantModel
from service.base.fields import Elevation, Number, Sun
from service.base.plant import PlantFacts
from service.sources.documents import (
    IMAGE_KINDS,
    SUFFIXES,
    Measurement,
    optics_to_json,
    parse_declared,
    read_json,
    sun_to_json,
)
from service.sources.folder import Importer, MeasurementFolder, declared_json
from service.sources.heliostat_document import heliostat_to_json
from service.sources.plant_file import PlantDescription, read_plant
from service.sources.plant_formats.imported import PLANT
from service.sources.plant_parts import types_to_json
from service.sources.schema import WeatherDocument, parse, parse_time

_ENDING = "-calibration-properties.json"


class MeasurementProperties(WeatherDocument):
    """``ID-calibration-properties.json`` of such a folder."""

    model_config = ConfigDict(allow_inf_nan=False, extra="forbid")

    target_name: str
    sun_azimuth_deg: Annotated[Number, Field(ge=-360, le=360)]
    sun_elevation_deg: Elevation
    time: Annotated[Any, BeforeValidator(parse_time)] = None
    focal_spot_m: tuple[Number, Number, Number] | None = None
    motor_position: tuple[Number, Number] | None = None


@dataclass(frozen=True, eq=False)
class PlantFileFolder(MeasurementFolder):
    """A folder with ``plant.yaml`` at its root.

    Attributes
    ----------
    description : PlantDescription
    """

    description: PlantDescription = field(kw_only=True)

    def whole_field(self) -> "PlantFileFolder":
        """The folder with every heliostat of the layout."""
        every = self.description.plant.heliostats
        properties = _properties(self.description, every)
        return replace(self, plant=replace(self.plant, heliostats=every), properties=properties)

    def declared(self) -> dict[str, object]:
        """Sun and air of ``plant.yaml``; ``twin.json`` adds effects and cameras."""
        return _declared(self.description) | super().declared()

    def read_measurements(self, heliostat: str) -> Iterator[Measurement]:
        """Iterate over the measurements of ``H/Calibration``."""
        folder = self.root / heliostat / "Calibration"
        for path in sorted(folder.glob(f"*{_ENDING}")):
            identifier = path.name.removesuffix(_ENDING)
            try:
                yield self._measurement(identifier, heliostat, folder, read_json(path))
            except InvalidInputError as error:
                self.skipped[f"{heliostat}/{identifier}"] = str(error)

    def _measurement(self, identifier: str, heliostat: str, folder: Path, data: Any) -> Measurement:
        where = f"measurement {heliostat}/{identifier}"
        document = parse(MeasurementProperties, data, where)
        if document.target_name not in self.plant.targets:
            raise InvalidInputError(
                f"{where}: target_name: {document.target_name[:80]!r} is none of"
                f" {', '.join(self.plant.targets) or 'the plant, which has no targets'}"
            )
        spot = None if document.focal_spot_m is None else np.array(document.focal_spot_m)
        wgs84 = None if spot is None else tuple(self.plant.to_wgs84(spot).tolist())
        return Measurement(
            document.target_name,
            sun=Sun(
                azimuth_deg=document.sun_azimuth_deg % 360, elevation_deg=document.sun_elevation_deg
            ),
            external_id=identifier,
            heliostat=heliostat,
            spot=spot,
            focal_spot_wgs84=wgs84,
            motor_position=document.motor_position,
            images=_images(folder, identifier),
            taken_at=document.time,
            weather=document.weather,
        )


def _images(folder: Path, identifier: str) -> dict[Any, Path]:
    """Image files of a measurement by kind."""
    found = {}
    for kind in IMAGE_KINDS:
        files = [folder / f"{identifier}-{kind}.{suffix}" for suffix in SUFFIXES.values()]
        file = next(filter(Path.is_file, files), None)
        if file is not None:
            found[kind] = file
    return found


def _declared(description: PlantDescription) -> dict[str, object]:
    optics = description.optics
    return {"sun": sun_to_json(optics.sun_shape), "optics": optics_to_json(optics)}


def _read(root: Path, heliostats: list[str] | None) -> PlantFileFolder:
    description = read_plant(root / PLANT)
    plant = description.plant
    kept = {
        name: heliostat
        for name, heliostat in plant.heliostats.items()
        if (root / name).is_dir() and (heliostats is None or name in heliostats)
    }
    declared = _declared(description) | declared_json(root / "twin.json")
    model = PlantModel(plant.site, *parse_declared(declared, str(root / "twin.json")))
    whole = Plant(plant.name, plant.origin, plant.targets, kept, plant.receivers)
    properties = _properties(description, kept)
    facts = PlantFacts(description.tower, description.time_zone, types_to_json(root / PLANT))
    return PlantFileFolder(root, whole, model, {}, properties, facts=facts, description=description)


def _properties(
    description: PlantDescription, heliostats: Mapping[str, Heliostat]
) -> dict[str, dict[str, object]]:
    return {
        name: heliostat_to_json(heliostat, description.layout[name])
        for name, heliostat in heliostats.items()
    }


IMPORTER = Importer(
    recognises=lambda root: (root / PLANT).is_file(),
    read=_read,
    otherwise=f"no '{PLANT}' at the root",
)
