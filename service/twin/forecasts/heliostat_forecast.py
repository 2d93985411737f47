"""Flux forecasts of one heliostat from stored surfaces."""

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
import torch
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.effects import acting, apply_image_effects, effects_of_stage
from model.errors import InvalidInputError, UnreachableError
from model.fleet import Superposition, tile_of
from model.frames import sun_direction
from model.images import FLUX_SUM
from model.plant import Heliostat, Receiver, TargetPlane
from model.setup import Setup
from model.surface import DEGREE, control_points
from model.tracing import Window
from service import store
from service.base.arrays import pack, to_json_value, unpack
from service.base.errors import ConflictError
from service.base.fields import Sun
from service.store.tables import ForecastRow, HeliostatRow, SurfaceRow
from service.twin.forecasts.mirror_states import AS_DECLARED, MirrorStates, in_state
from service.twin.forecasts.requests import ForecastIn, position_of
from service.twin.forecasts.watts import dni_of, light_watts
from service.twin.measurements import heights_of, load_heliostat_context
from service.twin.model_versions import ModelVersion, get_model
from service.twin.operations import Forecast
from service.twin.runtime import Runtime
from service.twin.stored_mount import load_mount


def _chosen_surface(
    session: Session, heliostat: HeliostatRow, choice: str | int
) -> SurfaceRow | None:
    if choice == "ideal":
        return None
    if isinstance(choice, int):
        return store.get_surface(session, heliostat, choice)
    return store.find_surface_at(session, heliostat)


def _receiver(session: Session, request: ForecastIn) -> Receiver:
    receiver = request.on(session)
    if request.window_m is not None and not isinstance(receiver, TargetPlane):
        raise InvalidInputError(
            f"window_m: the map of {request.target}, which is no plane, is all of it; leave it out"
        )
    return receiver


@dataclass(frozen=True, eq=False)
class Traced:
    """A flux map with the stored inputs that it was computed from.

    ``surface`` is None for the ideal one. ``model`` has the irradiance of the request.
    """

    heliostat: HeliostatRow
    surface: SurfaceRow | None
    receiver: Receiver
    model: ModelVersion
    sun: Sun
    forecast: "Forecast"


def trace_request(
    runtime: Runtime, request: ForecastIn, states: MirrorStates = AS_DECLARED
) -> Traced:
    """Compute a flux map of a mirror in its measured state.

    Raises
    ------
    InvalidInputError
        If it is night at the time of the request.
    NotFoundError, ConflictError
        If heliostat, target, model or surface version is not stored.
    UnreachableError
        If the drives cannot reach these motor positions, the heliostat cannot reflect the sun to
        the aim point, or light does not reach the plane's front.
    """
    with runtime.database.reading() as session:
        sun = position_of(session, request.sun)
        twin = load_heliostat_context(session, request.heliostat, request.model_version)
        receiver, surface = (
            _receiver(session, request),
            _chosen_surface(session, twin.row, request.surface),
        )
        if request.motor_position is not None:
            mount = load_mount(session, request.heliostat, request.at, request.model_version)
            twin = replace(twin, heliostat=mount.turned(request.at))
    mirror = in_state(twin.heliostat, states.of(twin.heliostat))
    points = control_points(mirror, heights_of(surface))
    setup = _as_asked(aimed_setup(mirror, points, sun, request.at, receiver), request)
    dni = dni_of(request.dni_w_m2, sun.elevation_deg, twin.model.site.altitude_m)
    model = twin.model.with_dni(dni)
    forecast = trace_flux(runtime, setup, model, receiver, request.resolution, request.window_m)
    return Traced(twin.row, surface, receiver, model, sun, forecast)


def _as_asked(setup: Setup, request: ForecastIn) -> Setup:
    """The setup with the aim or the motor positions of a request, if it has them."""
    if request.aim_point_m is not None:
        return replace(setup, aim=np.asarray(request.aim_point_m))
    if request.motor_position is None:
        return setup
    mount = setup.heliostat.mount
    mount.require_within(np.asarray(request.motor_position))
    return replace(setup, angles=mount.angles_from_motors(request.motor_position))


def receiver_as_json(receiver: Receiver) -> dict[str, object]:
    """A receiver's geometry [m], as stored with forecasts.

    A cylinder's width is the length of its arc, and that of panels is their sum.
    """
    outline = {
        name: to_json_value(getattr(receiver, name))
        for name in ("center", "normal", "up", "width", "height")
    }
    return outline | {"absorptance": receiver.absorptance} | receiver.shape


