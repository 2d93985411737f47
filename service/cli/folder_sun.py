"""Forecasts of a folder's heliostats for a sun and a place of one's own: ``heliotwin forecast`` without photographs."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from model.effects import Effect, acting, effect_to_json, model_version
from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError, ModelError, UnreachableError
from model.fleet import FleetFlux, tile_of
from model.forecast import Setup
from model.frames import sun_direction
from model.plant import Heliostat, Receiver, TargetPlane
from model.surface import DEGREE, control_points
from service.base.fields import Plane, Sun, moment_of
from service.base.progress import Progress, quiet
from service.base.wording import told
from service.cli.folder import check_surfaces, finish, surface_of
from service.sources.documents import optics_to_json, read_json
from service.sources.folder import MeasurementFolder
from service.twin import compute


@dataclass(frozen=True, eq=False)
class Asked:
    """A sun, by its position or the time ``at`` which it stands there, and what the light falls on."""

    sun: Sun
    receiver: Receiver
    at: datetime | None = None

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector (3,) towards the sun."""
        return sun_direction(self.sun.azimuth_deg, self.sun.elevation_deg)


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
        raise InvalidInputError("--target, --plane: give one of them, a target or receiver of the folder or a file")
    try:
        at = None if at is None else moment_of(at)
    except ValueError as error:
        raise InvalidInputError(f"--at: {error}") from None
    return Asked(_sun(folder, sun, at), _receiver(folder, target, plane), at)


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


def _receiver(folder: MeasurementFolder, target: str | None, plane: Path | None) -> Receiver:
    if plane is not None:
        try:
            return Plane.model_validate(read_json(plane)).named("plane")
        except ValidationError as error:
            raise InvalidInputError(f"{plane}: {told(error)}") from None
    known: dict[str, Receiver] = {**folder.plant.targets, **folder.plant.receivers}
    if target is None or target not in known:
        raise InvalidInputError(f"--target: there is no target {target}; known: {', '.join(known)}")
    return known[target]


def forecast_for(
    folder: MeasurementFolder,
    out: Path,
    wanted: Asked,
    surfaces: str = "measured",
    effects: Sequence[Effect] = (),
    heliostats: Sequence[str] = (),
    progress: Progress = quiet,
) -> dict[str, Any]:
    """The light of each heliostat, or of some, on a plane or receiver: ``OUT/H/forecast.npz``, ``OUT/forecast.json``.

    A cylinder's map is unrolled, as `model.plant.Cylinder` has it; no camera looks at it, so there is no view of one.
    """
    check_surfaces(surfaces)
    unknown = [name for name in heliostats if name not in folder.plant.heliostats]
    if unknown:
        raise InvalidInputError(f"--heliostat: there is no heliostat {', '.join(unknown)} in {folder.root}")
    report: dict[str, Any] = {
        "surfaces": surfaces,
        "sun": wanted.sun.model_dump(),
        "at": None if wanted.at is None else wanted.at.isoformat(),
        "target": wanted.receiver.name,
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
    surface, believed = surface_of(folder, heliostat, surfaces), [*folder.effects, *effects]
    if isinstance(wanted.receiver, TargetPlane):
        traced = compute.forecast(
            heliostat,
            None,
            wanted.direction,
            wanted.receiver,
            optics=folder.optics,
            surface=surface,
            effects=believed,
            latitude_deg=float(folder.plant.origin[0]),
            taken_at=wanted.at,
        )
        maps, power = {"flux": traced.flux, "camera_view": traced.camera_view}, traced.power
        center = traced.center_of_mass.tolist()
    else:
        made = _on_receiver(folder, wanted, heliostat, surface, believed)
        maps, power, center = {"flux": made.irradiance.astype(np.float32)}, made.power, None
    path = out / name / "forecast.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **maps)  # type: ignore[arg-type]
    return {"peak_w_m2": float(maps["flux"].max()), "power_w": power, "center_of_mass_m": center}


def _on_receiver(
    folder: MeasurementFolder,
    wanted: Asked,
    heliostat: Heliostat,
    surface: tuple[NDArray[np.float64], int] | None,
    effects: Sequence[Effect],
) -> FleetFlux:
    """A heliostat's light on what is no plane, aimed at its middle; a fleet of one."""
    points, degree = (control_points(heliostat, None), DEGREE) if surface is None else surface
    receiver = wanted.receiver
    shot = Setup(heliostat, points, wanted.direction, receiver.middle, aim=receiver.center, degree=degree)
    made = compute.superpose(
        receiver,
        [tile_of([shot])],
        optics=folder.optics,
        effects=acting(effects, wanted.at, heliostat.name),
        latitude_deg=float(folder.plant.origin[0]),
    )
    if made.skipped:
        raise UnreachableError(made.skipped[heliostat.name])
    return made
