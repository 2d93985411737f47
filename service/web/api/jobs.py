"""Jobs: enqueue, follow and cancel them."""

from functools import partial
from threading import Event
from typing import Annotated, Any, Literal

from fastapi import (
    APIRouter,
    Depends,
    File,
    Header,
    HTTPException,
    Path,
    Query,
    Request,
    Response,
    UploadFile,
    status,
)
from pydantic import Field

from service.base.arrays import pack, unpack
from service.base.errors import NotFoundError
from service.base.fields import Rows, State, Text, Version
from service.base.names import KEY
from service.drawing.pictures import flux_picture
from service.jobs.enqueuing import cancel_for, delete_plan_for, enqueue
from service.jobs.kind import Kind, Kinds, result_of
from service.jobs.kinds.plans import MAX_TIMES, map_name
from service.jobs.uploads import UploadedFolder, delete_upload, list_uploads, receive_upload
from service.store.job_tables import JobRow
from service.store.jobs import queue
from service.store.listing import Order, Period
from service.twin.runtime.runtime import Runtime
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    IdentityDep,
    KindsDep,
    Limit,
    PresentedDep,
    RuntimeDep,
    StoppingDep,
    accept_archive,
    require_json,
)
from service.web.responses import formats
from service.web.responses.formats import MediaType, json_answer, maps_answer
from service.web.responses.job_events import JobStream, JobSummary, Watcher, Watchers, job_summary
from service.web.responses.openapi import TEXT, arrays, problems
from service.web.responses.paging import OrderQuery, Page, Since, Until, page
from service.web.responses.representation import Maps


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


@router.get("", responses=problems(), dependencies=[READ])
def list_jobs(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
    state: Annotated[State | None, Query(description="Only jobs in this state.")] = None,
    kind: KindName = None,
    since: Since = None,
    until: Until = None,
    order: OrderQuery = "down",
) -> Page[JobSummary]:
    """List jobs, newest first. The complete job is at its `href`."""
    with runtime.database.reading() as session:
        asked, direction = Period(since, until), Order(descending=order == "down")
        rows = queue.list_jobs(
            session, limit + 1, after, state, kind, created=asked, order=direction
        )
    items = [job_summary(row) for row in rows]
    return page(items, limit)


@router.post(
    "/imports/uploads",
    status_code=status.HTTP_201_CREATED,
    responses=problems(413, 415, 429, 507),
    dependencies=[OPERATE, Depends(accept_archive), COMPUTE_SLOT],
)
def post_import_upload(
    file: Annotated[UploadFile, File(description="ZIP file of a measurement folder.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> UploadedFolder:
    """Upload a measurement folder for an import.

    `POST /v1/jobs/imports` imports it, with its `folder` and `uploaded`. It is deleted when its
    import has ended, or after a day without one.
    """
    return receive_upload(runtime, file.file, file.filename or "", identity.name)


@router.get("/imports/uploads", responses=problems(), dependencies=[READ])
def list_import_uploads(runtime: RuntimeDep) -> Page[UploadedFolder]:
    """List the uploaded measurement folders."""
    return Page(items=list_uploads(runtime), next=None)


@router.delete(
    "/imports/uploads/{name}",
    status_code=status.HTTP_204_NO_CONTENT,
    responses=problems(404, 409),
    dependencies=[OPERATE],
)
def delete_import_upload(
    name: Annotated[Text, Path(description="Name of the upload.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> None:
    """Delete an uploaded measurement folder, unless a job is to import it."""
    delete_upload(runtime, name, identity.name)


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
