"""What a plant would measure of a heliostat whose mount is not quite what its properties say."""

from typing import Any

import numpy as np

from model.effects.sun_position import SunPosition
from model.frames import sun_angles, sun_direction
from model.plant import Plant
from model.pointing.kinematics import SPREAD, calibrated
from model.pointing.mounts import landed
from model.pointing.readings import later
from service.sources.documents import read_heliostat, read_targets
from tests.service.conftest import ORIGIN


def photographs(
    tower: Any, properties: Any, step_mrad: float = 0.0, fast_minutes: float = 0.0, clock_minutes: float = 0.0
) -> list[dict[str, Any]]:
    """Metadata of 16 photographs, one a day from 1 May 2024; the first drive steps before the ninth.

    So does the clock that the suns are computed by: it is so many minutes fast from then on. ``clock_minutes`` is how
    far the sun had always gone on since the moment that it is recorded at.
    """
    generator = np.random.default_rng(4)
    plane, heliostat = read_targets(tower)[1]["lower"], read_heliostat("AA39", properties, np.array(ORIGIN))
    mount = calibrated(heliostat.mount, 0.3 * SPREAD * generator.normal(size=len(SPREAD)))
    taken = []
    for place in range(16):
        azimuth, elevation = generator.uniform(-60, 60), generator.uniform(20, 60)
        sun = SunPosition(clock_minutes).on_sun(sun_direction(azimuth, elevation)[None], ORIGIN[0])[0]
        angles = mount.align(heliostat.position, sun, plane.center)
        motors = np.round(mount.motors_from_angles(angles))
        step = np.array([1e-3 * step_mrad if place >= 8 else 0.0, 0.0])
        attitude = mount.attitude(mount.angles_from_motors(motors) + step)
        normal, center = attitude[:, 2], mount.mirror_center(heliostat.position, attitude)
        spot = landed(center, 2 * (normal @ sun) * normal - sun, plane)
        recorded = sun_angles(later(sun, fast_minutes if place >= 8 else 0.0, ORIGIN[0]))
        taken.append(
            {
                "id": f"{place}",
                "kind": "flux-centered",
                "sun_azimuth": float(recorded[0]),
                "sun_elevation": float(recorded[1]),
                "motor_position": motors.tolist(),
                "focal_spot": Plant("", np.array(ORIGIN)).to_wgs84(spot).tolist(),
                "taken_at": f"2024-05-{place + 1:02d}T12:00:00Z",
            }
        )
    return taken
