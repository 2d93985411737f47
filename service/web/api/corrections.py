"""Corrections of photographs: another sun, target or time, or that nothing shall be made from one."""

from datetime import datetime
from typing import Annotated, Any, Self

from fastapi import APIRouter, Body, Depends
from pydantic import BaseModel, Field, model_validator

from model.pointing import Weather
from service import store
from service.base.fields import Azimuth, Elevation, Flag, Model, Moment, Name
from service.jobs.asking import ask_for
from service.jobs.kinds.predictions import PredictionsIn
from service.store.corrections import list_corrections, made_from
from service.store.tables import CorrectionRow, MeasurementRow
from service.twin.correcting import Changes, correct
from service.twin.runtime import Runtime
from service.web.answers.openapi import problems
from service.web.api.measurements import MeasurementOut, Motors, Temperature, WindFrom, WindSpeed, measurement_out
from service.web.door.dependencies import (
    COMPUTES,
    OPERATE,
    READ,
    IdentityDep,
    MeasurementPath,
    NamePath,
    RuntimeDep,
    require_json,
)


class CorrectionIn(Model):
    """What shall be known of a photograph instead; what is not named stays as it is."""

    reason: str = Field(min_length=1, max_length=200, description="Why; kept with the correction.")
    target_name: Name | None = None
    sun_azimuth: Azimuth | None = Field(default=None, description="From south, positive to the east [deg].")
    sun_elevation: Elevation | None = Field(default=None, description="[deg]")
    taken_at: Moment | None = None
    motor_position: Motors | None = Field(default=None, description="Of both axes [steps].")
    wind_speed_m_s: WindSpeed | None = Field(default=None, description="[m/s]")
    wind_from_deg: WindFrom | None = Field(default=None, description="From north, over east [deg].")
    temperature_c: Temperature | None = Field(default=None, description="[°C]")
    excluded: Flag | None = Field(default=None, description="Whether nothing shall be made from it any more.")
    remake: Flag = Field(default=False, description="Begin a job that makes the heliostat's surface anew.")

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.model_fields_set - {"reason", "remake"}:
            raise ValueError("name what shall be changed: a field of the photograph, or excluded")
        return self


class CorrectionOut(BaseModel):
    """What somebody corrected."""

    made_at: datetime
    made_by: str
    reason: str
    before: dict[str, Any] = Field(description="What stood there, by the fields that changed.")
    after: dict[str, Any] = Field(description="What stands there instead.")


class CorrectedOut(BaseModel):
    """A corrected photograph, and what had been made from it before."""

    measurement: MeasurementOut
    surfaces: list[int] = Field(description="Versions of the heliostat's surface that were made from it as it was.")
    forecasts: int = Field(description="How many forecasts were made with those.")
    job: int | None = Field(description="The job that makes the surface anew, where one was asked for.")


def correction_out(row: CorrectionRow) -> CorrectionOut:
    """A correction as JSON."""
    return CorrectionOut.model_validate({name: getattr(row, name) for name in CorrectionOut.model_fields})


def remake(runtime: Runtime, heliostat: str, actor: str) -> int:
    """Ask for the job that makes a heliostat's surface anew, by the method of the one that it has."""
    with runtime.database.reading() as session:
        today = store.find_surface_at(session, store.get_heliostat(session, heliostat))
    method = "network" if today is not None and today.source == "network" else "refined"
    payload = PredictionsIn(heliostats=[heliostat], method=method)
    return ask_for(runtime, "predictions", payload.model_dump(mode="json"), actor).id


router = APIRouter(prefix="/heliostats/{name}/measurements/{measurement}", tags=["measurements"])


@router.patch(
    "", responses=problems(404, 409, 410, 413, 415, 429), dependencies=[OPERATE, Depends(require_json), COMPUTES]
)
def patch_measurement(
    name: NamePath,
    measurement: MeasurementPath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    correction: Annotated[
        CorrectionIn, Body(examples=[{"sun_azimuth": -41.2, "reason": "the clock was an hour ahead", "remake": True}])
    ],
) -> CorrectedOut:
    """Correct what is known of a photograph, or exclude it, in all its images; its history is kept.

    With another target it is measured anew. What was made from it stays, and is named here; with `remake` a job makes
    the heliostat's surface anew. Another weather outdates no surface: only calibrations ask for it.
    """
    changes = Changes(
        reason=correction.reason,
        target_name=correction.target_name,
        sun_azimuth_deg=correction.sun_azimuth,
        sun_elevation_deg=correction.sun_elevation,
        taken_at=correction.taken_at,
        motor_position=correction.motor_position,
        weather=Weather(correction.wind_speed_m_s, correction.wind_from_deg, correction.temperature_c),
        excluded=correction.excluded,
    )
    row = correct(runtime, name, measurement, changes, identity.name)
    with runtime.database.reading() as session:
        made = made_from(session, row)
    job = remake(runtime, name, identity.name) if correction.remake else None
    return CorrectedOut(
        measurement=measurement_out(name, row), surfaces=list(made.surfaces), forecasts=made.forecasts, job=job
    )


@router.get("/corrections", responses=problems(404), dependencies=[READ])
def get_corrections(name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep) -> list[CorrectionOut]:
    """What was corrected of a photograph, the first correction first."""
    with runtime.database.reading() as session:
        row: MeasurementRow = store.get_measurement(session, store.get_heliostat(session, name), measurement)
        return [correction_out(correction) for correction in list_corrections(session, row)]
