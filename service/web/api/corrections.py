"""Corrections of photographs: another sun, target or time, or exclusion."""

from typing import Annotated, Self

from fastapi import APIRouter, Depends, Query, Response
from pydantic import BaseModel, Field, model_validator

from service import store
from service.base.fields import (
    Author,
    CreatedAt,
    Flag,
    Model,
    Moment,
    Name,
    Reason,
    Sun,
    Why,
    from_row,
)
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import predictions
from service.jobs.kinds.predictions import PredictionsIn
from service.sources.schema import WeatherFields
from service.store.photographs.correction_log import list_corrections, made_from, newest_correction
from service.store.tables import MeasurementRow
from service.twin.photographs.corrections import GivenCorrection, correct_photograph
from service.twin.photographs.deletion import delete_photograph
from service.twin.runtime.runtime import Runtime
from service.web.api.measurements import MeasurementOut, Motors, measurement_out
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    IdentityDep,
    IfMatch,
    MeasurementPath,
    NamePath,
    RuntimeDep,
    require_json,
    set_tag,
)
from service.web.responses.openapi import problems
from service.web.responses.paging import Page


class CorrectionIn(WeatherFields, Model):
    """New values of a photograph. Fields that are not named stay as they are."""

    reason: Reason = Field(description="Why; kept with the correction.")
    target: Name | None = Field(default=None, description="The target it shows.")
    sun: Sun | None = Field(default=None, description="Where the sun was [deg].")
    taken_at: Moment | None = Field(default=None, description="When it was taken, with zone.")
    motor_position: Motors | None = Field(default=None, description="Of both axes [steps].")
    excluded: Flag | None = Field(
        default=None, description="Whether nothing shall be made from it any more."
    )
    predict_again: Flag = Field(
        default=False, description="Begin a job that predicts the heliostat's surface again."
    )

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.model_fields_set - {"reason", "predict_again"}:
            raise ValueError("name what shall be changed: a field of the photograph, or excluded")
        return self


class CorrectionOut(BaseModel):
    """A correction of a photograph."""

    created_at: CreatedAt
    created_by: Author
    reason: Why
    before: dict[str, object] = Field(description="Previous values, by the fields that changed.")
    after: dict[str, object] = Field(description="New values.")


class DeletedOut(BaseModel):
    """A deleted photograph, and what was made from it."""

    deleted: list[str] = Field(description="Ids of the images that were deleted.")
    surface_versions: list[int] = Field(
        description="Versions of the heliostat's surface that were made from it; they say so."
    )
    forecasts: int = Field(description="How many forecasts were made with those.")


class CorrectedOut(BaseModel):
    """A corrected photograph, and what was made from it before the correction."""

    measurement: MeasurementOut = Field(description="The photograph as it is now.")
    surface_versions: list[int] = Field(
        description="Versions of the heliostat's surface that were made from it as it was."
    )
    forecasts: int = Field(description="How many forecasts were made with those.")
    job: int | None = Field(
        description="The job that predicts the surface again, if one was requested."
    )


def predict_again(runtime: Runtime, heliostat: str, actor: str) -> int:
    """Enqueue a prediction of a heliostat's surface, and return the id of the job.

    The method is that of the active surface.
    """
    with runtime.database.reading() as session:
        today = store.find_surface_at(session, store.get_heliostat(session, heliostat))
    method = "network" if today is not None and today.source == "network" else "refined"
    payload = PredictionsIn(heliostats=[heliostat], method=method)
    return enqueue(runtime, predictions.KIND, payload, actor).row.id


router = APIRouter(prefix="/heliostats/{name}/measurements/{measurement}", tags=["measurements"])


@router.patch(
    "",
    responses=problems(404, 409, 410, 413, 415, 429),
    dependencies=[OPERATE, Depends(require_json), COMPUTE_SLOT],
)
def patch_measurement(
    name: NamePath,
    measurement: MeasurementPath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    correction: CorrectionIn,
    version: IfMatch,
    response: Response,
) -> CorrectedOut:
    """Correct a photograph, or exclude it. This holds for all its images; its history is kept.

    Only the named fields are written, so that corrections of other fields at the same time stay.
    With another target, the photograph is measured again. Surfaces and forecasts that were made
    from it stay, and the response names them. With `predict_again`, a job predicts the
    heliostat's surface again. Another weather outdates no surface, because only calibrations use
    it.
    """
    given = GivenCorrection(
        name,
        measurement,
        reason=correction.reason,
        target=correction.target,
        **({} if correction.sun is None else correction.sun.model_dump()),
        taken_at=correction.taken_at,
        motor_position=correction.motor_position,
        weather=correction.weather,
        excluded=correction.excluded,
    )
    row, _ = correct_photograph(runtime, given, identity.name, version)
    with runtime.database.reading() as session:
        set_tag(response, newest_correction(session, row))
        made, measured = made_from(session, row), measurement_out(session, name, row)
    job = predict_again(runtime, name, identity.name) if correction.predict_again else None
    return CorrectedOut(
        measurement=measured,
        surface_versions=list(made.surfaces),
        forecasts=made.forecasts,
        job=job,
    )


@router.delete("", responses=problems(404), dependencies=[OPERATE])
def delete_measurement(
    name: NamePath,
    measurement: MeasurementPath,
    runtime: RuntimeDep,
    identity: IdentityDep,
    reason: Annotated[Reason, Query(description="Why; kept in the audit trail.")],
    only_this: Annotated[
        bool, Query(description="Delete only this image, not the photograph in all kinds.")
    ] = False,
) -> DeletedOut:
    """Delete a photograph that was sent by mistake.

    All its images are deleted. Its files are deleted when nothing else refers to them. Surfaces
    that were made from it stay, and name it in `deleted`; predict them again. An import of a folder
    that holds the photograph brings it back.
    """
    deleted = delete_photograph(runtime, name, measurement, reason, identity.name, only_this)
    return DeletedOut(
        deleted=list(deleted.images),
        surface_versions=list(deleted.surfaces),
        forecasts=deleted.forecasts,
    )


@router.get("/corrections", responses=problems(404), dependencies=[READ])
def get_corrections(
    name: NamePath, measurement: MeasurementPath, runtime: RuntimeDep
) -> Page[CorrectionOut]:
    """List the corrections of a photograph, oldest first."""
    with runtime.database.reading() as session:
        row: MeasurementRow = store.get_measurement(
            session, store.get_heliostat(session, name), measurement
        )
        items = [from_row(CorrectionOut, one) for one in list_corrections(session, row)]
    return Page(items=items, next=None)
