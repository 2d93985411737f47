"""Jobs: ask for them, follow them, cancel them."""

from functools import partial
from threading import Event
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, HTTPException, Path, Query, Request, Response, status
from pydantic import Field

from service.base.arrays import unpack
from service.base.faults import NotFoundError
from service.base.fields import Rows, State, Version
from service.drawing.pictures import flux_picture
from service.jobs.asking import ask_for, cancel_for, forget_for
from service.jobs.kind import Kind, Kinds, result_of
from service.store import queue
from service.store.job_tables import JobRow
from service.twin.runtime import Runtime
from service.web.answers import formats
from service.web.answers.formats import MediaType, json_answer, maps_answer
from service.web.answers.openapi import TEXT, arrays, problems
from service.web.answers.paging import Page, page
from service.web.answers.representation import Maps
from service.web.answers.watching import JobStream, JobSummary, Watcher, Watchers, job_summary
from service.web.door.dependencies import (
    OPERATE,
    READ,
    IdentityDep,
    KindsDep,
    Limit,
    PresentedDep,
    RuntimeDep,
    StoppingDep,
    require_json,
)


async def _watchers(request: Request) -> Watchers:
    watchers: Watchers = request.app.state.watchers
    return watchers


WatchersDep = Annotated[Watchers, Depends(_watchers)]


class JobOut(JobSummary):
    """A job as it stands, with what was asked and what came of it."""

    payload: dict[str, Any] = Field(description="What was asked.")
    result: dict[str, Any] | None = Field(
        description="What a done job gave, by its kind; of a cancelled or failed one what it had changed until then."
    )


class JobFluxOut(JobOut):
    """A job with the flux map that it gave."""

    flux: Rows = Field(description="(rows, columns) [W/m2].")


def job_out(row: JobRow) -> JobOut:
    """A job as JSON."""
    return JobOut(**dict(job_summary(row)), payload=row.payload, result=row.result)


def job_flux(row: JobRow, media_type: str) -> Response:
    """The flux map of a job; NotFoundError where it has none."""
    if row.arrays is None or row.result is None:
        raise NotFoundError(f"job {row.id} ({row.kind}, {row.state}) has no flux map")
    flux = unpack(row.arrays)["flux"]
    if media_type == formats.JSON:
        return json_answer(job_out(row), flux=flux)
    plane = row.result["plane"]
    picture = partial(flux_picture, flux, (plane["width"], plane["height"]), "W/m²")
    title = f"job {row.id}, {row.result['heliostats']} heliostats"
    return maps_answer(Maps(f"job-{row.id}-flux", title, {"flux": flux}, picture, row.arrays), media_type)


def stream(watchers: Watchers, runtime: Runtime, watcher: Watcher, last: str | None, stopping: Event) -> Response:
    """The events after ``last``; 204, which tells a browser not to come again, where that was the last of all.

    Raises
    ------
    NotFoundError
    """
    seen = int(last[:10]) if last is not None and last.isascii() and last.isdecimal() else 0
    with runtime.database.reading() as session:
        row = queue.get_summary(session, watcher.number)
    if row.state in queue.ENDED and row.revision <= seen:
        return Response(status_code=204)
    # FastAPI's own routes for generators could not answer 204.
    return JobStream(watchers, watcher, seen, stopping)


Number = Annotated[Version, Path(description="Id of the job.")]

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        pattern=r"^[\x21-\x7e]{1,128}$",
        description="Any text of the sender's own: the same request with the same key is the same job.",
    ),
]

KindName = Annotated[str | None, Query(pattern=r"^[a-z]{1,32}$", description="Only jobs of this kind.")]


def creators(kinds: Kinds) -> APIRouter:
    """Routes that ask for a job, one for each of ``kinds``."""
    asking = APIRouter(prefix="/jobs", tags=["jobs"])
    for kind in kinds.values():
        add_creator(asking, kind, f"/{kind.name}", f"post_{kind.name}_job")
        for other, role in ((asking.get, READ), (asking.delete, OPERATE)):
            other(f"/{kind.name}", include_in_schema=False, dependencies=[role])(_only_post)
    return asking


async def _only_post() -> None:
    """There is nothing to read, or to delete, where jobs are asked for."""
    raise HTTPException(status.HTTP_405_METHOD_NOT_ALLOWED, headers={"Allow": "POST"})


def add_creator(router: APIRouter, kind: Kind[Any], path: str, name: str) -> None:
    """A route that asks for a job of this kind."""
    payload_type = kind.payload

    def create(
        payload: payload_type,  # type: ignore[valid-type]
        runtime: RuntimeDep,
        identity: IdentityDep,
        response: Response,
        idempotency_key: IdempotencyKey = None,
    ) -> JobOut:
        if kind.require is not None:
            kind.require(runtime.settings)
        document = payload.model_dump(mode="json")  # type: ignore[attr-defined]
        row = ask_for(runtime, kind.name, document, identity.name, idempotency_key)
        response.headers["Location"] = f"/v1/jobs/{row.id}"
        return job_out(row)

    router.post(
        path,
        name=name,
        summary=kind.summary,
        description=f"{kind.summary} Answers at once; follow the job under its Location.",
        status_code=status.HTTP_202_ACCEPTED,
        responses=problems(409, 413, 415, 429) if kind.require is not None else problems(413, 415, 429),
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
) -> Page[JobSummary]:
    """Jobs in short, newest first; each one whole under its `href`."""
    with runtime.database.reading() as session:
        rows = queue.list_jobs(session, limit + 1, after, state, kind)
    items = [job_summary(row) for row in rows]
    return page(items, limit)


@router.get("/{number}", responses=problems(404), dependencies=[READ])
def get_job(number: Number, runtime: RuntimeDep, kinds: KindsDep) -> JobOut:
    """A job with its progress, and its result when it has ended."""
    with runtime.database.reading() as session:
        row = queue.get_job(session, number)
        return job_out(row).model_copy(update={"result": result_of(kinds, session, row)})


@router.get(
    "/{number}/flux",
    responses={**problems(404, 406), **arrays(JobFluxOut, "`flux` (rows, columns) [W/m2].")},
    dependencies=[READ],
)
def get_job_flux(number: Number, runtime: RuntimeDep, media_type: MediaType) -> Response:
    """The flux map of a job that gave one."""
    with runtime.database.reading() as session:
        row = queue.get_job(session, number, arrays=True)
    return job_flux(row, media_type)


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
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID", description="Go on after this one.")] = None,
) -> Response:
    """The job in short each time it changes, as server-sent events, until it ends."""
    watcher = Watcher(number, identity.name, presented)
    return stream(watchers, runtime, watcher, last_event_id, stopping)


@router.delete("/{number}", responses=problems(404, 409), dependencies=[OPERATE])
def delete_job(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> JobOut:
    """Delete a plan that is done: its result goes, and the job then ends as any other. Other jobs go by their age."""
    return job_out(forget_for(runtime, number, identity.name))


@router.post("/{number}/cancel", responses=problems(404, 409), dependencies=[OPERATE])
def cancel_job(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> JobOut:
    """Cancel a job: at once where it waits; a running one ends at its next report."""
    return job_out(cancel_for(runtime, number, identity.name))
