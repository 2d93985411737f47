"""The three things the service is for, as plain functions: measure a photograph, predict a surface, forecast a flux.

Each reads what it needs, computes outside any transaction, and writes at the end; routes and the command line share
them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from model.errors import ImageRefusedError, InvalidInputError
from model.frames import sun_direction, wgs84_to_enu
from model.plant import Heliostat, Receiver, TargetPlane
from service import audit, models, store
from service.arrays import pack, unpack
from service.faults import ConflictError, NotFoundError, TooLargeError
from service.images import digest, media_type
from service.keys import RESERVED
from service.meters import PHOTOGRAPHS, REFUSALS
from service.models import PlantModel
from service.runtime import Operations, Runtime
from service.store import NewImage, NewMeasurement, NewSurface
from service.tables import ForecastRow, HeliostatRow, MeasurementRow, SurfaceRow, now

if TYPE_CHECKING:  # see `service.runtime`
    from model.imaging import ImageKind
    from model.observation import Observation, SurfacePrediction
    from service.operations import Forecast, Method

# The newest measurements, this many times as many as are wanted, stand for the mirror's present state; those that
# are used are chosen among them for variety of the sun's position.
_RECENT = 4

# How far a camera's clock may be ahead of ours.
_AHEAD = timedelta(days=1)


def load_heliostat(session: Session, row: HeliostatRow) -> Heliostat:
    """The model's heliostat of a stored one."""
    from service.paint import read_heliostat

    return read_heliostat(row.name, row.properties, np.array(store.get_plant(session).origin))


# --- a photograph -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Photograph:
    """What is known of an image that comes in; units as in `service.tables.MeasurementRow`.

    ``corners``: pixels (x, y) of the target's upper left, upper right, lower left, lower right corner.
    """

    target_name: str
    kind: "ImageKind"
    sun_azimuth_deg: float
    sun_elevation_deg: float
    external_id: str | None = None
    taken_at: datetime | None = None
    motor_position: tuple[float, float] | None = None
    focal_spot_wgs84: tuple[float, float, float] | None = None
    corners: tuple[tuple[float, float], ...] | None = None


@dataclass(frozen=True, eq=False)
class _Reading:
    """A `MeasuredFlux` with its quality as JSON; everything but the quality is None where it was refused."""

    accepted: bool
    reason: str | None
    quality: dict[str, Any]
    flux: NDArray[Any] | None = None
    centered: NDArray[Any] | None = None
    center_of_mass: NDArray[Any] | None = None


