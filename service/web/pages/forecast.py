"""Forecasts: a form, and the flux map that comes of it."""

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, Literal, Self

from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field, model_validator
from sqlalchemy import select
from sqlalchemy.orm import Session

from model.ephemeris import sun_angles_at
from service import store
from service.base.faults import NotFoundError
from service.base.fields import AZIMUTH, ELEVATION, FormMoment, Model, Name, Sun, SunAt, Version
from service.drawing import charts
from service.drawing.templates import in_zone
from service.jobs.asking import ask_for
from service.jobs.kinds.field_forecasts import FleetForecastIn
from service.store import queue
from service.store.columns import now
from service.store.job_tables import JobRow
from service.store.tables import PlantRow, ReceiverRow, TargetRow
from service.twin.forecast import ForecastRequest, flux_of, make_forecast, position_of
from service.twin.runtime import Runtime
from service.web.answers.pages import go_to, leave_for, render
from service.web.door.dependencies import COMPUTES, DRAWS, OPERATE, READ, IdentityDep, RuntimeDep
from service.web.door.security import Identity

router = APIRouter(include_in_schema=False)

_RECENT = 10

# Heliostats that the form offers at a time: those whose names begin as what is typed does.
_OFFERED = 20


@dataclass(frozen=True)
class Made:
    """A line of the list of forecasts: where it is, and what is in it."""

    path: str
    name: str
    of: str
    target: str | None
    sun_deg: tuple[float | None, float | None]
    peak_w_m2: float
    created_at: datetime


class ForecastForm(Model):
    """The form; without a heliostat it means all of them."""

    heliostat: Name | None = None
    target: Name
    sun_by: Literal["position", "time"] = "position"
    azimuth_deg: Annotated[float, AZIMUTH] | None = None
    elevation_deg: Annotated[float, ELEVATION] | None = None
    moment: FormMoment | None = None
    surface: Literal["current", "ideal"] = "current"
    dni_w_m2: float = Field(default=1000.0, gt=0, le=2000)

    @model_validator(mode="after")
    def _says_when_or_where(self) -> Self:
        if self.sun_by == "time" and self.moment is None:
            raise ValueError("moment: say when")
        if self.sun_by == "position" and self.moment is not None:
            raise ValueError("moment: a time and a position are both given; choose by the time, or empty the time")
        if self.sun_by == "position" and (self.azimuth_deg is None or self.elevation_deg is None):
            raise ValueError("azimuth_deg, elevation_deg: say where the sun stands")
        return self

    @property
    def sun(self) -> Sun | SunAt:
        """What was asked for."""
        if self.sun_by == "time":
            assert self.moment is not None
            return SunAt(at=self.moment)
        assert self.azimuth_deg is not None
        assert self.elevation_deg is not None
        return Sun(azimuth_deg=self.azimuth_deg, elevation_deg=self.elevation_deg)


def sun_now(plant: PlantRow | None) -> tuple[float, float]:
    """Where the sun stands now, [deg]; at night, or without a plant, a high sun in the south."""
    if plant is None:
        return 0.0, 45.0
    azimuth, elevation = sun_angles_at(now(), plant.latitude_deg, plant.longitude_deg)
    return (round(azimuth, 2), round(elevation, 2)) if elevation > 5 else (0.0, 45.0)


def _choices(session: Session) -> dict[str, Any]:
    return {
        "heliostats": store.list_heliostats(session, _OFFERED),
        "targets": session.scalars(select(TargetRow.name).order_by(TargetRow.name)).all(),
        "receivers": session.scalars(select(ReceiverRow.name).order_by(ReceiverRow.name)).all(),
        "recent": _recent(session),
    }


def _recent(session: Session) -> list[Made]:
    """The newest forecasts, of one heliostat and of many, the newest first."""
    of_one = [
        Made(
            f"/forecasts/{row.id}",
            str(row.id),
            row.heliostat.name,
            row.target_name,
            (row.sun_azimuth_deg, row.sun_elevation_deg),
            row.peak_w_m2,
            row.created_at,
        )
        for row in store.recent_forecasts(session, _RECENT)
    ]
    of_many = [
        Made(
            f"/jobs/{row.job}",
            f"job {row.job}",
            f"{row.heliostats} together",
            row.target,
            (row.sun_azimuth_deg, row.sun_elevation_deg),
            row.peak_w_m2,
            row.created_at,
        )
        for row in store.recent_field_forecasts(session, _RECENT)
    ]
    return sorted([*of_one, *of_many], key=lambda made: made.created_at, reverse=True)[:_RECENT]


def _filled(**known: Any) -> dict[str, Any]:
    """What stands in the form: what is ``known``, and else what is likely."""
    likely = {"target": None, "surface": "current", "dni_w_m2": 1000.0}
    return {**likely, "sun_by": "position", "moment": None, **known}


