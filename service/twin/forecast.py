"""Flux forecasts of one heliostat from stored surfaces."""

from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.effects import acting
from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError
from model.forecast import images_under, of_stage
from model.frames import sun_direction
from model.images import FLUX_SUM
from model.plant import Receiver, TargetPlane
from model.tracing import Window
from service import store
from service.base.arrays import pack, plain, unpack
from service.base.faults import ConflictError, NotFoundError
from service.base.fields import Sun, SunAt
from service.store.tables import ForecastRow, HeliostatRow, SurfaceRow
from service.twin.compute import Forecast
from service.twin.evidence import Twin, heights_of, load_twin
from service.twin.mounted import load_mount
from service.twin.runtime import Runtime
from service.twin.versions import PlantModel, get_model


@dataclass(frozen=True, eq=False)
class ForecastRequest:
    """What to forecast; ``target`` names a stored plane, else ``plane`` is one.

    ``sun_azimuth_deg`` counts from south, positive to the east; ``sun_at`` is the time that was asked for, if one was.
    ``aim`` (3,) [m] is by default the plane's centre; ``motors`` [steps] in its place turn the mirror by its calibrated
    mount as it was at ``sun_at``, by default as newly measured, wherever that sends the light. ``surface``: "current",
    "ideal" or a version. ``window`` [m]: the side of a square about the centre of mass that is mapped; the whole plane
    without it. ``model_version`` is the plant's model, by default the current one.
    """

    heliostat: str
    sun_azimuth_deg: float
    sun_elevation_deg: float
    sun_at: datetime | None = None
    target: str | None = None
    plane: TargetPlane | None = None
    aim: tuple[float, float, float] | None = None
    motors: tuple[float, float] | None = None
    surface: str | int = "current"
    dni: float = 1000.0
    resolution: tuple[int, int] = (256, 256)
    window: float | None = None
    normalised: bool = False
    model_version: int | None = None


def position_of(session: Session, sun: Sun | SunAt) -> Sun:
    """Where the sun stands over the plant.

    Raises
    ------
    InvalidInputError
        Where it is night there at that time.
    """
    if isinstance(sun, Sun):
        return sun
    latitude, longitude, _ = store.get_plant(session).origin
    azimuth, elevation = sun_angles_at(sun.at, latitude, longitude)
    if elevation <= 0:
        raise InvalidInputError(
            f"at: the sun is {-elevation:.1f}° below the horizon on {sun.at:%Y-%m-%d at %H:%M} UTC; "
            "choose a time of the day"
        )
    return Sun(azimuth_deg=azimuth, elevation_deg=elevation)


def _chosen_surface(session: Session, heliostat: HeliostatRow, choice: str | int) -> SurfaceRow | None:
    if choice == "ideal":
        return None
    if isinstance(choice, int):
        return store.get_surface(session, heliostat, choice)
    try:
        return store.get_surface_at(session, heliostat)
    except NotFoundError as error:
        raise ConflictError(f'surface: {error}, or ask for "ideal"') from error


def _plane(session: Session, request: ForecastRequest) -> TargetPlane:
    if request.plane is not None:
        return request.plane
    if request.target is None:
        raise InvalidInputError("target: give a stored target or a plane")
    if store.find_receiver(session, request.target) is not None:
        raise ConflictError(
            f"target: {request.target} is a cylinder; leave heliostat out and give heliostats: [{request.heliostat!r}]"
        )
    return store.target_plane(store.get_target(session, request.target))


@dataclass(frozen=True, eq=False)
class Traced:
    """A flux map with the stored things that it was made from; ``surface`` is None for the ideal one."""

    heliostat: HeliostatRow
    surface: SurfaceRow | None
    plane: TargetPlane
    model: PlantModel
    forecast: "Forecast"


