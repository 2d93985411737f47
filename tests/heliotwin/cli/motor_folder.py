"""Files of a measurement folder with motors and spots."""

import json
from pathlib import Path
from typing import Any

from model.frames import enu_to_wgs84
from service.sources.paint_documents import azimuth_from_south
from tests.service.conftest import ORIGIN


def write(path: Path, document: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))


def write_measurement(
    root: Path, name: str, number: int, taken: dict[str, Any], **changes: Any
) -> None:
    document = {
        "motor_position": dict(
            zip(
                ("axis_1_motor_position", "axis_2_motor_position"),
                taken["motor_position"],
                strict=True,
            )
        ),
        "target_name": "lower",
        "sun_azimuth": azimuth_from_south(taken["sun"]["azimuth_deg"]),
        "sun_elevation": taken["sun"]["elevation_deg"],
        "focal_spot": {"UTIS": enu_to_wgs84(taken["focal_spot_m"], ORIGIN).tolist()},
        **changes,
    }
    kept = {key: value for key, value in document.items() if value is not None}
    write(root / name / "Calibration" / f"{number}-calibration-properties.json", kept)
