"""Flux forecasts."""

from typing import Annotated, Any

from fastapi import APIRouter, Body, Depends, Path, Query, Response, status
from fastapi.responses import JSONResponse
from pydantic import Discriminator, Tag

from service import jobs, representations, store
from service.dependencies import OPERATE, READ, IdentityDep, Limit, MediaType, RuntimeDep, require_json
from service.handlers import FleetForecastIn
from service.openapi import arrays, problems
from service.routers.jobs import IdempotencyKey
from service.schemas import ForecastIn, ForecastSummary, JobOut, Name, Page, Version
from service.workflows import ForecastRequest, make_forecast

router = APIRouter(prefix="/forecasts", tags=["forecasts"])

_EXAMPLE: dict[str, Any] = {
    "heliostat": "AA39",
    "target": "multi_focus_tower",
    "sun": {"azimuth_deg": -20.0, "elevation_deg": 45.0},
    "surface": "ideal",
}


def _request(body: ForecastIn) -> ForecastRequest:
    return ForecastRequest(
        heliostat=body.heliostat,
        target=body.target,
        plane=None if body.plane is None else body.plane.named("plane"),
        sun_azimuth_deg=body.sun.azimuth_deg,
        sun_elevation_deg=body.sun.elevation_deg,
        aim=body.aim_point,
        surface=body.surface,
        dni=body.dni_w_m2,
        resolution=body.resolution,
        window=body.window,
        normalised=body.normalised,
        model_version=body.model_version,
    )


def _alternative(body: Any) -> str:
    """Which of the requests a body is meant to be."""
    of_one = "heliostat" in body if isinstance(body, dict) else isinstance(body, ForecastIn)
    return "(one)" if of_one else "(field)"


Asked = Annotated[
    Annotated[ForecastIn, Tag("(one)")] | Annotated[FleetForecastIn, Tag("(field)")],
    Discriminator(_alternative),
    Body(
        openapi_examples={
            "one heliostat": {"value": _EXAMPLE},
            "the field": {"value": {name: _EXAMPLE[name] for name in ("target", "sun", "surface")}},
        }
    ),
]


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    response_model=ForecastSummary,
    responses={
        **problems(404, 409, 413, 415, 429),
        202: {"model": JobOut, "description": "Of many heliostats: the job that superposes them, under its Location."},
    },
    dependencies=[OPERATE, Depends(require_json)],
)
def post_forecast(
    request: Asked, runtime: RuntimeDep, identity: IdentityDep, response: Response, key: IdempotencyKey = None
) -> ForecastSummary | Response:
    """Compute a flux map and keep it; read the map itself from its own path.

    With `heliostat` it is that one's, at once. Without it the job of `/v1/jobs/forecasts` superposes all of the field,
    or those in `heliostats`; its map is read from `/v1/jobs/{number}/flux`.
    """
    if isinstance(request, FleetForecastIn):
        job = jobs.ask_for(runtime, "forecasts", request.model_dump(mode="json"), identity.name, key)
        document = representations.job(job).model_dump(mode="json")
        return JSONResponse(document, status.HTTP_202_ACCEPTED, {"Location": f"/v1/jobs/{job.id}"})
    row = make_forecast(runtime, _request(request))
    response.headers["Location"] = f"/v1/forecasts/{row.id}"
    return representations.forecast_summary(row)


@router.get("", responses=problems(404), dependencies=[READ])
def list_forecasts(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
    heliostat: Annotated[Name | None, Query(description="Only those of this heliostat.")] = None,
) -> Page[ForecastSummary]:
    """Forecasts in the order they were made."""
    with runtime.database.reading() as session:
        of = None if heliostat is None else store.get_heliostat(session, heliostat)
        rows = store.list_forecasts(session, limit + 1, after, of)
    items = [representations.forecast_summary(row) for row in rows]
    return representations.page(items, limit)


@router.get("/{number}", responses={**problems(404, 406), **arrays("`flux` (rows, columns).")}, dependencies=[READ])
def get_forecast(
    number: Annotated[Version, Path(description="Id of the forecast.")], runtime: RuntimeDep, media_type: MediaType
) -> Response:
    """A forecast with its map."""
    with runtime.database.reading() as session:
        row = store.get_forecast(session, number)
    return representations.forecast(row, media_type)
