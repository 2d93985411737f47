"""A measurement folder of a plant that ``plant.yaml`` describes.

Its photographs are traced from mirrors with errors, on mounts and of facets that Juelich has not.
"""

import json
from pathlib import Path

import cv2
import numpy as np

from model.forecast import View, align
from model.frames import sun_direction
from model.plant_model import PlantModel
from model.setup import Setup
from model.surface import control_points
from service.sources.plant_file import read_plant
from tests.service.sources.plant_files import PLANT, write_plant

LAYOUT = """\
name,type,east_m,north_m,up_m
A1,large,0,150,0
B1,small,60,120,0
C1,large,200,400,0
"""


SUNS = [(140.0, 40.0), (200.0, 55.0), (110.0, 30.0), (230.0, 35.0), (170.0, 60.0)]


def write_plant_folder(root: Path, text: str = PLANT) -> Path:
    """The folder in ``root``: A1 has motors, B1 has none, C1 has no photographs."""
    drives = "[{kind: rotary, steps_per_rad: 9000}, {kind: rotary, steps_per_rad: 7000}]"
    text = text.replace("mirror_offset_m: 0.2}", f"mirror_offset_m: 0.2, drives: {drives}}}")
    plant = read_plant(write_plant(root, text, layout=LAYOUT))
    target = plant.plant.targets["cal"]
    model = PlantModel(plant.plant.site, plant.optics)
    rng = np.random.default_rng(4)
    for name in ("A1", "B1"):
        heliostat = plant.plant.heliostats[name]
        tilts = rng.normal(0, 2e-4, (2, len(heliostat.facets), 1, 1))
        across = np.linspace(-1, 1, 8)
        z = tilts[0] * across[:, None] + tilts[1] * across
        for number, (azimuth, elevation) in enumerate(SUNS if name == "A1" else SUNS[:2], start=1):
            sun = sun_direction(azimuth, elevation)
            setup = Setup(heliostat, control_points(heliostat, z), sun, target)
            aligned = align([setup], model)
            image = aligned.flux(View(256, 256))[0].numpy()
            places = target.grid(256, 256).points
            spot = (image[..., None] * places).sum(axis=(0, 1)) / image.sum()
            own = root / name / "Calibration"
            own.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(own / f"{number}-flux.png"), np.uint8(255 * image / image.max()))
            properties = {
                "target_name": "cal",
                "sun_azimuth_deg": azimuth,
                "sun_elevation_deg": elevation,
                "focal_spot_m": spot.tolist(),
            }
            if name == "A1":
                steps = heliostat.mount.motors_from_angles(aligned.angles[0])
                properties["motor_position"] = (steps + [60.0, -40.0]).tolist()
            path = own / f"{number}-calibration-properties.json"
            path.write_text(json.dumps(properties))
    return root
