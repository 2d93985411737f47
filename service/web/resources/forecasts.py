"""Flux forecasts: REST, the form, and the page of a flux map."""

import re
from collections.abc import Sequence
from datetime import datetime, timedelta
from functools import partial
from typing import Annotated, Any, Literal, Self
from zoneinfo import ZoneInfo

from fastapi import APIRouter, Depends, Form, Path, Query, Request, Response, status
from fastapi.responses import HTMLResponse
from numpy.typing import NDArray
from pydantic import BaseModel, Field, model_validator
from sqlalchemy.orm import Session

from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError
from model.frames import solar_time, sun_direction
from service import store
from service.base.errors import NotFoundError
from service.base.fields import (
    AZIMUTH,
    ELEVATION,
    CreatedAt,
    FormMoment,
    HeliostatOf,
    Id,
    JsonObject,
    Lines,
    Model,
    ModelNumber,
    Name,
    Rows,
    Search,
    Sun,
    SunAt,
    SunPosition,
    Version,
    from_row,
    plant_time_to_utc,
)
from service.base.validation import NAME
from service.drawing import charts
from service.drawing.pictures import flux_picture
from service.drawing.templates import irradiance, times_in_zone
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import field_forecasts
from service.jobs.kinds.field_forecasts import FleetForecastIn
from service.store import queue
from service.store.columns import now
from service.store.job_tables import JobRow
from service.store.tables import ForecastRow, HeliostatRow, PlantRow
from service.twin.alarms.measured_states import read_requested_states
from service.twin.forecasts.aims import plant_time_zone
from service.twin.forecasts.heliostat_forecast import camera_view, flux_of, make_forecast, size_of
from service.twin.forecasts.requests import ForecastIn, position_of
from service.twin.forecasts.watts import ForecastLosses, Sunlight, loss_chain
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    RuntimeDep,
    ZoneDep,
    require_json,
)
from service.web.resources.plant import PlaneOut
from service.web.responses import formats
from service.web.responses.formats import MediaType, json_answer, maps_answer
from service.web.responses.lists import ListQuery, Page, page
from service.web.responses.openapi import arrays, problems
from service.web.responses.pages import go_to, leave_for, named_by_field, render
from service.web.responses.representations import Maps


class ForecastReceiverOut(PlaneOut):
    """The receiver of a forecast.

    The axis of a cylinder is behind its middle. The map of a cylinder is unrolled: its width is the
    length of its arc. That of panels has them side by side: its width is their sum.
    """

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
pages = APIRouter(include_in_schema=False)


# Forecasts that the page lists.
def _forecast(runtime: Runtime, asked: ForecastIn) -> ForecastRow:
    """Compute and store a forecast."""
    return make_forecast(runtime, asked, read_requested_states(runtime, asked))


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
    row = _forecast(runtime, request)
    response.headers["Location"] = f"/v1/forecasts/{row.id}"
    return forecast_summary(row)


class ForecastsQuery(ListQuery):
    """Which forecasts are listed, in the order of their creation by default."""

    heliostat: Annotated[Name | None, Query(description="Only those of this heliostat.")] = None
    target: Annotated[Name | None, Query(description="Only those on this target.")] = None


@router.get("", responses=problems(404), dependencies=[READ])
def list_forecasts(
    query: Annotated[ForecastsQuery, Query()], runtime: RuntimeDep
) -> Page[ForecastSummary]:
    """List forecasts, in the order of their creation."""
    with runtime.database.reading() as session:
        name = query.heliostat
        heliostat = None if name is None else store.get_heliostat(session, name)
        rows = store.list_forecasts(session, query.portion, heliostat, query.target)
    return page([forecast_summary(row) for row in rows], query.limit)


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


# --- the form
# --------------------------------------------------------------------------------------------------

_RECENT = 10

# Heliostats that the form suggests at a time, by the beginning of their names.
_OFFERED = 20


class SunlightForm(Model):
    """A form with the sunlight: an irradiance [W/m2], or that of a clear sky."""

    sunlight: Literal["given", "clear_sky"] = "given"
    dni_w_m2: float = Field(default=1000.0, gt=0, le=2000)

    @property
    def given_dni(self) -> Sunlight:
        """The irradiance [W/m2], or that it is that of a clear sky."""
        return "clear_sky" if self.sunlight == "clear_sky" else self.dni_w_m2


def sunlight_fields(dni: Sunlight) -> dict[str, object]:
    """Fields of `SunlightForm` for a requested irradiance."""
    return {"sunlight": dni} if dni == "clear_sky" else {"dni_w_m2": dni}