def plain(value: Any) -> Any:
    """``value`` as JSON knows it; figures that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _read(operations: Operations, pixels: NDArray[Any], photograph: Photograph, plane: TargetPlane) -> _Reading:
    corners = None if photograph.corners is None else np.array(photograph.corners)
    try:
        measured = operations.measure(pixels, photograph.kind, plane, corners=corners)
    except ImageRefusedError as refusal:
        quality = {"accepted": False, "reason": refusal.reason, "detail": refusal.detail}
        return _Reading(accepted=False, reason=refusal.reason, quality=quality)
    quality = plain(asdict(measured.quality))
    return _Reading(
        accepted=bool(measured.quality.accepted),
        reason=measured.quality.reason or None,
        quality=quality,
        flux=measured.flux,
        centered=measured.centered,
        center_of_mass=measured.center_of_mass,
    )


def _decode(runtime: Runtime, data: bytes) -> NDArray[np.uint8]:
    from service.sources.decode import decode_image

    limit = runtime.settings.max_image_bytes
    if len(data) > limit:
        raise TooLargeError(f"image: {len(data)} bytes is more than the {limit} allowed; crop or compress it")
    return decode_image(data, max_pixels=runtime.settings.max_image_pixels)


def _new_measurement(photograph: Photograph, image: NewImage, reading: _Reading, session: Session) -> NewMeasurement:
    return NewMeasurement(
        image=image,
        kind=photograph.kind,
        target=store.get_target(session, photograph.target_name),
        sun_azimuth_deg=photograph.sun_azimuth_deg,
        sun_elevation_deg=photograph.sun_elevation_deg,
        accepted=reading.accepted,
        quality=reading.quality,
        reason=reading.reason,
        external_id=photograph.external_id,
        motor_position=photograph.motor_position,
        taken_at=photograph.taken_at,
        focal_spot_wgs84=photograph.focal_spot_wgs84,
        corners_px=None if photograph.corners is None else {"corners": plain(photograph.corners)},
        center_of_mass=reading.center_of_mass,
        flux=reading.flux,
        centered=reading.centered,
    )


def _require_past(taken_at: datetime | None) -> None:
    """A surface from a photograph of next year would stay the current one until then."""
    if taken_at is not None and taken_at > now() + _AHEAD:
        raise InvalidInputError(
            f"taken_at: {taken_at.isoformat()} lies ahead of this machine's {now().isoformat(timespec='seconds')}; "
            "set the clock that is wrong and post it again"
        )


def ingest(runtime: Runtime, heliostat_name: str, photograph: Photograph, data: bytes) -> tuple[MeasurementRow, bool]:
    """Measure and keep a photograph; the second value is False where it was there already.

    An image that cannot be measured is kept too, not accepted, with its reason.

    Raises
    ------
    NotFoundError
        Where the heliostat or the target is not stored.
    InvalidInputError, UnsupportedImageError, TooLargeError
        Where the file is no image that can be decoded safely, or was taken in the future; it is not kept.
    ConflictError
        Where the external id belongs to another image of the same kind.
    """
    kind_of_file = media_type(data)
    _require_past(photograph.taken_at)
    with runtime.database.reading() as session:
        heliostat = store.get_heliostat(session, heliostat_name)
        plane = store.target_plane(store.get_target(session, photograph.target_name))
        known = store.find_measurement_of_image(session, heliostat, digest(data), photograph.kind)
        if known is not None:
            runtime.images.put(data)  # mends a file that the store has lost
            PHOTOGRAPHS.labels("known").inc()
            return known, False
    with runtime.computing("measure") as operations:
        pixels = _decode(runtime, data)
        reading = _read(operations, pixels, photograph, plane)
    height, width = pixels.shape[:2]
    image = NewImage(runtime.images.put(data), kind_of_file, len(data), width, height)
    with runtime.database.writing() as session:
        heliostat = store.get_heliostat(session, heliostat_name)
        new = _new_measurement(photograph, image, reading, session)
        row, is_new = store.add_measurement(session, heliostat, new)
    _watch(runtime, heliostat_name, row, is_new)
    return row, is_new


def _watch(runtime: Runtime, heliostat_name: str, row: MeasurementRow, is_new: bool) -> None:
    """Count a photograph that is stored, and hold it against the current twin."""
    from service import drift  # late: it stands on this module

    if is_new and row.accepted:
        drift.judge(runtime, heliostat_name, row)
    elif is_new:
        REFUSALS.labels(row.reason or "unknown").inc()
    PHOTOGRAPHS.labels(("accepted" if row.accepted else "refused") if is_new else "known").inc()


# --- a surface --------------------------------------------------------------------------------------------------------


def choose_measurements(
    session: Session,
    heliostat: HeliostatRow,
    count: int,
    since: datetime | None = None,
    until: datetime | None = None,
) -> list[MeasurementRow]:
    """Up to ``count`` accepted measurements of a time: recent, and with the sun at different places.

    Raises
    ------
    ConflictError
        Where the heliostat has none.
    """
    recent = store.recent_measurements(session, heliostat, _RECENT * count, since, until)
    if not recent and (since or until):
        raise ConflictError(f"heliostat {heliostat.name} has no accepted measurement of this time")
    if not recent:
        raise ConflictError(f"heliostat {heliostat.name} has no accepted measurement; post target images of it first")
    from model.observation import spread_suns

    suns = sun_direction([row.sun_azimuth_deg for row in recent], [row.sun_elevation_deg for row in recent])
    return [recent[index] for index in spread_suns(suns, count)]


def _named_measurements(session: Session, heliostat: HeliostatRow, names: Sequence[str]) -> list[MeasurementRow]:
    rows = [store.get_measurement(session, heliostat, name, arrays=True) for name in dict.fromkeys(names)]
    for row in rows:
        if not row.accepted or row.arrays is None:
            raise ConflictError(f"measurements: {row.identifier} was refused ({row.reason}); choose accepted ones")
    return rows


def spot_of(row: MeasurementRow, plane: TargetPlane, origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """Centre of mass in ENU: as measured, else as it was given, else the target's centre."""
    if row.center_right_m is not None and row.center_up_m is not None:
        return plane.to_enu((row.center_right_m, row.center_up_m))
    if row.focal_spot_wgs84 is not None:
        return wgs84_to_enu(row.focal_spot_wgs84, origin)
    return np.array(plane.center)


def observation_of(row: MeasurementRow, origin: tuple[float, float, float]) -> "Observation":
    """What an accepted measurement, loaded with its arrays, shows the model."""
    from model.observation import Observation

    plane = store.target_plane(row.target)
    motors = (row.motor_axis_1, row.motor_axis_2)
    return Observation(
        flux=unpack(row.arrays or b"")["centered"],
        sun=sun_direction(row.sun_azimuth_deg, row.sun_elevation_deg),
        center_of_mass=spot_of(row, plane, origin),
        target=plane,
        motor_position=None if None in motors else np.array(motors),
        identifier=row.identifier,
    )


