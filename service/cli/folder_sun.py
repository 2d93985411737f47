"""Forecasts of a folder's heliostats for a sun and a plane of one's own: ``heliotwin forecast`` without photographs."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from model.effects import Effect, effect_to_json, model_version
from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError, ModelError
from model.frames import sun_direction
from model.plant import TargetPlane
from service.base.fields import Plane, Sun, moment_of
from service.base.progress import Progress, quiet
from service.base.wording import told
from service.cli.folder import check_surfaces, finish, surface_of
from service.sources.documents import optics_to_json, read_json
from service.sources.folder import MeasurementFolder
from service.twin import compute


@dataclass(frozen=True, eq=False)
class Asked:
    """A sun, by its position or the time ``at`` which it stands there, and the plane that the light falls on."""

    sun: Sun
    plane: TargetPlane
    at: datetime | None = None


def asked(
    folder: MeasurementFolder,
    sun: tuple[float, float] | None,
    at: datetime | None,
    target: str | None,
    plane: Path | None,
) -> Asked:
    """What the options say: one of ``sun`` (azimuth from south, elevation) [deg] and ``at``, one of target and plane.

    Raises
    ------
    InvalidInputError
        Where they say nothing, or two things, or it is night at that time, or that is before 1970.
    """
    if (sun is None) == (at is None):
        raise InvalidInputError("--sun, --at: give one of them, a position or a time")
    if (target is None) == (plane is None):
        raise InvalidInputError("--target, --plane: give one of them, a target of the folder or a file")
    try:
        at = None if at is None else moment_of(at)
    except ValueError as error:
        raise InvalidInputError(f"--at: {error}") from None
    return Asked(_sun(folder, sun, at), _plane(folder, target, plane), at)


def _sun(folder: MeasurementFolder, sun: tuple[float, float] | None, at: datetime | None) -> Sun:
    if at is not None:
        sun = sun_angles_at(at, float(folder.plant.origin[0]), float(folder.plant.origin[1]))
        if sun[1] <= 0:
            raise InvalidInputError(f"--at: the sun is {-sun[1]:.1f} degrees below the horizon then; choose the day")
    assert sun is not None
    try:
        return Sun(azimuth_deg=sun[0], elevation_deg=sun[1])
    except ValidationError as error:
        raise InvalidInputError(f"--sun: {told(error)}") from None


def _plane(folder: MeasurementFolder, target: str | None, plane: Path | None) -> TargetPlane:
    if plane is not None:
        try:
            return Plane.model_validate(read_json(plane)).named("plane")
        except ValidationError as error:
            raise InvalidInputError(f"{plane}: {told(error)}") from None
    if target not in folder.plant.targets:
        raise InvalidInputError(f"--target: there is no target {target}; known: {', '.join(folder.plant.targets)}")
    return folder.plant.targets[target]


def forecast_for(
    folder: MeasurementFolder,
    out: Path,
    wanted: Asked,
    surfaces: str = "measured",
    effects: Sequence[Effect] = (),
    heliostats: Sequence[str] = (),
    progress: Progress = quiet,
) -> dict[str, Any]:
    """The light of each heliostat, or of some, on a plane; ``OUT/H/forecast.npz`` and ``OUT/forecast.json``."""
    check_surfaces(surfaces)
    unknown = [name for name in heliostats if name not in folder.plant.heliostats]
    if unknown:
        raise InvalidInputError(f"--heliostat: there is no heliostat {', '.join(unknown)} in {folder.root}")
    report: dict[str, Any] = {
        "surfaces": surfaces,
        "sun": wanted.sun.model_dump(),
        "at": None if wanted.at is None else wanted.at.isoformat(),
        "target": wanted.plane.name,
        "model_version": model_version([*folder.effects, *effects]),
        "effects": [effect_to_json(effect) for effect in (*folder.effects, *effects)],
        "optics": {"dni_w_m2": folder.optics.dni, **optics_to_json(folder.optics)},
        "heliostats": {},
        "skipped": {},
    }
    for name in heliostats or folder.plant.heliostats:
        progress(name)
        try:
            report["heliostats"][name] = _entry(folder, out, wanted, surfaces, effects, name)
        except ModelError as error:
            report["skipped"][name] = str(error)
    return finish(folder, report, out / "forecast.json", "heliostats")


def _entry(
    folder: MeasurementFolder, out: Path, wanted: Asked, surfaces: str, effects: Sequence[Effect], name: str
) -> dict[str, Any]:
    """Write a heliostat's forecast and give back its entry in ``forecast.json``."""
    heliostat = folder.plant.heliostats[name]
    traced = compute.forecast(
        heliostat,
        None,
        sun_direction(wanted.sun.azimuth_deg, wanted.sun.elevation_deg),
        wanted.plane,
        optics=folder.optics,
        surface=surface_of(folder, heliostat, surfaces),
        effects=[*folder.effects, *effects],
        latitude_deg=float(folder.plant.origin[0]),
        taken_at=wanted.at,
    )
    path = out / name / "forecast.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, flux=traced.flux, camera_view=traced.camera_view)
    return {"peak_w_m2": traced.peak, "power_w": traced.power, "center_of_mass_m": traced.center_of_mass.tolist()}
