"""Jobs: enqueue, follow and cancel them, and their pages."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from threading import Event
from typing import Annotated, Any, Literal

from fastapi import (
    APIRouter,
    Depends,
    Header,
    HTTPException,
    Path,
    Query,
    Request,
    Response,
    status,
)
from fastapi.responses import HTMLResponse
from pydantic import Field

from model.fleet import LOSSES
from service.base.arrays import pack, unpack
from service.base.errors import NotFoundError
from service.base.fields import Rows, State, Version
from service.base.validation import KEY
from service.drawing.charts import HeatMap
from service.drawing.pictures import flux_picture
from service.drawing.templates import in_zone
from service.jobs.enqueuing import cancel_for, delete_plan_for, enqueue
from service.jobs.kind import Kind, Kinds, result_of
from service.jobs.kinds.plans import MAX_TIMES, map_name
from service.sources.plant_tables import AIM_COLUMNS, DRIVE_COLUMNS
from service.store import queue
from service.store.job_tables import JobRow
from service.store.sizes import sizes
from service.twin.forecasts.mirror_states import STATE_COLUMNS, state_rows
from service.twin.forecasts.watts import loss_chain
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    KindsDep,
    PresentedDep,
    RuntimeDep,
    StoppingDep,
    require_json,
)
from service.web.resources.job_results import (
    MOST,
    OFFSETS,
    AimView,
    CalibrationView,
    StepNumber,
    aim_rows,
    aim_view,
    calibration_view,
    excess,
    flux_map,
    is_plain,
    payload_in_words,
)
from service.web.responses import formats
from service.web.responses.formats import MediaType, json_answer, maps_answer
from service.web.responses.job_events import JobStream, JobSummary, Watcher, Watchers, job_summary
from service.web.responses.lists import ListQuery, OrderQuery, Page, page, sheet_answer
from service.web.responses.openapi import TEXT, arrays, problems
from service.web.responses.pages import go_to, render
from service.web.responses.representations import Maps


async def _watchers(request: Request) -> Watchers:
    watchers: Watchers = request.app.state.watchers
    return watchers


WatchersDep = Annotated[Watchers, Depends(_watchers)]


class JobOut(JobSummary):
    """The state of a job, with its payload and its result."""

    payload: dict[str, Any] = Field(description="What was asked.")
    result: dict[str, Any] | None = Field(
        description=(
            "What a done job gave, by its kind; of a cancelled or failed one what it had changed"
            " until then."
        )
    )


class JobFluxOut(JobOut):
    """A job with its flux map."""

    flux: Rows = Field(description="(rows, columns) [W/m2].")


def job_out(row: JobRow) -> JobOut:
    """A job as JSON."""
    return JobOut(**dict(job_summary(row)), payload=row.payload, result=row.result)


def job_flux(row: JobRow, packed: bytes | None, media_type: str) -> Response:
    """The flux map of a job; ``packed`` is an npz with `flux`.

    Raises
    ------
    NotFoundError
        If the job has no flux map.
    """
    if packed is None or row.result is None:
        raise NotFoundError(f"job {row.id} ({row.kind}, {row.state}) has no flux map")
    flux = unpack(packed)["flux"]
    if media_type == formats.JSON:
        return json_answer(job_out(row), flux=flux)
    plane = row.result["plane"]
    picture = partial(flux_picture, flux, (plane["width"], plane["height"]), "W/m²")
    title = f"job {row.id}, {row.result['heliostats']} heliostats"
    return maps_answer(
        Maps(f"job-{row.id}-flux", title, {"flux": flux}, picture, packed), media_type
    )


def stream(
    watchers: Watchers, runtime: Runtime, watcher: Watcher, last: str | None, stopping: Event
) -> Response:
    """Stream of the events after the event id ``last``.

    The status is 204 if the job had no later event. A browser then does not reconnect.

    Raises
    ------
    NotFoundError
        If there is no such job.
    """
    seen = int(last[:10]) if last is not None and last.isascii() and last.isdecimal() else 0
    with runtime.database.reading() as session:
        row = queue.get_summary(session, watcher.number)
    if row.state in queue.ENDED and row.revision <= seen:
        return Response(status_code=204)
    # FastAPI routes that are generators could not answer 204.
    return JobStream(watchers, watcher, seen, stopping)


Number = Annotated[Version, Path(description="Id of the job.")]

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        pattern=KEY,
        description=(
            "Any text of the sender's own: the same request with the same key is the same job,"
            " and its second answer has the header `Idempotency-Replayed`."
        ),
    ),
]

KindName = Annotated[
    str | None, Query(pattern=r"^[a-z-]{1,32}$", description="Only jobs of this kind.")
]


def creators(kinds: Kinds) -> APIRouter:
    """Routes that enqueue a job, one for each of ``kinds``."""
    asking = APIRouter(prefix="/jobs", tags=["jobs"])
    for kind in kinds.values():
        _add_creator(asking, kind)
        for other, role in ((asking.get, READ), (asking.delete, OPERATE)):
            other(f"/{kind.name}", include_in_schema=False, dependencies=[role])(_only_post)
    return asking


async def _only_post() -> None:
    """Refuse to read or delete the path that only enqueues jobs."""
    raise HTTPException(status.HTTP_405_METHOD_NOT_ALLOWED, headers={"Allow": "POST"})


def _add_creator(router: APIRouter, kind: Kind[Any]) -> None:
    """Add a route that enqueues a job of this kind."""
    payload_type = kind.payload

    def create(
        payload: payload_type,  # type: ignore[valid-type]
        runtime: RuntimeDep,
        identity: IdentityDep,
        response: Response,
        idempotency_key: IdempotencyKey = None,
    ) -> JobOut:
        row, is_new = enqueue(runtime, kind, payload, identity.name, idempotency_key)
        response.headers["Location"] = f"/v1/jobs/{row.id}"
        if not is_new:
            response.headers["Idempotency-Replayed"] = "true"
        return job_out(row)

    router.post(
        f"/{kind.name}",
        name=f"post_{kind.name.replace('-', '_')}_job",
        summary=kind.summary,
        description=f"{kind.summary} Answers at once; follow the job under its Location.",
        status_code=status.HTTP_202_ACCEPTED,
        responses=(
            problems(404, 409, 413, 415, 429)
            if kind.require is not None
            else problems(404, 413, 415, 429)
        ),
        dependencies=[OPERATE, Depends(require_json)],
    )(create)


router = APIRouter(prefix="/jobs", tags=["jobs"])
pages = APIRouter(include_in_schema=False)

_PAGE = 50


class JobsQuery(ListQuery):
    """Which jobs are listed, newest first by default."""

    state: Annotated[State | None, Query(description="Only jobs in this state.")] = None
    kind: KindName = None
    order: OrderQuery = "down"


@router.get("", responses=problems(), dependencies=[READ])
def list_jobs(query: Annotated[JobsQuery, Query()], runtime: RuntimeDep) -> Page[JobSummary]:
    """List jobs, newest first. The complete job is at its `href`."""
    with runtime.database.reading() as session:
        rows = queue.list_jobs(session, query.portion, query.state, query.kind)
    return page([job_summary(row) for row in rows], query.limit)


@router.get("/{number}", responses=problems(404), dependencies=[READ])
def get_job(number: Number, runtime: RuntimeDep, kinds: KindsDep) -> JobOut:
    """Get a job with its progress and result."""
    with runtime.database.reading() as session:
        row = queue.get_job(session, number)
        return job_out(row).model_copy(update={"result": result_of(kinds, session, row)})


@router.get(
    "/{number}/flux",
    responses={**problems(404, 406), **arrays(JobFluxOut, "`flux` (rows, columns) [W/m2].")},
    dependencies=[READ],
)
def get_job_flux(
    number: Number,
    runtime: RuntimeDep,
    media_type: MediaType,
    step: Annotated[
        int | None,
        Query(
            ge=0,
            lt=MAX_TIMES,
            description="Of a plan or aim plan: which of its `steps`; else the most of all.",
        ),
    ] = None,
    mirrors: Annotated[
        Literal["twin", "ideal"],
        Query(description="Of a plan's step (not of aims): by the twin, or by ideal mirrors."),
    ] = "twin",
) -> Response:
    """Get the flux map of a job, if its kind computes one."""
    with runtime.database.reading() as session:
        row = queue.get_job(session, number, arrays=step is None)
        maps = None if step is None else queue.checkpoint_arrays(session, number, map_name(step))
    if step is None:
        return job_flux(row, row.arrays, media_type)
    if maps is None:
        raise NotFoundError(
            f"step: job {number} ({row.kind}, {row.state}) has no map of a step {step}"
        )
    found = unpack(maps)
    flux = found[mirrors] if mirrors in found else found["flux"]
    return job_flux(row, pack({"flux": flux}), media_type)


@router.get(
    "/{number}/events",
    response_class=Response,
    responses={
        **problems(404),
        200: {
            "description": "Server-sent events `progress` and `end`.",
            "content": {"text/event-stream": {"schema": TEXT}},
        },
        204: {"description": "The job has ended and Last-Event-ID was its last event."},
    },
    dependencies=[READ],
)
def get_job_events(
    number: Number,
    runtime: RuntimeDep,
    watchers: WatchersDep,
    identity: IdentityDep,
    presented: PresentedDep,
    stopping: StoppingDep,
    last_event_id: Annotated[
        str | None, Header(alias="Last-Event-ID", description="Go on after this one.")
    ] = None,
) -> Response:
    """Follow a job as server-sent events. Each has the job summary after a change."""
    watcher = Watcher(number, identity.name, presented)
    return stream(watchers, runtime, watcher, last_event_id, stopping)


@router.delete("/{number}", responses=problems(404, 409), dependencies=[OPERATE])
def delete_job(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> JobOut:
    """Delete the result of a finished plan.

    The job then expires like any other. Other jobs cannot be deleted; they expire by their age.
    """
    return job_out(delete_plan_for(runtime, number, identity.name))


@router.post("/{number}/cancel", responses=problems(404, 409), dependencies=[OPERATE])
def cancel_job(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> JobOut:
    """Cancel a job. A waiting one ends at once, a running one at its next progress report."""
    return job_out(cancel_for(runtime, number, identity.name))


# --- pages
# --------------------------------------------------------------------------------------------------


def stored_sizes(runtime: Runtime) -> dict[str, object]:
    """What the store holds, for the page of jobs."""
    with runtime.database.reading() as session:
        held = sizes(session)
    settings = runtime.settings
    return {
        "held": held,
        "kept": (
            ("accepted", held.accepted, settings.image_retention_days),
            ("refused", held.refused, settings.refused_image_retention_days),
        ),
        "quota_bytes": settings.image_quota_gb * 1e9,
    }


@pages.get("/jobs", dependencies=[READ])
def get_jobs_page(
    request: Request, runtime: RuntimeDep, after: Annotated[Version | None, Query()] = None
) -> HTMLResponse:
    """Jobs, newest first."""
    jobs = list_jobs(JobsQuery(limit=_PAGE, after=after), runtime)
    return render(
        request,
        "jobs.html",
        jobs=jobs.items,
        more=jobs.next,
        after=after,
        is_live=not all(job.has_ended for job in jobs.items),
        **stored_sizes(runtime),
    )


_FACTORS = ("name", *LOSSES, "optical_efficiency", "intercepted_w")

By = Annotated[
    Literal[_FACTORS],  # type: ignore[valid-type]
    Query(description="What the heliostats of a field forecast are sorted by."),
]


def _part(job: JobOut, part: str) -> Any:
    """A part of the result of a job; NotFoundError if it has none."""
    if part not in (job.result or {}):
        raise NotFoundError(f"the result of job {job.id} has no {part}")
    return (job.result or {})[part]


GotJob = Annotated[JobOut, Depends(get_job)]


@pages.get("/jobs/{number}/heliostats.csv", dependencies=[READ])
def get_job_heliostats_table(job: GotJob) -> Response:
    """What becomes of the light of each heliostat of a field forecast."""
    columns = _FACTORS[1:]
    lines = _part(job, "by_heliostat").items()
    rows = ([name, *(one[column] for column in columns)] for name, one in lines)
    return sheet_answer(f"job-{job.id}-heliostats", ("heliostat", *columns), rows)


@pages.get("/jobs/{number}/states.csv", dependencies=[READ])
def get_job_states_table(job: GotJob) -> Response:
    """Measured states of mirrors of a field forecast, for ``heliotwin field --states``."""
    return sheet_answer(f"job-{job.id}-states", STATE_COLUMNS, state_rows(_part(job, "states")))


@pages.get("/jobs/{number}/aims.csv", dependencies=[READ])
def get_job_aims_table(job: GotJob, step: StepNumber = 0) -> Response:
    """The aims of a plan's step, as ``heliotwin field --aims`` reads them, and its drives."""
    result = job.result or {}
    steps = result.get("steps", [result])
    if step >= len(steps) or "aim_points_m" not in steps[step]:
        raise NotFoundError(f"the result of job {job.id} has no aims of a step {step}")
    suffix = f"-step-{step}" if "steps" in result else ""
    columns = (*AIM_COLUMNS, *DRIVE_COLUMNS)
    return sheet_answer(f"job-{job.id}-aims{suffix}", columns, aim_rows(steps[step]))


