"""Flux forecasts of one heliostat from stored surfaces."""

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
import torch
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.effects import acting, apply_image_effects, effects_of_stage
from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError, UnreachableError
from model.fleet import Superposition, tile_of
from model.frames import sun_direction
from model.images import FLUX_SUM
from model.plant import Receiver, TargetPlane
from model.setup import Setup
from model.surface import DEGREE, control_points
from model.times import format_minute
from model.tracing import Window
from service import store
from service.base.arrays import pack, to_json_value, unpack
from service.base.errors import ConflictError
from service.base.fields import Sun, SunAt
from service.store.tables import ForecastRow, HeliostatRow, SurfaceRow
from service.twin.forecasts.watts import light_watts
from service.twin.heliostats.measurements import (
    HeliostatContext,
    heights_of,
    load_heliostat_context,
)
from service.twin.heliostats.stored_mount import load_mount
from service.twin.plant.model_versions import ModelVersion, get_model
from service.twin.runtime.operations import Forecast
from service.twin.runtime.runtime import Runtime


@dataclass(frozen=True, eq=False)
class ForecastRequest:
    """A flux forecast to compute.

    Names are those of `POST /v1/forecasts`. ``receiver`` is the geometry to light. Without it
    ``target`` names a stored target or receiver. ``sun_at`` is the time that was requested, if any.
    ``aim_point_m`` (3,) is by default the receiver's `model.plant.Receiver.aim_of`.

    ``motor_position`` [steps] may replace ``aim_point_m``. It turns the mirror by its calibrated
    mount at ``sun_at``, by default as newly measured.

    ``surface`` is "current", "ideal" or a version. A heliostat without a current surface is
    forecast as an ideal mirror. ``window_m`` is the side of a square map about the centre of mass.
    By default the map is of the whole plane. ``model_version`` is a version of the plant's model,
    by default the current one.
    """

    heliostat: str
    sun: Sun
    sun_at: datetime | None = None
    target: str | None = None
    receiver: Receiver | None = None
    aim_point_m: tuple[float, float, float] | None = None
    motor_position: tuple[float, float] | None = None
    surface: str | int = "current"
    dni_w_m2: float = 1000.0
    resolution: tuple[int, int] = (256, 256)
    window_m: float | None = None
    normalised: bool = False
    model_version: int | None = None


def position_of(session: Session, sun: Sun | SunAt) -> Sun:
    """The sun's position over the plant.

    Raises
    ------
    InvalidInputError
        If it is night at that time.
    """
    if isinstance(sun, Sun):
        return sun
    azimuth, elevation = sun_angles_at(sun.at, store.get_plant(session).origin)
    if elevation <= 0:
        raise InvalidInputError(
            f"at: the sun is {-elevation:.1f}° below the horizon at {format_minute(sun.at)};"
            " choose a time of the day"
        )
    return Sun(azimuth_deg=azimuth, elevation_deg=elevation)


def _chosen_surface(
    session: Session, heliostat: HeliostatRow, choice: str | int
) -> SurfaceRow | None:
    if choice == "ideal":
        return None
    if isinstance(choice, int):
        return store.get_surface(session, heliostat, choice)
    return store.find_surface_at(session, heliostat)


def _receiver(session: Session, request: ForecastRequest) -> Receiver:
    if request.receiver is not None:
        return request.receiver
    if request.target is None:
        raise InvalidInputError("target: give a stored target or receiver, or a plane")
    receiver = store.get_target_or_receiver(session, request.target)
    if request.window_m is not None and not isinstance(receiver, TargetPlane):
        raise InvalidInputError(
            f"window_m: the map of {request.target}, which is no plane, is all of it; leave it out"
        )
    return receiver


@dataclass(frozen=True, eq=False)
class Traced:
    """A flux map with the stored inputs that it was computed from.

    ``surface`` is None for the ideal one.
    """

    heliostat: HeliostatRow
    surface: SurfaceRow | None
    receiver: Receiver
    model: ModelVersion
    forecast: "Forecast"


