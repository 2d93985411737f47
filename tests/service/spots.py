"""What a plant would measure of a heliostat whose mount is not quite what its properties say."""

from typing import Any

import numpy as np
from fastapi.testclient import TestClient

from model.effects.sun_position import SunPosition
from model.frames import sun_angles, sun_direction
from model.pointing.kinematics import SPREAD, apply_parameters
from model.pointing.spots import intersect_plane
from model.site import Site
from service.sources.documents import read_heliostat, read_targets
from tests.service.conftest import ORIGIN, until


def photographs(
    tower: Any,
    properties: Any,
    step_mrad: float = 0.0,
    fast_minutes: float = 0.0,
    clock_minutes: float = 0.0,
) -> list[dict[str, Any]]:
    """Metadata of 16 photographs, one a day from 1 May 2024; the first drive steps before the
    ninth.

    So does the clock that the suns are computed by: it is so many minutes fast from then on.
    ``clock_minutes`` is how far the sun had always gone on since the moment that it is recorded at.
    """
    generator = np.random.default_rng(4)
    plane, heliostat = (
        read_targets(tower)["lower"],
        read_heliostat("AA39", properties, np.array(ORIGIN)),
    )
    mount = apply_parameters(heliostat.mount, 0.3 * SPREAD * generator.normal(size=len(SPREAD)))
    taken = []
    for place in range(16):
        azimuth, elevation = generator.uniform(-60, 60), generator.uniform(20, 60)
        sun = SunPosition(clock_minutes).on_sun(
            sun_direction(180 - azimuth, elevation)[None], Site.from_origin(ORIGIN)
        )[0]
        angles = mount.align(heliostat.position, sun, plane.center)
        motors = np.round(mount.motors_from_angles(angles))
        step = np.array([1e-3 * step_mrad if place >= 8 else 0.0, 0.0])
        attitude = mount.attitude(mount.angles_from_motors(motors) + step)
        normal, center = attitude[:, 2], mount.mirror_center(heliostat.position, attitude)
        spot = intersect_plane(center, 2 * (normal @ sun) * normal - sun, plane)
        recorded = sun_angles(
            Site.from_origin(ORIGIN).advance_sun(sun, fast_minutes if place >= 8 else 0.0)
        )
        taken.append(
            {
                "id": f"{place}",
                "kind": "flux-centered",
                "sun": {"azimuth_deg": float(recorded[0]), "elevation_deg": float(recorded[1])},
                "motor_position": motors.tolist(),
                "focal_spot_m": spot.tolist(),
                "taken_at": f"2024-05-{place + 1:02d}T12:00:00Z",
            }
        )
    return taken


def calibrate(client: TestClient, **body: Any) -> dict[str, Any]:
    """The calibration job, when it has ended."""
    answer = client.post("/v1/jobs/calibrations", json=body)
    path = answer.headers["Location"]
    until(lambda: client.get(path).json()["state"] in ("done", "failed"))
    job: dict[str, Any] = client.get(path).json()
    return job
