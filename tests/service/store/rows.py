"""Rows to store."""

from typing import Any

import numpy as np

from model.plant import TargetPlane
from service import store
from service.base.arrays import pack
from service.store.database import Database
from service.store.surface_versions import NewSurface
from service.store.tables import (
    ForecastRow,
    HeliostatRow,
    ImageRow,
    MeasurementRow,
    SurfaceRow,
    TargetRow,
)
from tests.service.conftest import ORIGIN, properties_document

PLANE = TargetPlane("lower", np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 8.6, 7.2)


def new(
    target: TargetRow, image: str = "a", kind: str = "flux", **changes: Any
) -> tuple[ImageRow, MeasurementRow]:
    values: dict[str, Any] = {
        "kind": kind,
        "target_id": target.id,
        "sun_azimuth_deg": 170.0,
        "sun_elevation_deg": 40.0,
        "accepted": True,
        "quality": {"accepted": True},
        "arrays": pack({"centered": np.ones((64, 64), np.float32)}),
    }
    stored = ImageRow(
        sha256=image * 64, media_type="image/png", size_bytes=10, width_px=4, height_px=5
    )
    return stored, MeasurementRow(**(values | changes))


def fill(database: Database, count: int) -> list[str]:
    """A heliostat with so many measurements and a surface of all of them; their identifiers."""
    arrays = pack({"centered": np.ones((64, 64), np.float32), "flux": np.ones((8, 8), np.float32)})
    with database.writing() as session:
        store.put_plant(session, "plant", ORIGIN)
        target, _ = store.put_target(session, PLANE)
        heliostat, _ = store.put_heliostat(session, "AA39", properties_document(), (1, 2, 3))
        rows = []
        for number in range(count):
            about = {"external_id": f"m{number}", "sun_azimuth_deg": 3.0 * number, "arrays": arrays}
            image, row = new(
                target, f"{number:02x}" * 32, **about, center_right_m=0.0, center_up_m=0.0
            )
            image.sha256 = f"{number:064x}"
            rows.append(store.add_measurement(session, heliostat, image, row)[0])
        z = np.zeros((4, 8, 8))
        points = np.zeros((4, 8, 8, 3))
        surface, _ = store.add_surface(
            session, heliostat, NewSurface("measured", z, z, points, measurements=rows)
        )
        for _ in range(count):
            store.add_forecast(session, _forecast(heliostat, surface))
    return [row.identifier for row in rows]


def _forecast(heliostat: HeliostatRow, surface: SurfaceRow) -> ForecastRow:
    return ForecastRow(heliostat_id=heliostat.id, surface_id=surface.id, document={}, flux=b"")