@router.get("/forecast/heliostats", dependencies=[READ])
def get_offered_heliostats(
    request: Request,
    runtime: RuntimeDep,
    heliostat: Annotated[str, Query(max_length=32)] = "",
    after: Annotated[Name | None, Query(description="The last name of the list before.")] = None,
) -> HTMLResponse:
    """The first names that begin as ``heliostat`` does, as the form offers them."""
    with runtime.database.reading() as session:
        rows = store.list_heliostats(session, _OFFERED, after, heliostat)
    return render(request, "offered.html", heliostats=rows)


@router.get("/forecast", dependencies=[READ])
def get_forecast_form(
    request: Request,
    runtime: RuntimeDep,
    heliostat: Annotated[Name | None, Query()] = None,
    job: Annotated[Version | None, Query()] = None,
) -> HTMLResponse:
    """The form, empty but for what is likely, or as a ``job`` was asked for by it."""
    with runtime.database.reading() as session:
        choices = _choices(session)
        if job is not None:
            filled = _filled_as(session, queue.get_job(session, job))
            return _page(request, runtime, choices, filled, forecast=None)
        azimuth, elevation = sun_now(session.get(PlantRow, 1))
    first = next((row.name for row in choices["heliostats"]), "")
    filled = _filled(heliostat=heliostat or first, azimuth_deg=azimuth, elevation_deg=elevation)
    return _page(request, runtime, choices, filled, forecast=None)


def _filled_as(session: Session, job: JobRow) -> dict[str, Any]:
    """What the form of a forecast of all heliostats held."""
    if job.kind != "forecasts":
        raise NotFoundError(f"job {job.id} is no forecast")
    asked = FleetForecastIn.model_validate(job.payload)
    sun = position_of(session, asked.sun)
    return _filled(
        heliostat="",
        target=asked.target,
        azimuth_deg=round(sun.azimuth_deg, 3),
        elevation_deg=round(sun.elevation_deg, 3),
        surface=asked.surface,
        dni_w_m2=asked.dni_w_m2,
        **({"sun_by": "time", "moment": asked.sun.at} if isinstance(asked.sun, SunAt) else {}),
    )


def _page(
    request: Request, runtime: Runtime, choices: dict[str, Any], filled: dict[str, Any], **shown: Any
) -> HTMLResponse:
    zone = runtime.settings.time_zone
    return render(request, "forecast.html", **choices, filled=filled, zone=zone, in_zone=in_zone(zone), **shown)


def _ask_for_all(runtime: Runtime, form: ForecastForm, identity: Identity) -> str:
    """All heliostats take longer than a request may: the path of the job."""
    payload = FleetForecastIn(target=form.target, sun=form.sun, surface=form.surface, dni_w_m2=form.dni_w_m2)
    row = ask_for(runtime, "forecasts", payload.model_dump(mode="json"), identity.name)
    return f"/jobs/{row.id}"


@router.post("/forecast", dependencies=[OPERATE, COMPUTES])
def post_forecast_form(
    form: Annotated[ForecastForm, Form()], request: Request, runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Compute and keep a forecast, and go to its page."""
    with runtime.database.reading() as session:
        sun = position_of(session, form.sun)
    if form.heliostat is None:
        return leave_for(request, _ask_for_all(runtime, form, identity))
    asked = ForecastRequest(
        heliostat=form.heliostat,
        target=form.target,
        sun_azimuth_deg=sun.azimuth_deg,
        sun_elevation_deg=sun.elevation_deg,
        sun_at=form.moment if form.sun_by == "time" else None,
        surface=form.surface,
        dni=form.dni_w_m2,
    )
    return go_to(f"/forecasts/{make_forecast(runtime, asked).id}")


@router.get("/forecasts/{number}", dependencies=[READ, DRAWS])
def get_forecast_page(
    number: Annotated[Version, Path(description="Id of the forecast.")], request: Request, runtime: RuntimeDep
) -> HTMLResponse:
    """A forecast's flux map and figures, with the form for the next one."""
    with runtime.database.reading() as session:
        row = store.get_forecast(session, number)
        choices = _choices(session)
    size = (row.window_m or row.plane["width"], row.window_m or row.plane["height"])
    unit = "% per pixel" if row.normalised else "W/m²"
    title = f"Flux of {row.heliostat.name} on {row.target_name or 'a plane'}, peak {row.peak_w_m2:.0f} W/m²"
    filled = _filled(
        heliostat=row.heliostat.name,
        target=row.target_name,
        sun_by="position" if row.sun_at is None else "time",
        azimuth_deg=round(row.sun_azimuth_deg, 3),
        elevation_deg=round(row.sun_elevation_deg, 3),
        moment=row.sun_at,
        surface="ideal" if row.surface is None else "current",
        dni_w_m2=row.dni_w_m2,
    )
    flux = charts.flux_map(title, flux_of(row), size, unit)
    return _page(request, runtime, choices, filled, forecast=row, flux=flux)
