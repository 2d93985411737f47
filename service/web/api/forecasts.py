"""Flux forecasts."""

from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal, Self

from fastapi import APIRouter, Body, Depends, Path, Query, Response, status
from fastapi.responses import JSONResponse
from numpy.typing import NDArray
from pydantic import BaseModel, Discriminator, Field, Tag, model_validator

from service import store
from service.base.arrays import pair
from service.base.fields import (
    AnySun,
    Flag,
    Model,
    ModelVersion,
    MotorPosition,
    Name,
    Number,
    Plane,
    Position,
    Resolution,
    Rows,
    Sun,
    SunAt,
    Version,
    VersionIn,
)
from service.drawing.pictures import flux_picture
from service.jobs.asking import ask_for
from service.jobs.kinds.field_forecasts import FleetForecastIn
from service.store.tables import ForecastRow
from service.twin.forecast import ForecastRequest, camera_view, flux_of, make_forecast, position_of
from service.twin.runtime import Runtime
from service.web.answers import formats
from service.web.answers.formats import MediaType, json_answer, maps_answer
from service.web.answers.openapi import arrays, problems
from service.web.answers.paging import Page, page
from service.web.answers.representation import Maps
from service.web.api.jobs import IdempotencyKey, JobOut, job_out
from service.web.door.dependencies import COMPUTES, OPERATE, READ, IdentityDep, Limit, RuntimeDep, require_json


def _surface_by(told: Any) -> str:
    """Whether a surface is named by a word or by its version."""
    return "(word)" if isinstance(told, str) else "(version)"


Surface = Annotated[
    Annotated[Literal["current", "ideal"], Tag("(word)")] | Annotated[VersionIn, Tag("(version)")],
    Discriminator(_surface_by),
]


class ForecastIn(Model):
    """A flux map to compute."""

    heliostat: Name
    target: Name | None = Field(default=None, description="A stored target; either this or `plane`.")
    plane: Plane | None = Field(default=None, description="Any plane; either this or `target`.")
    sun: AnySun
    aim_point: Position | None = Field(
        default=None, description="Where the heliostat aims [m]; by default the plane's centre."
    )
    motor_position: MotorPosition | None = Field(
        default=None,
        description="In place of an aim: positions of both motors [steps]. The calibrated mount, as it was at the time "
        "in `sun`, else the newest, says where they send the light, or the heliostat's properties where it was never "
        "calibrated.",
    )
    surface: Surface = Field(
        default="current", description="The heliostat's current surface, the ideal one, or a version."
    )
    dni_w_m2: Number = Field(default=1000.0, gt=0, le=2000, description="Direct normal irradiance [W/m2].")
    resolution: Resolution = (256, 256)
    window: Number | None = Field(
        default=None,
        ge=0.01,
        le=1e3,
        description="Side of a square about the centre of mass to map [m]; else the plane.",
    )
    normalised: Flag = Field(default=False, description="Scale the map to a sum of 100 instead of W/m2.")
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.target is None) == (self.plane is None):
            raise ValueError("give either target or plane")
        if self.aim_point is not None and self.motor_position is not None:
            raise ValueError("give either aim_point or motor_position")
        return self


class ForecastSummary(BaseModel):
    """A computed flux map without its pixels."""

    id: int
    heliostat: str
    surface_version: int | None = Field(description="null: the ideal surface.")
    target: str | None
    plane: Plane = Field(description="The plane that the light falls on [m].")
    sun: Sun
    sun_at: datetime | None = Field(description="The time that was asked for; null: the sun's position was.")
    aim_point: tuple[float, float, float] | None = Field(description="[m], as given.")
    motor_position: tuple[float, float] | None = Field(description="[steps], as given.")
    dni_w_m2: float = Field(description="[W/m2]")
    window: float | None = Field(description="Side of the mapped square about the centre of mass [m]; null: the plane.")
    resolution: tuple[int, int] = Field(description="Rows, columns.")
    normalised: bool
    unit: str = Field(
        description="Unit of the map: W/m2, or 1 where it is normalised to a sum of 100. W/m2 are those of the "
        "declared optics (GET /v1/plant); without any, of reflectivity 1 and no attenuation."
    )
    peak_w_m2: float = Field(description="Largest irradiance [W/m2].")
    power_w: float = Field(description="Power on the mapped area [W].")
    center_of_mass: tuple[float, float] | None = Field(description="Right and up of the plane's centre [m].")
    model_version: str = Field(description="Version of the plant's model: its number and effects.")
    created_at: datetime


class ForecastOut(ForecastSummary):
    """A computed flux map."""

    flux: Rows = Field(description="(rows, columns) [W/m2], or what `unit` says.")


def forecast_summary(row: ForecastRow) -> ForecastSummary:
    """A forecast without its pixels."""
    return ForecastSummary.model_validate(
        {
            "id": row.id,
            "heliostat": row.heliostat.name,
            "surface_version": None if row.surface is None else row.surface.version,
            "target": row.target_name,
            "plane": row.plane,
            "sun": {"azimuth_deg": row.sun_azimuth_deg, "elevation_deg": row.sun_elevation_deg},
            "sun_at": row.sun_at,
            "aim_point": row.aim_point_m,
            "motor_position": row.motor_position,
            "dni_w_m2": row.dni_w_m2,
            "window": row.window_m,
            "resolution": (row.rows, row.columns),
            "normalised": row.normalised,
            "unit": "1" if row.normalised else "W/m2",
            "peak_w_m2": row.peak_w_m2,
            "power_w": row.power_w,
            "center_of_mass": pair(row.center_right_m, row.center_up_m),
            "model_version": row.model_version,
            "created_at": row.created_at,
        }
    )