def trace_request(runtime: Runtime, request: ForecastRequest) -> Traced:
    """Compute a flux map.

    Raises
    ------
    NotFoundError, ConflictError
        If heliostat, target, model or surface version is not stored.
    UnreachableError
        If the drives cannot reach these motor positions, the heliostat cannot reflect the sun to
        the aim point, or light does not reach the plane's front.
    """
    with runtime.database.reading() as session:
        twin = load_heliostat_context(session, request.heliostat, request.model_version)
        receiver, surface = (
            _receiver(session, request),
            _chosen_surface(session, twin.row, request.surface),
        )
        if request.motor_position is not None:
            mount = load_mount(session, request.heliostat, request.sun_at, request.model_version)
            twin = replace(twin, heliostat=mount.turned(request.sun_at))
    points = control_points(twin.heliostat, heights_of(surface))
    request = replace(request, receiver=receiver)
    forecast = trace_flux(runtime, twin, points, request)
    return Traced(twin.row, surface, receiver, twin.model, forecast)


def receiver_as_json(receiver: Receiver) -> dict[str, object]:
    """A receiver's geometry [m], as stored with forecasts.

    A cylinder's width is the length of its arc, and that of panels is their sum.
    """
    outline = {
        name: to_json_value(getattr(receiver, name))
        for name in ("center", "normal", "up", "width", "height")
    }
    return outline | {"absorptance": receiver.absorptance} | receiver.shape


def _forecast_row(request: ForecastRequest, traced: Traced) -> ForecastRow:
    forecast = traced.forecast
    right, up = to_json_value(forecast.center_of_mass)  # null if no light comes near the plane
    name = traced.heliostat.name
    lacks_surface = traced.surface is None and request.surface != "ideal"
    return ForecastRow(
        heliostat_id=traced.heliostat.id,
        surface_id=None if traced.surface is None else traced.surface.id,
        target_name=request.target,
        plane=receiver_as_json(traced.receiver),
        sun_azimuth_deg=request.sun.azimuth_deg,
        sun_elevation_deg=request.sun.elevation_deg,
        sun_at=request.sun_at,
        aim_point_m=None if request.aim_point_m is None else list(request.aim_point_m),
        motor_position=None if request.motor_position is None else list(request.motor_position),
        dni_w_m2=request.dni_w_m2,
        window_m=request.window_m,
        normalised=request.normalised,
        rows=forecast.flux.shape[0],
        columns=forecast.flux.shape[1],
        peak_w_m2=float(forecast.peak),
        power_w=float(forecast.power),
        center_right_m=right,
        center_up_m=up,
        losses=dict(light_watts(forecast.losses, request.dni_w_m2)),
        model_version=traced.model.version,
        warnings=(
            [
                f"heliostat {name} has no surface: this is the forecast of its ideal mirror; "
                f"POST /v1/heliostats/{name}/surfaces predicts one"
            ]
            if lacks_surface
            else []
        ),
        flux=pack({"flux": np.asarray(forecast.flux, np.float32)}),
    )


def make_forecast(runtime: Runtime, request: ForecastRequest) -> ForecastRow:
    """Compute a flux map and store it; raises what `trace_request` raises."""
    row = _forecast_row(request, trace_request(runtime, request))
    with runtime.database.writing() as session:
        return store.add_forecast(session, row)


