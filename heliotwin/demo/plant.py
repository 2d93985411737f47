"""A small plant for the demonstration: a measurement folder with four heliostats and one target.

The true mirror surfaces are drawn from the surface prior.
"""

from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from heliotwin.demo.photographs import (
    DEVIATION,
    IMAGES,
    RAYS,
    Photographs,
    TargetCamera,
    write_photograph,
)
from heliotwin.folder import write_json, write_surface
from model.actuator import LinearActuator
from model.frames import sun_angles
from model.mount import Mount
from model.plant import Heliostat, Plant, TargetPlane
from model.prior import default_prior
from model.surface import control_points
from model.tracing import Optics
from service.base.fields import Sun
from service.base.progress import Progress, no_progress
from service.sources.paint_documents import measurement_json
from service.sources.photograph import IncomingPhotograph

Array = NDArray[np.float64]

ORIGIN = np.array([50.9134, 6.3878, 87.0])
POSITIONS = {
    "AB12": (-44.0, 62.0, 1.7),
    "AC31": (12.0, 41.0, 1.8),
    "AF27": (38.0, 96.0, 1.9),
    "AK08": (-72.0, 138.0, 1.8),
}
TARGET = TargetPlane(
    "calibration_target",
    np.array([0.0, 0.0, 40.0]),
    np.array([0.0, 1.0, 0.0]),
    np.array([0.0, 0.0, 1.0]),
    8.0,
    7.0,
)
# Spindles as at the Juelich heliostats; the mounts have no errors, so motor positions give exact
# mirror orientations.
DRIVES = (
    LinearActuator(
        154166.6667, 0.0775, 0.338, 0.325, 0.039, clockwise=False, max_increment=80000.0
    ),
    LinearActuator(154166.6667, 0.0775, 0.338, 0.325, 0.944, clockwise=True, max_increment=80000.0),
)


def _actuator(drive: LinearActuator) -> dict[str, object]:
    document = asdict(drive)
    clockwise = document.pop("clockwise")
    return {"type_axis": "linear", "clockwise_axis_movement": int(clockwise), **document}


def properties(mirror: Heliostat, plant: Plant) -> dict[str, object]:
    """The heliostat as PAINT's ``heliostat-properties.json``."""
    translations = {f"joint_translation_{axis}_{stage}": 0.0 for stage in (1, 2) for axis in "enu"}
    return {
        "heliostat_position": plant.to_wgs84(mirror.position).tolist(),
        "height": mirror.height,
        "width": mirror.width,
        "initial_orientation": [0.0, -1.0, 0.0],
        "kinematics_properties": {
            "actuators": [
                _actuator(one)
                for one in mirror.mount.actuators or ()
                if isinstance(one, LinearActuator)
            ]
            or [{"type_axis": "ideal"}] * 2,
            **translations,
            "concentrator_translation_e": 0.0,
            "concentrator_translation_n": float(mirror.mount.mirror_offset[2]),
            "concentrator_translation_u": 0.0,
        },
        "facet_properties": {
            "canting_type": "receiver canting",
            "number_of_facets": len(mirror.facets),
            "facets": [
                {
                    "translation_vector": facet.position.tolist(),
                    "canting_e": facet.canting_x.tolist(),
                    "canting_n": facet.canting_y.tolist(),
                }
                for facet in mirror.facets
            ],
        },
    }


def tower(plant: Plant) -> dict[str, object]:
    """The tower as PAINT's ``tower-measurements.json``."""
    x, y = TARGET.width / 2, TARGET.height / 2
    corners = {
        "upper_left": (-x, y),
        "upper_right": (x, y),
        "lower_left": (-x, -y),
        "lower_right": (x, -y),
    }
    return {
        "power_plant_properties": {"ID": plant.name, "coordinates": ORIGIN.tolist()},
        TARGET.name: {
            "type": "planar",
            "normal_vector": TARGET.normal.tolist(),
            "coordinates": {
                name: plant.to_wgs84(TARGET.to_enu(place)).tolist()
                for name, place in corners.items()
            },
        },
    }


def write_plant(
    root: Path,
    progress: Progress = no_progress,
    *,
    images: int = IMAGES,
    rays: int = RAYS,
    seed: int = 2024,
) -> None:
    """Write the demonstration's measurement folder, with true surfaces in ``H/Deflectometry``."""
    rng = np.random.default_rng(seed)
    plant, prior = Plant("demo", ORIGIN), default_prior()
    camera = TargetCamera(TARGET, float(ORIGIN[0]), Optics(), rays)
    write_json(root / "demo-tower-measurements.json", tower(plant))

    def take(number: int, mirror: Heliostat, z: Array, draws: np.random.Generator) -> None:
        taken = camera.photograph(mirror, z, images, draws)
        _write_photographs(root, number, mirror.name, taken)
        progress(mirror.name)

    with ThreadPoolExecutor(2) as pool:
        written = []
        for number, (name, position) in enumerate(POSITIONS.items(), start=1):
            distance = float(np.linalg.norm(position - TARGET.center))
            mirror = Heliostat.juelich(name, position, distance, mount=Mount.juelich(DRIVES))
            z = prior.surface(rng.normal(0, DEVIATION, len(prior.basis)))
            write_json(
                root / name / "Properties" / f"{name}-heliostat-properties.json",
                properties(mirror, plant),
            )
            write_surface(root, name, control_points=control_points(mirror, z))
            written.append(pool.submit(take, number, mirror, z, deepcopy(rng)))
            camera.skip(images, rng)
        for one in written:
            one.result()


def _write_photographs(root: Path, number: int, name: str, taken: Photographs) -> None:
    """Write the photographs of a mirror, with their properties."""
    assert taken.motors is not None  # its mounts have drives
    for index, (sun, motors, frame) in enumerate(
        zip(taken.suns, taken.motors, taken.frames, strict=True), start=1
    ):
        azimuth, elevation = sun_angles(sun)
        first, second = (round(float(steps)) for steps in motors)
        position = Sun.model_construct(azimuth_deg=float(azimuth), elevation_deg=float(elevation))
        about = IncomingPhotograph(TARGET.name, "raw", position, motor_position=(first, second))
        write_photograph(root / name, f"{number}{index:02d}", measurement_json(about), raw=frame)
