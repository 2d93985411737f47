"""``heliotwin forecast`` without photographs: a folder's heliostats for a given sun and target."""

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from heliotwin.arguments import moment_of
from heliotwin.folder import add_ideal_surfaces, finish, forecast_report, surfaces_of
from heliotwin.folder_store import ForecastTarget, open_folder
from model.effects import Effect
from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError, ModelError
from model.plant import Receiver, TargetPlane
from model.times import format_time
from service.base.fields import Plane, Sun
from service.base.progress import Progress, no_progress
from service.base.validation import format_validation_error
from service.sources.documents import read_json
from service.sources.folder import MeasurementFolder
from service.twin import operations


def asked(
    folder: MeasurementFolder,
    sun: tuple[float, float] | None,
    at: datetime | None,
    target: str | None,
    plane: Path | None,
    heliostats: Sequence[str],
) -> ForecastTarget:
    """Parse the options: either ``sun`` (azimuth from north, elevation) [deg] or ``at``; target or
    plane.

    Raises
    ------
    InvalidInputError
        If none or both of a pair are given, if the sun is below the horizon at that time, or if the
        time is before 1970.
    """
    if (sun is None) == (at is None):
        raise InvalidInputError("--sun, --at: give one of them, a position or a time")
    if (target is None) == (plane is None):
        raise InvalidInputError(
            "--target, --plane: give one of them, a target or receiver of the folder or a file"
        )
    at = moment_of(at)
    unknown = [name for name in heliostats if name not in folder.plant.heliostats]
    if unknown:
        raise InvalidInputError(
            f"--heliostat: there is no heliostat {', '.join(unknown)} in {folder.root}"
        )
    return ForecastTarget(_sun(folder, sun, at), _receiver(folder, target, plane), at, heliostats)


def _sun(folder: MeasurementFolder, sun: tuple[float, float] | None, at: datetime | None) -> Sun:
    if at is not None:
        sun = sun_angles_at(at, folder.plant.origin)
        if sun[1] <= 0:
            raise InvalidInputError(
                f"--at: the sun is {-sun[1]:.1f} degrees below the horizon then; choose the day"
            )
    assert sun is not None
    try:
        return Sun(azimuth_deg=sun[0], elevation_deg=sun[1])
    except ValidationError as error:
        raise InvalidInputError(f"--sun: {format_validation_error(error)}") from None


def _receiver(folder: MeasurementFolder, target: str | None, plane: Path | None) -> Receiver:
    if plane is not None:
        try:
            return Plane.model_validate(read_json(plane)).named("plane")
        except ValidationError as error:
            raise InvalidInputError(f"{plane}: {format_validation_error(error)}") from None
    known: dict[str, Receiver] = {**folder.plant.targets, **folder.plant.receivers}
    if target is None or target not in known:
        raise InvalidInputError(f"--target: there is no target {target}; known: {', '.join(known)}")
    return known[target]


def forecast_for(
    folder: MeasurementFolder,
    out: Path,
    wanted: ForecastTarget,
    surfaces: str = "measured",
    effects: Sequence[Effect] = (),
    progress: Progress = no_progress,
    mounts: Path | None = None,
) -> dict[str, Any]:
    """Forecast the flux of each heliostat on a plane or receiver.

    The files are ``OUT/H/forecast.npz`` and ``OUT/forecast.json``. The map of a cylinder is
    unrolled, as in `model.plant.Cylinder`. A cylinder has no camera view. ``mounts`` is a file of
    `heliotwin calibrate`.
    """
    report = forecast_report(
        folder,
        surfaces,
        effects,
        sun=wanted.sun.model_dump(),
        at=None if wanted.at is None else format_time(wanted.at),
        target=wanted.receiver.name,
        heliostats={},
    )
    without_surface: set[str] = set()
    with open_folder(folder, None, effects, mounts) as opened:
        for heliostat, surface in surfaces_of(folder, surfaces, report["skipped"], without_surface):
            name = heliostat.name
            if wanted.heliostats and name not in wanted.heliostats:
                continue
            progress(name)
            try:
                traced = opened.trace(name, surface, wanted)
            except ModelError as error:
                report["skipped"][name] = str(error)
            else:
                report["heliostats"][name] = _entry(out / name, wanted.receiver, traced)
    add_ideal_surfaces(report, without_surface, report["heliostats"])
    return finish(folder, report, out / "forecast.json", "heliostats")


def _entry(out: Path, receiver: Receiver, traced: operations.Forecast) -> dict[str, object]:
    """Write a heliostat's forecast and return its entry in ``forecast.json``."""
    maps, center = {"flux": traced.flux}, None
    if isinstance(receiver, TargetPlane):
        maps["camera_view"] = traced.camera_view
        center = traced.center_of_mass.tolist()
    out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(out / "forecast.npz", **maps)  # type: ignore[arg-type]
    return {"peak_w_m2": traced.peak, "power_w": traced.power, "center_of_mass_m": center}