def trace_request(runtime: Runtime, request: ForecastRequest) -> Traced:
    """Compute a flux map.

    Raises
    ------
    NotFoundError, ConflictError
        Where heliostat, target, model or surface version is not stored, or no surface is current.
    UnreachableError
        Where its drives cannot stand at these motor positions, or the heliostat cannot reflect the sun to the aim
        point, or light does not reach the plane's lit side.
    """
    with runtime.database.reading() as session:
        twin = load_twin(session, request.heliostat, request.model_version)
        plane, surface = _plane(session, request), _chosen_surface(session, twin.row, request.surface)
        if request.motors is not None:
            mount = load_mount(session, request.heliostat, request.sun_at, request.model_version)
            twin = replace(twin, heliostat=mount.turned(request.sun_at))
    return Traced(twin.row, surface, plane, twin.model, _trace(runtime, twin, heights_of(surface), request, plane))


def receiver_as_json(receiver: Receiver) -> dict[str, Any]:
    """A receiver's geometry, as forecasts keep it [m]; a cylinder's width is the length of its arc."""
    outline = {name: plain(getattr(receiver, name)) for name in ("center", "normal", "up", "width", "height")}
    return outline | receiver.shape


def _forecast_row(request: ForecastRequest, traced: Traced) -> ForecastRow:
    forecast = traced.forecast
    right, up = plain(forecast.center_of_mass)  # null where no light comes near the plane
    return ForecastRow(
        heliostat_id=traced.heliostat.id,
        surface_id=None if traced.surface is None else traced.surface.id,
        target_name=request.target,
        plane=receiver_as_json(traced.plane),
        sun_azimuth_deg=request.sun_azimuth_deg,
        sun_elevation_deg=request.sun_elevation_deg,
        sun_at=request.sun_at,
        aim_point_m=None if request.aim is None else list(request.aim),
        motor_position=None if request.motors is None else list(request.motors),
        dni_w_m2=request.dni,
        window_m=request.window,
        normalised=request.normalised,
        rows=forecast.flux.shape[0],
        columns=forecast.flux.shape[1],
        peak_w_m2=float(forecast.peak),
        power_w=float(forecast.power),
        center_right_m=right,
        center_up_m=up,
        model_version=traced.model.version,
        flux=pack({"flux": np.asarray(forecast.flux, np.float32)}),
    )


def make_forecast(runtime: Runtime, request: ForecastRequest) -> ForecastRow:
    """Compute a flux map and keep it; raises what `trace_request` raises."""
    row = _forecast_row(request, trace_request(runtime, request))
    with runtime.database.writing() as session:
        return store.add_forecast(session, row)


def _trace(
    runtime: Runtime, twin: Twin, z: NDArray[Any] | None, request: ForecastRequest, plane: TargetPlane
) -> Forecast:
    model, angles = twin.model, None
    if request.motors is not None:
        twin.heliostat.mount.require_within(np.asarray(request.motors))
        angles = twin.heliostat.mount.angles_from_motors(request.motors)
    with runtime.computing("forecast") as operations:
        return operations.forecast(
            twin.heliostat,
            z,
            sun_direction(request.sun_azimuth_deg, request.sun_elevation_deg),
            plane,
            aim=None if request.aim is None else np.array(request.aim),
            angles=angles,
            resolution=request.resolution,
            window=request.window,
            optics=replace(model.optics, dni=request.dni),
            effects=model.effects,
            latitude_deg=twin.origin[0],
            taken_at=request.sun_at,
        )


def camera_view(session: Session, row: ForecastRow) -> NDArray[np.float32]:
    """What the camera would show of a forecast's light (rows, columns), by the model that it was made with.

    Raises
    ------
    ConflictError
        Where the light falls on no stored target, which a camera looks at.
    """
    if row.target_name is None:
        raise ConflictError("view: a camera looks at stored targets; of any other plane there is only the light")
    light = torch.as_tensor(unpack(row.flux)["flux"])
    size = row.window_m or row.plane["width"], row.window_m or row.plane["height"]
    effects = of_stage(get_model(session, int(row.model_version.partition(":")[0])).effects, "image")
    with torch.no_grad():
        shown = images_under(acting(effects, row.sun_at, None), light[None], Window(*size, *light.shape))[0]
        return shown.clamp(min=0).numpy()


def flux_of(row: ForecastRow, flux: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """The map, or ``flux`` in its place, in the unit that was asked for."""
    flux = unpack(row.flux)["flux"] if flux is None else flux
    total = float(flux.sum(dtype=np.float64))
    return flux * np.float32(FLUX_SUM / total) if row.normalised and total > 0 else flux
