"""A photograph: what is known of it, the form that corrects or excludes it, and what was made from it."""

from typing import Annotated

from fastapi import APIRouter, Form, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field
from sqlalchemy import select

from service import store
from service.base.fields import AZIMUTH, ELEVATION, FormMoment, Model, Name
from service.store.corrections import EXCLUDED, list_corrections, made_from
from service.store.tables import TargetRow
from service.twin.correcting import Changes, correct
from service.web.answers.pages import go_to, render
from service.web.api.corrections import remake
from service.web.door.dependencies import (
    COMPUTES,
    OPERATE,
    READ,
    IdentityDep,
    MeasurementPath,
    NamePath,
    RuntimeDep,
)

router = APIRouter(include_in_schema=False)

PATH = "/heliostats/{name}/photographs/{measurement}"


class CorrectionForm(Model):
    """The form; its fields hold what is known already."""

    reason: str = Field(min_length=1, max_length=200)
    target_name: Name | None = None
    sun_azimuth: Annotated[float, AZIMUTH] | None = None
    sun_elevation: Annotated[float, ELEVATION] | None = None
    taken_at: FormMoment | None = None
    excluded: bool = False
    remake: bool = False


@router.get(PATH, dependencies=[READ])
def get_photograph_page(
    name: NamePath, measurement: MeasurementPath, request: Request, runtime: RuntimeDep
) -> HTMLResponse:
    """A photograph with its history."""
    with runtime.database.reading() as session:
        row = store.get_measurement(session, store.get_heliostat(session, name), measurement)
        corrections, made = list_corrections(session, row), made_from(session, row)
        targets = session.scalars(select(TargetRow.name).order_by(TargetRow.name)).all()
    return render(
        request,
        "photograph.html",
        name=name,
        row=row,
        is_excluded=row.reason == EXCLUDED,
        corrections=corrections,
        made=made,
        targets=targets,
    )


@router.post(PATH, dependencies=[OPERATE, COMPUTES])
def post_correction_form(
    name: NamePath,
    measurement: MeasurementPath,
    form: Annotated[CorrectionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Correct or exclude a photograph, and go back to it, or to the job that makes the surface anew."""
    changes = Changes(
        reason=form.reason,
        target_name=form.target_name,
        sun_azimuth_deg=form.sun_azimuth,
        sun_elevation_deg=form.sun_elevation,
        taken_at=form.taken_at,
        excluded=form.excluded,
    )
    correct(runtime, name, measurement, changes, identity.name)
    if form.remake:
        return go_to(f"/jobs/{remake(runtime, name, identity.name)}")
    return go_to(f"/heliostats/{name}/photographs/{measurement}")