class ForecastForm(SunlightForm):
    """The form. ``heliostat`` has one name or several, apart by commas or blanks.

    Without a name, it requests a forecast of all heliostats.
    """

    heliostat: Lines = ""
    target: Name
    sun_by: Literal["position", "time"] = "position"
    azimuth_deg: Annotated[float, AZIMUTH] | None = None
    elevation_deg: Annotated[float, ELEVATION] | None = None
    moment: FormMoment | None = None
    surface: Literal["current", "ideal"] = "current"

    @classmethod
    def filled(
        cls, heliostats: str, target: str | None, sun: Sun, at: datetime | None, **more: Any
    ) -> "ForecastForm":
        """The form with a sun, by its time ``at`` if it is known; it is not validated."""
        return cls.model_construct(
            heliostat=heliostats,
            target=target or "",
            sun_by="position" if at is None else "time",
            azimuth_deg=round(sun.azimuth_deg, 2) % 360,
            elevation_deg=round(sun.elevation_deg, 2),
            moment=at,
            **more,
        )

    @model_validator(mode="after")
    def _says_when_or_where(self) -> Self:
        wrong = next((name for name in self.names if not re.fullmatch(NAME, name)), None)
        if wrong is not None:
            raise ValueError(
                f"heliostat: {wrong!r} is no name; give names of 1 to 32 letters, digits,"
                " underscores and hyphens, apart by commas"
            )
        if self.sun_by == "time" and self.moment is None:
            raise ValueError("moment: say when")
        if self.sun_by == "position" and self.moment is not None:
            raise ValueError(
                "moment: a time and a position are both given; choose by the time, or empty the"
                " time"
            )
        if self.sun_by == "position" and (self.azimuth_deg is None or self.elevation_deg is None):
            raise ValueError("azimuth_deg, elevation_deg: give the position of the sun")
        return self

    @property
    def names(self) -> list[str]:
        """The names of the heliostats, each once."""
        return list(dict.fromkeys(self.heliostat.replace(",", " ").split()))

    @property
    def asked(self) -> JsonObject:
        """Fields that requests for one heliostat and for many share."""
        return {
            "target": self.target,
            "sun": self.sun,
            "surface": self.surface,
            "dni_w_m2": self.given_dni,
        }

    @property
    def sun(self) -> Sun | SunAt:
        """The requested position of the sun, or the time."""
        if self.sun_by == "time":
            assert self.moment is not None
            return SunAt(at=self.moment)
        assert self.azimuth_deg is not None
        assert self.elevation_deg is not None
        return Sun(azimuth_deg=self.azimuth_deg, elevation_deg=self.elevation_deg)


When = Literal["now", "noon"]

WHENS: dict[When, str] = {"now": "Now", "noon": "Solar noon tomorrow"}
"""Times that forms offer, with their labels."""


def time_of(when: When, zone: str, plant: PlantRow | None) -> datetime:
    """Now, or the sun's noon of the next day in a time ``zone``; without seconds, in UTC.

    Without a plant it is noon by the clock.
    """
    at = now().replace(second=0, microsecond=0)
    if when == "now":
        return at
    tomorrow = at.astimezone(ZoneInfo(zone)).replace(tzinfo=None) + timedelta(days=1)
    noon = plant_time_to_utc(tomorrow.replace(hour=12, minute=0), zone)
    if plant is None:
        return noon
    hours = float(solar_time(sun_direction(*sun_angles_at(noon, plant.origin)), plant.origin[0]))
    return (noon + timedelta(hours=12.0 - hours)).replace(second=0, microsecond=0)


def sun_now(plant: PlantRow | None) -> Sun:
    """The sun now. At night or without a plant its azimuth is 180 and its elevation 45."""
    azimuth, elevation = (0.0, 0.0) if plant is None else sun_angles_at(now(), plant.origin)
    if elevation <= 5:
        azimuth, elevation = 180.0, 45.0
    return Sun(azimuth_deg=round(azimuth, 2) % 360, elevation_deg=round(elevation, 2))


def _choices(session: Session) -> dict[str, object]:
    return {
        "heliostats": store.list_heliostats(session, _OFFERED),
        "targets": [row.name for row in store.list_targets(session)],
        "receivers": [(row.name, row.kind) for row in store.list_receivers(session)],
        "recent": store.recent_forecasts(session, _RECENT),
        "whens": WHENS,
    }


def offered_heliostats(runtime: Runtime, prefix: str, after: str | None) -> Sequence[HeliostatRow]:
    """The first heliostats whose names begin with ``prefix``, as suggestions for forms."""
    with runtime.database.reading() as session:
        return store.list_heliostats(session, _OFFERED, after, prefix)