def predict_surface(
    runtime: Runtime,
    heliostat_name: str,
    method: "Method" = "network",
    measurements: Sequence[str] | None = None,
    images: int = 8,
    actor: str = RESERVED,
    also: Callable[[Session, SurfaceRow], None] | None = None,
    model_version: int | None = None,
) -> SurfaceRow:
    """Predict a heliostat's surface from stored measurements and keep it as its next version.

    It is valid from when the newest of its images was taken, where that is known, else from now. ``actor`` is who
    asked for it. ``also`` writes in the same transaction; what it raises undoes the surface too. ``model_version`` is
    the plant's model that explains the images, by default the current one.

    Raises
    ------
    NotFoundError, ConflictError
        Where the heliostat, a measurement or the model is not stored, or no measurement is accepted.
    """
    with runtime.database.reading() as session:
        row = store.get_heliostat(session, heliostat_name)
        origin = store.get_plant(session).origin
        heliostat = load_heliostat(session, row)
        if measurements is None:
            measurements = [measurement.identifier for measurement in choose_measurements(session, row, images)]
        chosen = _named_measurements(session, row, measurements)
        model = models.get_model(session, model_version)
    observations = [observation_of(measurement, origin) for measurement in chosen]
    with runtime.computing(f"predict_{method}") as operations:
        predicted = operations.predict(heliostat, observations, method, model.optics, model.effects)
    with runtime.database.writing() as session:
        row = store.get_heliostat(session, heliostat_name)
        used = [store.get_measurement(session, row, name) for name in predicted.used]
        surface, _ = store.add_surface(session, row, _new_surface(method, model, predicted, used))
        about = {"version": surface.version, "model": model.version}
        audit.record(session, actor, "surface.predicted", f"heliostat {heliostat_name}", **about)
        if also is not None:
            also(session, surface)
        return surface


def _new_surface(
    method: str, model: PlantModel, predicted: "SurfacePrediction", used: list[MeasurementRow]
) -> NewSurface:
    return NewSurface(
        source=method,
        z=predicted.z,
        z_std=predicted.z_std,
        control_points=predicted.control_points,
        valid_from=max((row.taken_at for row in used if row.taken_at is not None), default=None),
        model=predicted.weights,
        model_version=model.version,
        measurements=used,
        misfit=predicted.misfit,
    )


# --- a forecast -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ForecastRequest:
    """What to forecast; ``target`` names a stored plane, else ``plane`` is one.

    ``sun_azimuth_deg`` counts from south, positive to the east. ``aim`` (3,) [m] is by default the plane's centre.
    ``surface``: "current", "ideal" or a version. ``window`` [m]: the side of a square about the centre of mass that is
    mapped; the whole plane without it. ``model_version`` is the plant's model, by default the current one.
    """

    heliostat: str
    sun_azimuth_deg: float
    sun_elevation_deg: float
    target: str | None = None
    plane: TargetPlane | None = None
    aim: tuple[float, float, float] | None = None
    surface: str | int = "current"
    dni: float = 1000.0
    resolution: tuple[int, int] = (256, 256)
    window: float | None = None
    normalised: bool = False
    model_version: int | None = None


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
        Where the heliostat cannot reflect the sun to the aim point, or light does not reach the plane's lit side.
    """
    with runtime.database.reading() as session:
        row = store.get_heliostat(session, request.heliostat)
        heliostat = load_heliostat(session, row)
        plane = _plane(session, request)
        surface = _chosen_surface(session, row, request.surface)
        model, latitude_deg = models.get_model(session, request.model_version), store.get_plant(session).latitude_deg
    z = None if surface is None else unpack(surface.arrays)["z"]
    forecast = _trace(runtime, heliostat, z, request, plane, model, latitude_deg)
    return Traced(row, surface, plane, model, forecast)


def receiver_as_json(receiver: Receiver) -> dict[str, Any]:
    """A receiver's geometry, as forecasts keep it [m]; a cylinder's width is the length of its arc."""
    plane = {name: plain(getattr(receiver, name)) for name in ("center", "normal", "up", "width", "height")}
    if isinstance(receiver, TargetPlane):
        return plane
    return plane | {"radius": receiver.radius, "opening_deg": receiver.opening_deg}


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
        aim_point_m=None if request.aim is None else list(request.aim),
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
    runtime: Runtime,
    heliostat: Heliostat,
    z: NDArray[Any] | None,
    request: ForecastRequest,
    plane: TargetPlane,
    model: PlantModel,
    latitude_deg: float,
) -> "Forecast":
    from model.effects import light_effects

    with runtime.computing("forecast") as operations:
        return operations.forecast(
            heliostat,
            z,
            sun_direction(request.sun_azimuth_deg, request.sun_elevation_deg),
            plane,
            aim=None if request.aim is None else np.array(request.aim),
            resolution=request.resolution,
            window=request.window,
            optics=replace(model.optics, dni=request.dni),
            # A stored target is what the camera looks at; on any other plane there is only light.
            effects=model.effects if request.plane is None else light_effects(model.effects),
            latitude_deg=latitude_deg,
        )
