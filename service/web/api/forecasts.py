"""Flux forecasts."""

from dataclasses import fields
from datetime import datetime
from functools import partial
from typing import Annotated, Any, Literal, Self

from fastapi import APIRouter, Depends, Path, Query, Response, status
from numpy.typing import NDArray
from pydantic import BaseModel, Discriminator, Field, Tag, model_validator

from model.plant import Receiver
from service import store
from service.base.arrays import pair_or_none
from service.base.fields import (
    AnySun,
    CreatedAt,
    Flag,
    HeliostatOf,
    Id,
    Model,
    ModelNumber,
    ModelVersion,
    MotorPosition,
    Name,
    Number,
    Plane,
    Position,
    Resolution,
    Rows,
    SunAt,
    SunPosition,
    Version,
    VersionIn,
    from_row,
)
from service.base.receivers import PlaneReceiverIn, ReceiverIn
from service.drawing.pictures import flux_picture
from service.store.listing import Order, Period
from service.store.tables import ForecastRow
from service.twin.forecasts.heliostat_forecast import (
    ForecastRequest,
    camera_view,
    flux_of,
    make_forecast,
    position_of,
)
from service.twin.forecasts.watts import Sunlight, dni_of
from service.twin.runtime.runtime import Runtime
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


def _surface_by(value: Any) -> str:
    """Whether a surface is named by a word or by its version."""
    return "(word)" if isinstance(value, str) else "(version)"


Surface = Annotated[
    Annotated[Literal["current", "ideal"], Tag("(word)")] | Annotated[VersionIn, Tag("(version)")],
    Discriminator(_surface_by),
]


class ForecastIn(Model):
    """A flux map to compute."""

    heliostat: Name
    target: Name | None = Field(
        default=None, description="A stored target or receiver; either this, `plane` or `receiver`."
    )
    plane: Plane | None = Field(
        default=None, description="Any plane; either this, `target` or `receiver`."
    )
    receiver: ReceiverIn | None = Field(
        default=None,
        description=(
            "Any receiver; either this, `target` or `plane`. The map of a cylinder is unrolled."
        ),
    )
    sun: AnySun
    aim_point_m: Position | None = Field(
        default=None, description="Where the heliostat aims [m]; by default the receiver's middle."
    )
    motor_position: MotorPosition | None = Field(
        default=None,
        description=(
            "In place of an aim: positions of both motors [steps]. The calibrated mount, as it was"
            " at the time in `sun`, else the newest, says where they send the light, or the"
            " heliostat's properties where it was never calibrated."
        ),
    )
    surface: Surface = Field(
        default="current",
        description=(
            "The heliostat's current surface, the ideal one, or a version. A heliostat without a"
            " surface is forecast by its ideal mirror; the first of `warnings` says so."
        ),
    )
    dni_w_m2: Sunlight = 1000.0
    resolution: Resolution = (256, 256)
    window_m: Number | None = Field(
        default=None,
        ge=0.01,
        le=1e3,
        description=(
            "Side of a square about the centre of mass to map [m]; else the plane. Planes only."
        ),
    )
    normalised: Flag = Field(
        default=False, description="Scale the map to a sum of 100 instead of W/m2."
    )
    model_version: ModelVersion = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(value is not None for value in (self.target, self.plane, self.receiver)) != 1:
            raise ValueError("give either target or plane, or receiver")
        is_whole = not isinstance(self.receiver, PlaneReceiverIn | None)
        if self.window_m is not None and is_whole:
            raise ValueError("window_m: the map of such a receiver is all of it; leave it out")
        if self.aim_point_m is not None and self.motor_position is not None:
            raise ValueError("give either aim_point_m or motor_position")
        return self


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


def _factor(description: str) -> Any:
    """A factor of the losses."""
    return Field(description=f"{description} [1].")


class ForecastLosses(BaseModel):
    """What becomes of the light on a heliostat, in watts.

    The factors are in the order of the light, and each is the share that is left. Neighbours and
    tower are not traced, so that shading and blocking are 1.
    """

    mirror_area_m2: float = Field(description="Area of the facets [m2].")
    incident_w: float = Field(description="Direct normal irradiance times that area [W].")
    cosine: float = _factor(
        "Projection of the mirror towards the sun, less what the effects soiling and blocking take"
    )
    shading: float = _factor("Share that is not shaded")
    blocking: float = _factor("Share that is not blocked")
    reflectance: float = _factor("Reflectance of mirrors and of the model's optics")
    cleanliness: float = Field(1.0, description="Share that soiling leaves; here 1 [1].")
    attenuation: float = _factor("Share that the air leaves")
    intercept: float = _factor("Share that hits the whole target or receiver, mapped or not")
    absorptance: float = _factor("Share that it absorbs")
    optical_efficiency: float = Field(description="Product of the factors [1].")
    intercepted_w: float = Field(description="Power on the whole target or receiver [W].")
    absorbed_w: float = Field(description="Power that it absorbs [W].")


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
        warnings=row.warnings or [],
        surface="ideal" if row.surface is None else "stored",
        surface_version=None if row.surface is None else row.surface.version,
        target=row.target_name,
        sun={"azimuth_deg": row.sun_azimuth_deg, "elevation_deg": row.sun_elevation_deg},
        at=row.sun_at,
        resolution=(row.rows, row.columns),
        unit="1" if row.normalised else "W/m2",
        center_of_mass_m=pair_or_none(row.center_right_m, row.center_up_m),
    )


def forecast_answer(
    row: ForecastRow, media_type: str, shown: NDArray[Any] | None = None
) -> Response:
    """A forecast in the requested media type. ``shown`` (rows, columns) replaces its flux."""
    flux = flux_of(row, shown)
    if media_type == formats.JSON:
        return json_answer(forecast_summary(row), flux=flux)
    unit = "flux [% per pixel]" if row.normalised else "W/m²"
    size = (row.window_m or row.plane["width"], row.window_m or row.plane["height"])
    name, title = (
        f"{row.heliostat.name}-forecast-{row.id}",
        f"{row.heliostat.name}, forecast {row.id}",
    )
    return maps_answer(
        Maps(name, title, {"flux": flux}, partial(flux_picture, flux, size, unit)), media_type
    )


router = APIRouter(prefix="/forecasts", tags=["forecasts"])


def _given(body: ForecastIn) -> Receiver | None:
    """The receiver of the request, or None if it names a stored one."""
    if body.plane is not None:
        return body.plane.named("plane")
    return None if body.receiver is None else body.receiver.named("receiver")


def _request(runtime: Runtime, body: ForecastIn) -> ForecastRequest:
    with runtime.database.reading() as session:
        sun, altitude = position_of(session, body.sun), store.get_plant(session).altitude_m
    names = {field.name for field in fields(ForecastRequest)} & set(ForecastIn.model_fields)
    same = {name: getattr(body, name) for name in names - {"sun", "receiver"}}
    same["dni_w_m2"] = dni_of(body.dni_w_m2, sun.elevation_deg, altitude)
    sun_at = body.sun.at if isinstance(body.sun, SunAt) else None
    return ForecastRequest(sun=sun, sun_at=sun_at, receiver=_given(body), **same)


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
    row = make_forecast(runtime, _request(runtime, request))
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
