"""Jobs: ask for them, follow them, cancel them."""

import json
import threading
import time
from collections.abc import AsyncIterator
from datetime import datetime
from functools import partial
from typing import Annotated, Any

import anyio
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, Header, HTTPException, Path, Query, Response, status
from fastapi.sse import EventSourceResponse, format_sse_event
from pydantic import BaseModel, Field

from service.base.arrays import unpack
from service.base.faults import NotFoundError
from service.base.fields import State, Version
from service.drawing.pictures import flux_picture
from service.jobs.asking import ask_for, cancel_for
from service.jobs.kind import Kind, Kinds
from service.store import queue
from service.store.tables import JobRow
from service.twin.runtime import Runtime
from service.web.answers import formats
from service.web.answers.formats import MediaType, json_answer, maps_answer
from service.web.answers.openapi import arrays, problems
from service.web.answers.paging import Page, page
from service.web.answers.representation import Maps
from service.web.door.dependencies import OPERATE, READ, IdentityDep, Limit, RuntimeDep, StoppingDep, require_json


class JobOut(BaseModel):
    """A job as it stands."""

    id: int
    kind: str
    state: State = Field(description="queued, running, then for good done, failed or cancelled.")
    payload: dict[str, Any] = Field(description="What was asked.")
    progress: float = Field(description="Share that is done, 0 to 1 [1].")
    message: str = Field(description="What is being done.")
    attempts: int = Field(description="How often it was begun.")
    cancel_requested: bool = Field(description="It ends as soon as its worker sees this.")
    reason: str | None = Field(description="Why it failed, or why it is tried again.")
    result: dict[str, Any] | None = Field(description="What a done job gave; by its kind.")
    created_by: str = Field(description="Name of the key that asked for it.")
    created_at: datetime
    not_before: datetime = Field(description="When it is tried next at the earliest.")
    started_at: datetime | None
    finished_at: datetime | None


def job_out(row: JobRow) -> JobOut:
    """A job as JSON."""
    return JobOut.model_validate(row, from_attributes=True)


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


# How often the store is asked for news [s], and after how much silence a comment keeps the connection open [s].
_LOOK_EVERY_S = 0.5
_COMMENT_EVERY_S = 15.0

# Their own threads, so that many watchers do not keep the routes waiting.
_watchers = CapacityLimiter(4)


def _look(runtime: Runtime, number: int, seen: int) -> tuple[int, bool, str] | None:
    """Revision, whether the job has ended, and its state as JSON; None where nothing is newer than ``seen``."""
    with runtime.database.reading() as session:
        row = queue.get_job(session, number)
    if row.revision <= seen:
        return None
    return row.revision, row.state in queue.ENDED, json.dumps(job_out(row).model_dump(mode="json"))


async def _events(runtime: Runtime, number: int, seen: int, stopping: threading.Event) -> AsyncIterator[bytes]:
    """The job each time it has changed, numbered by its revision, until its end; comments in between."""
    quiet_since = time.monotonic()
    yield format_sse_event(retry=2000)
    while not stopping.is_set():
        news = await to_thread.run_sync(_look, runtime, number, seen, limiter=_watchers)
        if news is not None:
            seen, has_ended, document = news
            yield format_sse_event(data_str=document, event="end" if has_ended else "progress", id=str(seen))
            if has_ended:
                return
            quiet_since = time.monotonic()
        elif time.monotonic() - quiet_since > _COMMENT_EVERY_S:
            yield format_sse_event(comment="still here")
            quiet_since = time.monotonic()
        await anyio.sleep(_LOOK_EVERY_S)


def stream(runtime: Runtime, number: int, last_event_id: str | None, stopping: threading.Event) -> Response:
    """The events after ``last_event_id``; 204, which tells a browser not to come again, where the last was seen.

    Raises
    ------
    NotFoundError
    """
    is_number = last_event_id is not None and last_event_id.isascii() and last_event_id.isdecimal()
    seen = int(last_event_id[:10]) if last_event_id is not None and is_number else 0
    with runtime.database.reading() as session:
        row = queue.get_job(session, number)
    if row.state in queue.ENDED and row.revision <= seen:
        return Response(status_code=204)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    # FastAPI's own routes for generators could not answer 204.
    return EventSourceResponse(_events(runtime, number, seen, stopping), headers=headers)


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
        asking.get(f"/{kind.name}", include_in_schema=False, dependencies=[READ])(_only_post)
    return asking


async def _only_post() -> None:
    """There is nothing to read where jobs are asked for."""
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
        responses=problems(413, 415, 429),
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
) -> Page[JobOut]:
    """Jobs, newest first."""
    with runtime.database.reading() as session:
        rows = queue.list_jobs(session, limit + 1, after, state, kind)
    items = [job_out(row) for row in rows]
    return page(items, limit)


@router.get("/{number}", responses=problems(404), dependencies=[READ])
def get_job(number: Number, runtime: RuntimeDep) -> JobOut:
    """A job with its progress, and its result when it is done."""
    with runtime.database.reading() as session:
        return job_out(queue.get_job(session, number))


@router.get(
    "/{number}/flux",
    responses={**problems(404, 406), **arrays("`flux` (rows, columns) [W/m2].")},
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
    return stream(runtime, number, last_event_id, stopping)


@router.post("/{number}/cancel", responses=problems(404, 409), dependencies=[OPERATE])
def cancel_job(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> JobOut:
    """Cancel a job: at once where it waits; a running one ends at its next report."""
    return job_out(cancel_for(runtime, number, identity.name))
