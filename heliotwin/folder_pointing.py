"""Mounts of a measurement folder: ``heliotwin calibrate`` and ``heliotwin spot``."""

from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from heliotwin.folder import write_json
from heliotwin.folder_store import open_folder
from model.errors import InvalidInputError, ModelError
from model.frames import sun_direction
from model.pointing.report import day_of, field_to_json
from model.pointing.spots import forecast_spot
from service import store
from service.base.errors import SKIPPED, list_reasons
from service.base.progress import Progress, no_progress
from service.sources.folder import MeasurementFolder
from service.store.tables import MeasurementRow
from service.twin.calibration import calibrate_store
from service.twin.photographs.readings import motors_of
from service.twin.stored_mount import StoredMount, load_mount


def calibrate_folder(
    folder: MeasurementFolder,
    out: Path,
    progress: Progress = no_progress,
    until: datetime | None = None,
) -> dict[str, Any]:
    """Calibrate the mounts of a folder's heliostats from motors, suns and spots; write MOUNTS.json.

    With ``until``, only earlier measurements are used. A study can then find what has changed
    since.

    Raises
    ------
    ConflictError
        If no heliostat has a measurement with motors and a spot.
    """
    with open_folder(folder, progress=progress) as opened:
        calibrated = calibrate_store(opened.runtime, opened.names, until=until)
        clocks = opened.clocks()
    skipped = folder.skipped | calibrated.skipped
    report = field_to_json(calibrated.done, skipped, calibrated.effects)
    report |= {"clocks": clocks} if clocks else {}
    report["undated"] = asdict(calibrated.undated)
    write_json(out, report)
    return report


def spot_folder(
    folder: MeasurementFolder, mounts: Path, out: Path, progress: Progress = no_progress
) -> dict[str, Any]:
    """Predict the spots from motor positions and calibrated mounts; write SPOTS.json.

    Raises
    ------
    InvalidInputError
        If the file of mounts is invalid.
    ModelError
        If no measurement gives a spot.
    """
    skipped, spots = folder.skipped, {}
    with open_folder(folder, kinds=(), mounts_file=mounts, progress=progress) as opened:
        for name in opened.names:
            try:
                stored = load_mount(opened.session, name)
                if stored.version is None:
                    raise InvalidInputError(f"{mounts} has no mount of it; calibrate it first")
            except SKIPPED as error:
                skipped[name] = str(error)
                continue
            for row in opened.measurements(name):
                key = f"{name}/{row.identifier}"
                try:
                    spots[key] = _spot(stored, row)
                except ModelError as error:
                    skipped[key] = str(error)
    report = {"spots": spots, "skipped": skipped}
    write_json(out, report)
    if not spots:
        raise ModelError(f"no spot can be measured ({list_reasons(skipped)}); see {out}")
    return report


def _spot(stored: StoredMount, row: MeasurementRow) -> dict[str, object]:
    plane, motors = store.target_plane(row.target), motors_of(stored.heliostat, row)
    sun = stored.sun(sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg), row.taken_at)
    spot = forecast_spot(stored.mount, stored.heliostat, plane, motors, sun, day_of(row.taken_at))
    return {
        "spot": np.round(spot.point, 5).tolist(),
        "std_m": round(spot.std_m, 5),
        "target": plane.name,
        "on_target": plane.contains(spot.point),
    }