def _mirrors(result: Mapping[str, Any], by: str) -> list[tuple[str, dict[str, float]]]:
    """The heliostats of a field forecast, sorted by a factor or their name."""
    lines = list(result.get("by_heliostat", {}).items())
    lines.sort(key=(lambda line: line[0]) if by == "name" else (lambda line: line[1][by]))
    return lines


@dataclass(frozen=True)
class JobView:
    """A job on its page, with the payload and the result if they were read."""

    job: JobSummary
    payload: Mapping[str, Any] | None = None
    result: Mapping[str, Any] = field(default_factory=dict)
    flux: HeatMap | None = None
    aims: AimView | None = None
    calibration: CalibrationView | None = None


def read_view(
    runtime: Runtime, kinds: Kinds, number: int, step: int, begin: int, is_update: bool
) -> JobView:
    """Read a job. An update while it runs needs neither the payload nor the result."""
    with runtime.database.reading() as session:
        row = queue.get_summary(session, number)
        if is_update and row.state not in queue.ENDED:
            return JobView(job_summary(row))
        session.expunge(row)
        row = queue.get_job(session, number, arrays=True)
        result = result_of(kinds, session, row) or {}
        return JobView(
            job_summary(row),
            row.payload,
            result,
            flux_map(row),
            aim_view(session, row, step),
            calibration_view(session, row, result, begin),
        )