def _forecast_row(request: ForecastIn, traced: Traced, states: MirrorStates) -> ForecastRow:
    forecast, dni = traced.forecast, traced.model.optics.dni
    center = to_json_value(forecast.center_of_mass)  # null if no light comes near the plane
    name = traced.heliostat.name
    warnings = states.in_words(name)
    if traced.surface is None and request.surface != "ideal":
        warnings.insert(
            0,
            f"heliostat {name} has no surface: this is the forecast of its ideal mirror; "
            f"POST /v1/heliostats/{name}/surfaces predicts one",
        )
    document = {
        **request.model_dump(
            mode="json", include={"aim_point_m", "motor_position", "window_m", "normalised"}
        ),
        "at": None if request.at is None else request.at.isoformat(),
        "sun": traced.sun.model_dump(),
        "dni_w_m2": dni,
        "plane": receiver_as_json(traced.receiver),
        "resolution": list(forecast.flux.shape),
        "unit": "1" if request.normalised else "W/m2",
        "peak_w_m2": float(forecast.peak),
        "power_w": float(forecast.power),
        "center_of_mass_m": None if None in center else center,
        "losses": light_watts(forecast.losses, dni),
        "model_version": traced.model.version,
        "warnings": warnings,
    }
    return ForecastRow(
        heliostat_id=traced.heliostat.id,
        surface_id=None if traced.surface is None else traced.surface.id,
        target_name=request.target,
        document=document,
        flux=pack({"flux": np.asarray(forecast.flux, np.float32)}),
    )


def make_forecast(
    runtime: Runtime, request: ForecastIn, states: MirrorStates = AS_DECLARED
) -> ForecastRow:
    """Compute a flux map and store it; raises what `trace_request` raises."""
    row = _forecast_row(request, trace_request(runtime, request, states), states)
    with runtime.database.writing() as session:
        return store.add_forecast(session, row)


def aimed_setup(
    heliostat: Heliostat,
    points: NDArray[np.float64],
    sun: Sun,
    at: datetime | None,
    receiver: Receiver,
    degree: int = DEGREE,
) -> Setup:
    """A mirror with the control ``points`` (F, I, J, 3) [m] that aims at a receiver's default.

    ``at`` is the time of the sun's position, if it is known.
    """
    return Setup(
        heliostat,
        points,
        sun_direction(sun.azimuth_deg, sun.elevation_deg),
        receiver.middle,
        aim=None if isinstance(receiver, TargetPlane) else receiver.aim_of(heliostat.position),
        degree=degree,
        identifier=heliostat.name,
        taken_at=at,
    )


def trace_flux(
    runtime: Runtime,
    setup: Setup,
    model: ModelVersion,
    receiver: Receiver,
    resolution: tuple[int, int] = (256, 256),
    window_m: float | None = None,
) -> Forecast:
    """Trace the flux of a setup on a receiver.

    ``window_m`` is the side of a square map about the centre of mass; by default the map is of the
    whole plane.
    """
    if not isinstance(receiver, TargetPlane):
        return _trace_unrolled(runtime, setup, model, receiver, resolution)
    with runtime.computing("forecast") as operations:
        return operations.forecast(setup, model, resolution, window_m)


def _trace_unrolled(
    runtime: Runtime,
    setup: Setup,
    model: ModelVersion,
    receiver: Receiver,
    resolution: tuple[int, int],
) -> Forecast:
    """Trace the flux on a curved receiver, by its unrolled map.

    The heliostat is traced as a field of one. No camera looks at a curved receiver.
    """
    name = setup.heliostat.name
    effects = acting(model.effects, setup.taken_at, name)
    task = Superposition(receiver, replace(model, effects=effects), resolution)
    with runtime.computing("forecast") as operations:
        total = operations.superpose(task, [tile_of([setup])])
    if total.skipped:
        raise UnreachableError(total.skipped[name])
    flux = total.irradiance.astype(np.float32)
    pixel_m2 = receiver.width * receiver.height / flux.size
    return Forecast(
        flux=flux,
        center_of_mass=_center(total.irradiance, receiver),
        peak=float(flux.max()),
        power=float(total.irradiance.sum() * pixel_m2),
        losses=total.losses[name],
        camera_view=flux,
        model_version=model.version,
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
    target = None if row.target_name is None else store.find_target(session, row.target_name)
    if target is None:
        raise ConflictError(
            "view: a camera looks at stored targets; of any other surface there is only the light"
        )
    light = torch.as_tensor(unpack(row.flux)["flux"])
    about, at = row.document, row.document["at"]
    taken_at = None if at is None else datetime.fromisoformat(at)
    window = replace(Window(*size_of(row), *light.shape), on_spot=about["window_m"] is not None)
    model = get_model(session, int(about["model_version"].partition(":")[0]))
    effects = acting(effects_of_stage(model.effects, "image"), taken_at, None)
    sun, aim = Sun.model_validate(about["sun"]), about["aim_point_m"]
    setup = Setup(
        load_heliostat_context(session, row.heliostat.name).heliostat,
        np.empty((0, 0, 0, 3)),  # the mirror's shape is in the light
        sun_direction(sun.azimuth_deg, sun.elevation_deg),
        store.target_plane(target),
        aim=None if aim is None else np.asarray(aim),
        taken_at=taken_at,
    )
    with torch.no_grad():
        shown = apply_image_effects(effects, light[None], window, [setup], model.site)[0]
        return shown.clamp(min=0).numpy()


def size_of(row: ForecastRow) -> tuple[float, float]:
    """Width and height [m] of what the map of a forecast shows."""
    window, plane = row.document["window_m"], row.document["plane"]
    return window or plane["width"], window or plane["height"]


def flux_of(row: ForecastRow, flux: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """The map, or ``flux`` instead, in the requested unit."""
    flux = unpack(row.flux)["flux"] if flux is None else flux
    total = float(flux.sum(dtype=np.float64))
    return flux * np.float32(FLUX_SUM / total) if row.document["normalised"] and total > 0 else flux