def trace_flux(
    runtime: Runtime,
    twin: HeliostatContext,
    points: NDArray[np.float64],
    request: ForecastRequest,
    degree: int = DEGREE,
) -> Forecast:
    """Trace a request's flux from a mirror with the control ``points`` (F, I, J, 3) [m].

    The request must have its receiver. ``twin`` replaces its heliostat and model.
    """
    receiver, angles = request.receiver, None
    assert receiver is not None
    aim = None if isinstance(receiver, TargetPlane) else receiver.aim_of(twin.heliostat.position)
    if request.motor_position is not None:
        twin.heliostat.mount.require_within(np.asarray(request.motor_position))
        angles = twin.heliostat.mount.angles_from_motors(request.motor_position)
    setup = Setup(
        twin.heliostat,
        points,
        sun_direction(request.sun.azimuth_deg, request.sun.elevation_deg),
        receiver.middle,
        angles=angles,
        aim=aim if request.aim_point_m is None else np.asarray(request.aim_point_m),
        degree=degree,
        identifier=twin.heliostat.name,
        taken_at=request.sun_at,
    )
    twin = replace(twin, model=twin.model.with_dni(request.dni_w_m2))
    if not isinstance(receiver, TargetPlane):
        return _trace_unrolled(runtime, twin, setup, request, receiver)
    with runtime.computing("forecast") as operations:
        return operations.forecast(setup, twin.model, request.resolution, request.window_m)


def _trace_unrolled(
    runtime: Runtime,
    twin: HeliostatContext,
    setup: Setup,
    request: ForecastRequest,
    receiver: Receiver,
) -> Forecast:
    """Trace the flux on a curved receiver, by its unrolled map.

    The heliostat is traced as a field of one. No camera looks at a curved receiver.
    """
    effects = acting(twin.model.effects, request.sun_at, twin.heliostat.name)
    task = Superposition(receiver, replace(twin.model, effects=effects), request.resolution)
    with runtime.computing("forecast") as operations:
        total = operations.superpose(task, [tile_of([setup])])
    if total.skipped:
        raise UnreachableError(total.skipped[twin.heliostat.name])
    flux = total.irradiance.astype(np.float32)
    pixel_m2 = receiver.width * receiver.height / flux.size
    return Forecast(
        flux=flux,
        center_of_mass=_center(total.irradiance, receiver),
        peak=float(flux.max()),
        power=float(total.irradiance.sum() * pixel_m2),
        losses=total.losses[twin.heliostat.name],
        camera_view=flux,
        model_version=twin.model.version,
    )


def _center(flux: NDArray[np.float64], receiver: Receiver) -> NDArray[np.float64]:
    """Centre of mass (2,) [m] of a map (rows, columns), relative to its middle.

    The values are right and up, and NaN without any light.
    """
    rows, columns = ((np.arange(count) + 0.5) / count - 0.5 for count in flux.shape)
    total = flux.sum()
    if total <= 0:
        return np.full(2, np.nan)
    right = flux.sum(axis=0) @ columns * receiver.width
    up = -flux.sum(axis=1) @ rows * receiver.height
    return np.array([right / total, up / total])


def camera_view(session: Session, row: ForecastRow) -> NDArray[np.float32]:
    """The camera image (rows, columns) of a forecast, by the model that computed it.

    Raises
    ------
    ConflictError
        If the forecast is not for a stored target; cameras look only at these.
    """
    if row.target_name is None or store.find_target(session, row.target_name) is None:
        raise ConflictError(
            "view: a camera looks at stored targets; of any other surface there is only the light"
        )
    light = torch.as_tensor(unpack(row.flux)["flux"])
    size = row.window_m or row.plane["width"], row.window_m or row.plane["height"]
    effects = effects_of_stage(
        get_model(session, int(row.model_version.partition(":")[0])).effects, "image"
    )
    with torch.no_grad():
        shown = apply_image_effects(
            acting(effects, row.sun_at, None), light[None], Window(*size, *light.shape)
        )[0]
        return shown.clamp(min=0).numpy()


def flux_of(row: ForecastRow, flux: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """The map, or ``flux`` instead, in the requested unit."""
    flux = unpack(row.flux)["flux"] if flux is None else flux
    total = float(flux.sum(dtype=np.float64))
    return flux * np.float32(FLUX_SUM / total) if row.normalised and total > 0 else flux
