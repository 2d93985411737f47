"""The calibration plan: which heliostats to photograph next, when, and where their motors stand then."""

from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from model.errors import InvalidInputError
from service.base.fields import FormMoment
from service.twin.pointing import make_plan
from service.web.answers.pages import render
from service.web.door.dependencies import COMPUTES, READ, RuntimeDep

router = APIRouter(include_in_schema=False, dependencies=[READ])


@router.get("/calibration-plan", dependencies=[COMPUTES])
def get_plan_page(
    request: Request,
    runtime: RuntimeDep,
    at: Annotated[FormMoment | None, Query()] = None,
    minutes: Annotated[float, Query(gt=0, le=720)] = 60.0,
    photographs: Annotated[int, Query(ge=1, le=60)] = 12,
) -> HTMLResponse:
    """The next photographs, from now or from a moment on; at night the page says so."""
    try:
        slots, trouble = make_plan(runtime, at, minutes, photographs), None
    except InvalidInputError as error:
        slots, trouble = [], str(error).removeprefix("at: ")  # the form calls it otherwise
    return render(
        request,
        "calibration_plan.html",
        slots=slots,
        trouble=trouble,
        at=at,
        minutes=minutes,
        photographs=photographs,
    )
