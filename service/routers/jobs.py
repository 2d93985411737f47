"""Jobs: ask for them, follow them, cancel them."""

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Response, status

from service import events, jobs, representations
from service.dependencies import OPERATE, READ, IdentityDep, Limit, MediaType, RuntimeDep, StoppingDep, require_json
from service.openapi import arrays, problems
from service.schemas import JobOut, Page, State, Version
from service.workers import Kind, Kinds

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


def make_router(kinds: Kinds) -> APIRouter:
    """The routes, with one to ask for a job of each of ``kinds``."""
    router = APIRouter(prefix="/jobs", tags=["jobs"])
    for kind in kinds.values():
        add_creator(router, kind, f"/{kind.name}", f"post_{kind.name}_job")
    both = APIRouter()
    both.include_router(router)
    both.include_router(_existing)
    return both


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
        document = payload.model_dump(mode="json")  # type: ignore[attr-defined]
        row = jobs.ask_for(runtime, kind.name, document, identity.name, idempotency_key)
        response.headers["Location"] = f"/v1/jobs/{row.id}"
        return representations.job(row)

    router.post(
        path,
        name=name,
        summary=kind.summary,
        description=f"{kind.summary} Answers at once; follow the job under its Location.",
        status_code=status.HTTP_202_ACCEPTED,
        responses=problems(413, 415, 429),
        dependencies=[OPERATE, Depends(require_json)],
    )(create)


_existing = APIRouter(prefix="/jobs", tags=["jobs"])


@_existing.get("", responses=problems(), dependencies=[READ])
def list_jobs(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
    state: Annotated[State | None, Query(description="Only jobs in this state.")] = None,
    kind: KindName = None,
) -> Page[JobOut]:
    """Jobs, newest first."""
    with runtime.database.reading() as session:
        rows = jobs.list_jobs(session, limit + 1, after, state, kind)
    items = [representations.job(row) for row in rows]
    return representations.page(items, limit)


@_existing.get("/{number}", responses=problems(404), dependencies=[READ])
def get_job(number: Number, runtime: RuntimeDep) -> JobOut:
    """A job with its progress, and its result when it is done."""
    with runtime.database.reading() as session:
        return representations.job(jobs.get_job(session, number))


@_existing.get(
    "/{number}/flux",
    responses={**problems(404, 406), **arrays("`flux` (rows, columns) [W/m2].")},
    dependencies=[READ],
)
def get_job_flux(number: Number, runtime: RuntimeDep, media_type: MediaType) -> Response:
    """The flux map of a job that gave one."""
    with runtime.database.reading() as session:
        row = jobs.get_job(session, number, arrays=True)
    return representations.job_flux(row, media_type)


@_existing.get(
    "/{number}/events",
    response_class=Response,
    responses={
        **problems(404),
        200: {"description": "Server-sent events `progress` and `end`.", "content": {"text/event-stream": {}}},
        204: {"description": "The job has ended and Last-Event-ID was its last event."},
    },
    dependencies=[READ],
)
def get_job_events(
    number: Number,
    runtime: RuntimeDep,
    stopping: StoppingDep,
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID", description="Go on after this one.")] = None,
) -> Response:
    """The job each time it changes, as server-sent events, until it ends."""
    return events.stream(runtime, number, last_event_id, stopping)


@_existing.post("/{number}/cancel", responses=problems(404, 409), dependencies=[OPERATE])
def cancel_job(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> JobOut:
    """Cancel a job: at once where it waits; a running one ends at its next report."""
    return representations.job(jobs.cancel_for(runtime, number, identity.name))