def _form_context(
    runtime: RuntimeDep,
    heliostat: Annotated[Lines, Query(max_length=2000)] = "",
    job: Annotated[Version | None, Query()] = None,
    target: Annotated[Name | None, Query()] = None,
    when: Annotated[When | None, Query(description="A time to fill in.")] = None,
) -> dict[str, object]:
    """The form with defaults, or with the values of a forecast ``job``."""
    with runtime.database.reading() as session:
        choices = _choices(session)
        if job is not None:
            return choices | {"filled": _filled_as(session, queue.get_job(session, job))}
        plant = store.find_plant(session)
        zone = plant_time_zone(session, runtime.settings.time_zone)
        moment = None if when is None else time_of(when, zone, plant)
        name = heliostat or next((row.name for row in store.list_heliostats(session, 1)), "")
    return choices | {"filled": ForecastForm.filled(name, target, sun_now(plant), moment)}


def _filled_as(session: Session, job: JobRow) -> ForecastForm:
    """The form from which a forecast of all heliostats was requested."""
    if job.kind != "forecasts":
        raise NotFoundError(f"job {job.id} is no forecast")
    asked = FleetForecastIn.model_validate(job.payload)
    moment = asked.sun.at if isinstance(asked.sun, SunAt) else None
    return ForecastForm.filled(
        ", ".join(asked.heliostats or ()),
        asked.target,
        position_of(session, asked.sun),
        moment,
        surface=asked.surface,
        **sunlight_fields(asked.dni_w_m2),
    )


def _require_day(runtime: Runtime, sun: Sun | SunAt, zone: str) -> None:
    """Refuse a time at night, in the words of the form."""
    with runtime.database.reading() as session:
        try:
            position_of(session, sun)
        except InvalidInputError as night:
            said = times_in_zone(str(night), zone).removeprefix("at: ")
            raise InvalidInputError(f"moment: {said}") from night


def forecast_figures(runtime: Runtime, number: int) -> dict[str, object]:
    """What the page of a forecast draws, and its values in the form for the next one."""
    with runtime.database.reading() as session:
        row = store.get_forecast(session, number)
        choices = _choices(session)
    made, size = forecast_summary(row), size_of(row)
    title = (
        f"Flux of {made.heliostat} on {made.target or 'a plane'}, peak {irradiance(made.peak_w_m2)}"
    )
    surface = "ideal" if row.surface is None else "current"
    return choices | {
        "filled": ForecastForm.filled(
            made.heliostat, made.target, made.sun, made.at, surface=surface, dni_w_m2=made.dni_w_m2
        ),
        "forecast": made,
        "flux": charts.flux_map(title, flux_of(row), size, "% per pixel")
        if made.normalised
        else charts.irradiance_map(title, flux_of(row), size),
        "stored": row.document,
        "chain": loss_chain(row.document["losses"]),
    }


# --- pages
# --------------------------------------------------------------------------------------------------


@pages.get("/forecast/heliostats", dependencies=[READ])
def get_offered_heliostats(
    request: Request,
    runtime: RuntimeDep,
    heliostat: Annotated[Search, Query()] = "",
    find: Annotated[Search, Query()] = "",
    after: Annotated[Name | None, Query(description="The last name of the list before.")] = None,
) -> HTMLResponse:
    """The first names that begin with ``heliostat`` or ``find``, as suggestions for forms."""
    rows = offered_heliostats(runtime, heliostat or find, after)
    return render(request, "offered.html", heliostats=rows)


@pages.get("/forecast", dependencies=[READ])
def get_forecast_form(
    request: Request, context: Annotated[dict[str, object], Depends(_form_context)]
) -> HTMLResponse:
    """The form with defaults, or with the values of a forecast job."""
    return render(request, "forecast.html", **context, forecast=None)


@pages.post("/forecast", dependencies=[OPERATE, COMPUTE_SLOT])
def post_forecast_form(
    form: Annotated[ForecastForm, Form()],
    request: Request,
    runtime: RuntimeDep,
    identity: IdentityDep,
    zone: ZoneDep,
) -> Response:
    """Compute and store a forecast, and go to its page.

    That of several heliostats or all takes longer than a request may, and is a job.
    """
    form = form.in_utc(zone)
    _require_day(runtime, form.sun, zone)
    if len(form.names) != 1:
        with named_by_field():
            payload = FleetForecastIn(heliostats=form.names or None, **form.asked)
        row = enqueue(runtime, field_forecasts.KIND, payload, identity.name).row
        return leave_for(request, f"/jobs/{row.id}")
    asked = ForecastIn(heliostat=form.names[0], **form.asked)
    return go_to(f"/forecasts/{_forecast(runtime, asked).id}")


@pages.get("/forecasts/{number}", dependencies=[READ, RENDER_SLOT])
def get_forecast_page(
    number: Annotated[Version, Path(description="Id of the forecast.")],
    request: Request,
    runtime: RuntimeDep,
) -> HTMLResponse:
    """Flux map and metrics of a forecast, with the form for the next one."""
    return render(request, "forecast.html", **forecast_figures(runtime, number))