def forecast_answer(row: ForecastRow, media_type: str, shown: NDArray[Any] | None = None) -> Response:
    """A forecast as the client wants it, with ``shown`` (rows, columns) in place of its light."""
    flux = flux_of(row, shown)
    if media_type == formats.JSON:
        return json_answer(forecast_summary(row), flux=flux)
    unit = "flux [% per pixel]" if row.normalised else "W/m²"
    size = (row.window_m or row.plane["width"], row.window_m or row.plane["height"])
    name, title = f"{row.heliostat.name}-forecast-{row.id}", f"{row.heliostat.name}, forecast {row.id}"
    return maps_answer(Maps(name, title, {"flux": flux}, partial(flux_picture, flux, size, unit)), media_type)


router = APIRouter(prefix="/forecasts", tags=["forecasts"])

_EXAMPLE: dict[str, Any] = {
    "heliostat": "AA39",
    "target": "multi_focus_tower",
    "sun": {"azimuth_deg": -20.0, "elevation_deg": 45.0},
    "surface": "ideal",
}


def _request(runtime: Runtime, body: ForecastIn) -> ForecastRequest:
    with runtime.database.reading() as session:
        sun = position_of(session, body.sun)
    return ForecastRequest(
        heliostat=body.heliostat,
        target=body.target,
        plane=None if body.plane is None else body.plane.named("plane"),
        sun_azimuth_deg=sun.azimuth_deg,
        sun_elevation_deg=sun.elevation_deg,
        sun_at=body.sun.at if isinstance(body.sun, SunAt) else None,
        aim=body.aim_point,
        motors=body.motor_position,
        surface=body.surface,
        dni=body.dni_w_m2,
        resolution=body.resolution,
        window=body.window,
        normalised=body.normalised,
        model_version=body.model_version,
    )


def _alternative(body: Any) -> str:
    """Which of the requests a body is meant to be."""
    of_one = "heliostat" in body if isinstance(body, dict) else isinstance(body, ForecastIn)
    return "(one)" if of_one else "(field)"


Asked = Annotated[
    Annotated[ForecastIn, Tag("(one)")] | Annotated[FleetForecastIn, Tag("(field)")],
    Discriminator(_alternative),
    Body(
        openapi_examples={
            "one heliostat": {"value": _EXAMPLE},
            "the field": {"value": {name: _EXAMPLE[name] for name in ("target", "sun", "surface")}},
        }
    ),
]


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    response_model=ForecastSummary,
    responses={
        **problems(404, 409, 413, 415, 429),
        202: {"model": JobOut, "description": "Of many heliostats: the job that superposes them, under its Location."},
    },
    dependencies=[OPERATE, Depends(require_json), COMPUTES],
)
def post_forecast(
    request: Asked, runtime: RuntimeDep, identity: IdentityDep, response: Response, key: IdempotencyKey = None
) -> ForecastSummary | Response:
    """Compute a flux map and keep it; read the map itself from its own path.

    With `heliostat` it is that one's, at once. Without it the job of `/v1/jobs/forecasts` superposes all of the field,
    or those in `heliostats`; its map is read from `/v1/jobs/{number}/flux`.
    """
    if isinstance(request, FleetForecastIn):
        job = ask_for(runtime, "forecasts", request.model_dump(mode="json"), identity.name, key)
        document = job_out(job).model_dump(mode="json")
        return JSONResponse(document, status.HTTP_202_ACCEPTED, {"Location": f"/v1/jobs/{job.id}"})
    row = make_forecast(runtime, _request(runtime, request))
    response.headers["Location"] = f"/v1/forecasts/{row.id}"
    return forecast_summary(row)


@router.get("", responses=problems(404), dependencies=[READ])
def list_forecasts(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
    heliostat: Annotated[Name | None, Query(description="Only those of this heliostat.")] = None,
) -> Page[ForecastSummary]:
    """Forecasts in the order they were made."""
    with runtime.database.reading() as session:
        of = None if heliostat is None else store.get_heliostat(session, heliostat)
        rows = store.list_forecasts(session, limit + 1, after, of)
    items = [forecast_summary(row) for row in rows]
    return page(items, limit)


@router.get(
    "/{number}",
    responses={**problems(404, 406, 409), **arrays(ForecastOut, "`flux` (rows, columns).")},
    dependencies=[READ],
)
def get_forecast(
    number: Annotated[Version, Path(description="Id of the forecast.")],
    runtime: RuntimeDep,
    media_type: MediaType,
    view: Annotated[
        Literal["light", "camera"], Query(description="The light, or what the model's camera would show of it.")
    ] = "light",
) -> Response:
    """A forecast with its map: light, or what a photograph of it would be held against."""
    with runtime.database.reading() as session:
        row = store.get_forecast(session, number)
        shown = camera_view(session, row) if view == "camera" else None
    return forecast_answer(row, media_type, shown)
