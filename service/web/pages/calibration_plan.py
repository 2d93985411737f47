"""Page of the calibration plan: which heliostats to photograph, when, and how to aim them."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from model.errors import InvalidInputError
from service.base.fields import FormMoment, plant_time_to_utc
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.pointing.calibration import make_plan
from service.web.auth.dependencies import COMPUTE_SLOT, READ, RuntimeDep
from service.web.responses.pages import render

router = APIRouter(include_in_schema=False, dependencies=[READ])


@router.get("/calibration-plan", dependencies=[COMPUTE_SLOT])
def get_plan_page(
    request: Request,
    runtime: RuntimeDep,
    at: Annotated[FormMoment | None, Query()] = None,
    minutes: Annotated[float, Query(gt=0, le=720)] = 60.0,
    photographs: Annotated[int, Query(ge=1, le=60)] = 12,
) -> HTMLResponse:
    """The next photographs, from now or from another time. The page says so at night."""
    if at is not None:
        with runtime.database.reading() as session:
            at = plant_time_to_utc(at, plant_time_zone(session, runtime.settings.time_zone))
    try:
        slots, trouble = make_plan(runtime, at, minutes, photographs), None
    except InvalidInputError as error:
        slots, trouble = ([], str(error).removeprefix("at: "))  # the form has another label
    return render(
        request,
        "calibration_plan.html",
        slots=slots,
        trouble=trouble,
        at=at,
        minutes=minutes,
        photographs=photographs,
    )
