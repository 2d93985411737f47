"""Flux forecasts."""

from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query, Response, status
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from service import store
from service.base.fields import (
    CreatedAt,
    HeliostatOf,
    Id,
    ModelNumber,
    Name,
    Rows,
    SunPosition,
    Version,
    from_row,
)
from service.drawing.pictures import flux_picture
from service.store.listing import Order, Period
from service.store.tables import ForecastRow
from service.twin.alarms.measured_states import read_requested_states
from service.twin.forecasts.heliostat_forecast import camera_view, flux_of, make_forecast, size_of
from service.twin.forecasts.requests import ForecastIn
from service.twin.forecasts.watts import ForecastLosses
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    Limit,
    RuntimeDep,
    require_json,
)
from service.web.responses import formats
from service.web.responses.formats import MediaType, json_answer, maps_answer
from service.web.responses.openapi import arrays, problems
from service.web.responses.paging import OrderQuery, Page, Since, Until, page
from service.web.responses.representation import Maps


class ForecastReceiverOut(BaseModel):
    """The receiver of a forecast.

    The axis of a cylinder is behind its middle. The map of a cylinder is unrolled. That of panels
    has them side by side.
    """

    center: tuple[float, float, float] = Field(
        description="Its middle: east, north, up of the tower base [m]."
    )
    normal: tuple[float, float, float] = Field(description="Of the lit side, there.")
    up: tuple[float, float, float] = Field(description="Unit vector up the map.")
    width: float = Field(
        description="[m]; of a cylinder the length of its arc, of panels their sum."
    )
    height: float = Field(description="[m]")
    radius: float | None = Field(default=None, description="Of a cylinder [m]; null: a plane.")
    opening_deg: float | None = Field(
        default=None, description="Angle of a cylinder's lit surface [deg]."
    )
    panels: int | None = Field(
        default=None, description="Number of panels side by side; null: it is one surface."
    )
    absorptance: float = Field(
        default=1.0, description="Share of the light on the map that it absorbs [1]."
    )


class ForecastSummary(BaseModel):
    """A computed flux map without its pixels."""

    id: Id
    warnings: list[str] = Field(
        description="What to know first: that the ideal mirror replaces a missing surface."
    )
    heliostat: HeliostatOf
    surface: Literal["ideal", "stored"] = Field(
        description="Which mirror was traced: the ideal one, or a surface."
    )
    surface_version: int | None = Field(description="null: the ideal surface.")
    target: str | None = Field(description="Name of the target; null: another plane.")
    plane: ForecastReceiverOut = Field(description="The surface that the light falls on [m].")
    sun: SunPosition
    at: datetime | None = Field(
        description="The time that was asked for; null: the sun's position was."
    )
    aim_point_m: tuple[float, float, float] | None = Field(description="[m], as given.")
    motor_position: tuple[float, float] | None = Field(description="[steps], as given.")
    dni_w_m2: float = Field(description="[W/m2]")
    window_m: float | None = Field(
        description="Side of the mapped square about the centre of mass [m]; null: the plane."
    )
    resolution: tuple[int, int] = Field(description="Rows, columns.")
    normalised: bool = Field(description="Whether the map is scaled to a sum of 100.")
    unit: str = Field(
        description=(
            "Unit of the map: W/m2, or 1 where it is normalised to a sum of 100. W/m2 are those of"
            " the declared optics (GET /v1/plant); without any, of reflectivity 1 and no"
            " attenuation."
        )
    )
    peak_w_m2: float = Field(description="Largest irradiance [W/m2].")
    power_w: float = Field(description="Power on the mapped area [W].")
    center_of_mass_m: tuple[float, float] | None = Field(
        description="Right and up of the plane's centre [m]."
    )
    losses: ForecastLosses = Field(description="What becomes of the light.")
    model_version: ModelNumber = Field(description="Version of the plant's model, see /v1/models.")
    created_at: CreatedAt


class ForecastOut(ForecastSummary):
    """A computed flux map."""

    flux: Rows = Field(description="(rows, columns) [W/m2], or what `unit` says.")


def forecast_summary(row: ForecastRow) -> ForecastSummary:
    """A forecast without its pixels."""
    return from_row(
        ForecastSummary,
        row,
        heliostat=row.heliostat.name,
        surface="ideal" if row.surface is None else "stored",
        surface_version=None if row.surface is None else row.surface.version,
        target=row.target_name,
        **row.document,
    )


def forecast_answer(
    row: ForecastRow, media_type: str, shown: NDArray[Any] | None = None
) -> Response:
    """A forecast in the requested media type. ``shown`` (rows, columns) replaces its flux."""
    flux = flux_of(row, shown)
    if media_type == formats.JSON:
        return json_answer(forecast_summary(row), flux=flux)
    unit = "flux [% per pixel]" if row.document["normalised"] else "W/m²"
    name, title = (
        f"{row.heliostat.name}-forecast-{row.id}",
        f"{row.heliostat.name}, forecast {row.id}",
    )
    picture = partial(flux_picture, flux, size_of(row), unit)
    return maps_answer(Maps(name, title, {"flux": flux}, picture), media_type)


router = APIRouter(prefix="/forecasts", tags=["forecasts"])


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    responses=problems(404, 409, 413, 415),
    dependencies=[OPERATE, Depends(require_json), COMPUTE_SLOT],
)
def post_forecast(request: ForecastIn, runtime: RuntimeDep, response: Response) -> ForecastSummary:
    """Forecast the flux of one heliostat on a plane, and store it.

    Read the map from the path of the forecast. `POST /v1/jobs/forecasts` superposes the whole
    field, or some heliostats.
    """
    row = make_forecast(runtime, request, read_requested_states(runtime, request))
    response.headers["Location"] = f"/v1/forecasts/{row.id}"
    return forecast_summary(row)


@router.get("", responses=problems(404), dependencies=[READ])
def list_forecasts(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
    heliostat: Annotated[Name | None, Query(description="Only those of this heliostat.")] = None,
    target: Annotated[Name | None, Query(description="Only those on this target.")] = None,
    since: Since = None,
    until: Until = None,
    order: OrderQuery = "up",
) -> Page[ForecastSummary]:
    """List forecasts, in the order of their creation."""
    with runtime.database.reading() as session:
        of = None if heliostat is None else store.get_heliostat(session, heliostat)
        made, direction = Period(since, until), Order(descending=order == "down")
        rows = store.list_forecasts(
            session, limit + 1, after, of, target=target, created=made, order=direction
        )
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
        Literal["light", "camera"],
        Query(description="The light, or what the model's camera would show of it."),
    ] = "light",
) -> Response:
    """Get a forecast with its map. The map is the flux, or the image that a camera would take."""
    with runtime.database.reading() as session:
        row = store.get_forecast(session, number)
        shown = camera_view(session, row) if view == "camera" else None
    return forecast_answer(row, media_type, shown)
