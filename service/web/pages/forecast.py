"""Pages of forecasts: a form, and the resulting flux map."""

import re
from datetime import datetime, timedelta
from typing import Annotated, Any, Literal, Self
from zoneinfo import ZoneInfo

from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse
from pydantic import Field, ValidationError, model_validator
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.ephemeris import sun_angles_at
from model.errors import InvalidInputError
from model.frames import solar_time, sun_direction
from service import store
from service.base.errors import NotFoundError
from service.base.fields import (
    AZIMUTH,
    ELEVATION,
    FormMoment,
    JsonObject,
    Lines,
    Model,
    Name,
    Search,
    Sun,
    SunAt,
    Version,
    plant_time_to_utc,
)
from service.base.names import NAME
from service.drawing import charts
from service.drawing.templates import irradiance, times_in_zone
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import field_forecasts
from service.jobs.kinds.field_forecasts import FleetForecastIn
from service.store.columns import now
from service.store.job_tables import JobRow
from service.store.jobs import queue
from service.store.tables import PlantRow, ReceiverRow, TargetRow
from service.twin.alarms.measured_states import read_requested_states
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.forecasts.heliostat_forecast import flux_of, make_forecast, size_of
from service.twin.forecasts.requests import ForecastIn, position_of
from service.twin.forecasts.watts import Sunlight, loss_chain
from service.twin.runtime.runtime import Runtime
from service.web.api.forecasts import forecast_summary
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    RuntimeDep,
)
from service.web.auth.security import Identity
from service.web.responses.pages import go_to, leave_for, render

router = APIRouter(include_in_schema=False)

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
        "targets": session.scalars(select(TargetRow.name).order_by(TargetRow.name)).all(),
        "receivers": session.execute(
            select(ReceiverRow.name, ReceiverRow.kind).order_by(ReceiverRow.name)
        ).all(),
        "recent": store.recent_forecasts(session, _RECENT),
    }


@router.get("/forecast/heliostats", dependencies=[READ])
def get_offered_heliostats(
    request: Request,
    runtime: RuntimeDep,
    heliostat: Annotated[Search, Query()] = "",
    find: Annotated[Search, Query()] = "",
    after: Annotated[Name | None, Query(description="The last name of the list before.")] = None,
) -> HTMLResponse:
    """The first names that begin with ``heliostat`` or ``find``, as suggestions for forms."""
    with runtime.database.reading() as session:
        rows = store.list_heliostats(session, _OFFERED, after, heliostat or find)
    return render(request, "offered.html", heliostats=rows)


@router.get("/forecast", dependencies=[READ])
def get_forecast_form(
    request: Request,
    runtime: RuntimeDep,
    heliostat: Annotated[Lines, Query(max_length=2000)] = "",
    job: Annotated[Version | None, Query()] = None,
    target: Annotated[Name | None, Query()] = None,
    when: Annotated[When | None, Query(description="A time to fill in.")] = None,
) -> HTMLResponse:
    """The form with defaults, or with the values of a forecast ``job``."""
    with runtime.database.reading() as session:
        choices = _choices(session)
        if job is not None:
            filled = _filled_as(session, queue.get_job(session, job))
            return _page(request, runtime, choices, filled, forecast=None)
        plant = session.get(PlantRow, 1)
        sun = sun_now(plant)
        zone = plant_time_zone(session, runtime.settings.time_zone)
        moment = None if when is None else time_of(when, zone, plant)
        name = heliostat or next((row.name for row in store.list_heliostats(session, 1)), "")
    filled = ForecastForm.filled(name, target, sun, moment)
    return _page(request, runtime, choices, filled, forecast=None)


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


def _page(
    request: Request,
    runtime: Runtime,
    choices: dict[str, object],
    filled: ForecastForm,
    **shown: object,
) -> HTMLResponse:
    return render(request, "forecast.html", **choices, **shown, filled=filled, whens=WHENS)


def _ask_for_many(runtime: Runtime, form: ForecastForm, identity: Identity) -> str:
    """Enqueue a forecast of several or all heliostats, and return the path of its job.

    It takes longer than a request may.
    """
    try:
        payload = FleetForecastIn(heliostats=form.names or None, **form.asked)
    except ValidationError as error:
        raise RequestValidationError(error.errors()) from error
    row = enqueue(runtime, field_forecasts.KIND, payload, identity.name).row
    return f"/jobs/{row.id}"


@router.post("/forecast", dependencies=[OPERATE, COMPUTE_SLOT])
def post_forecast_form(
    form: Annotated[ForecastForm, Form()],
    request: Request,
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Compute and store a forecast, and go to its page."""
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
        form = form.in_utc(zone)
        try:
            position_of(session, form.sun)
        except InvalidInputError as night:
            said = times_in_zone(str(night), zone).removeprefix("at: ")
            raise InvalidInputError(f"moment: {said}") from night
    if len(form.names) != 1:
        return leave_for(request, _ask_for_many(runtime, form, identity))
    asked = ForecastIn(heliostat=form.names[0], **form.asked)
    row = make_forecast(runtime, asked, read_requested_states(runtime, asked))
    return go_to(f"/forecasts/{row.id}")


@router.get("/forecasts/{number}", dependencies=[READ, RENDER_SLOT])
def get_forecast_page(
    number: Annotated[Version, Path(description="Id of the forecast.")],
    request: Request,
    runtime: RuntimeDep,
) -> HTMLResponse:
    """Flux map and metrics of a forecast, with the form for the next one."""
    with runtime.database.reading() as session:
        row = store.get_forecast(session, number)
        choices = _choices(session)
    made, size = forecast_summary(row), size_of(row)
    title = (
        f"Flux of {made.heliostat} on {made.target or 'a plane'}, peak {irradiance(made.peak_w_m2)}"
    )
    surface = "ideal" if row.surface is None else "current"
    filled = ForecastForm.filled(
        made.heliostat, made.target, made.sun, made.at, surface=surface, dni_w_m2=made.dni_w_m2
    )
    flux = (
        charts.flux_map(title, flux_of(row), size, "% per pixel")
        if made.normalised
        else charts.irradiance_map(title, flux_of(row), size)
    )
    more = {"stored": row.document, "chain": loss_chain(row.document["losses"])}
    return _page(request, runtime, choices, filled, forecast=made, flux=flux, **more)