_LISTS = ("counts", "surfaces", "unchanged", "judged", "warnings")
"""Parts of results that the page shows as they are."""


@pages.get("/jobs/{number}", dependencies=[READ, RENDER_SLOT])
def get_job_page(
    number: Number,
    request: Request,
    runtime: RuntimeDep,
    kinds: KindsDep,
    by: By = "name",
    step: StepNumber = 0,
    page: Annotated[int, Query(ge=1, le=10**6)] = 1,
) -> HTMLResponse:
    """A job, which the page follows until it ends.

    The heliostats of a field forecast are sorted ``by`` their name or a factor, the least first.
    Of a plan of aims the maps of one ``step`` are shown, and of long lists one ``page``.
    """
    begin, is_update = (page - 1) * MOST, "hx-request" in request.headers
    view = read_view(runtime, kinds, number, step, begin, is_update)
    job, result, calibration = view.job, view.result, view.calibration
    mirrors, skipped = _mirrors(result, by), {} if calibration else result.get("skipped", {})
    lists = mirrors, skipped, *(result.get(name, ()) for name in ("surfaces", "unchanged"))
    longest = calibration.longest if calibration else max(map(len, lists))
    return render(
        request,
        "job.html",
        job=job,
        is_live=not job.has_ended,
        asked=None if view.payload is None else payload_in_words(view.payload),
        flux=view.flux,
        has_changed=any(result.values()),
        chain=loss_chain(result["field"]) if result.get("field") else [],
        mirrors=mirrors[begin : begin + MOST],
        n_measured=len(result.get("states", ())),
        n_mirrors=len(mirrors),
        factors=_FACTORS,
        by=by,
        light=result if job.kind == "forecasts" and "peak_w_m2" in result else None,
        aims=view.aims,
        calibration=calibration,
        offsets=OFFSETS,
        excess=excess,
        in_zone=in_zone(result.get("time_zone") or runtime.settings.time_zone),
        target=(view.payload or {}).get("target"),
        facts={name: value for name, value in result.items() if is_plain(value)},
        **{name: result.get(name, {}) for name in _LISTS},
        skipped=skipped,
        shown=MOST,
        begin=begin,
        page=page,
        last=math.ceil(longest / MOST),
        link=lambda page: f"/jobs/{job.id}?by={by}&step={step}&page={page}#result-title",
    )


@pages.post("/jobs/{number}/cancel", dependencies=[OPERATE])
def post_cancel_form(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Cancel a job, and go to its page."""
    cancel_job(number, runtime, identity)
    return go_to(f"/jobs/{number}")
