"""Alarms, and who has acknowledged them."""

from datetime import datetime
from operator import attrgetter
from typing import Annotated, cast

from fastapi import APIRouter, Body, Depends, Path, Query, Request
from pydantic import BaseModel, Field

from service.base import fields
from service.base.fields import Author, CreatedAt, From, Id, Model, Name, Version, from_row
from service.store import acknowledgements
from service.store.acknowledgements import AcknowledgementBatch, AlarmHistory
from service.twin.alarms.acknowledging import AlarmFilter, acknowledge, undo_acknowledgement
from service.twin.alarms.alarms import Alarm, read_alarms
from service.twin.alarms.common_causes import find_common_causes
from service.twin.alarms.counts import AlarmCount
from service.twin.alarms.reasons import REASONS, Reason, Severity
from service.web.auth.dependencies import (
    OPERATE,
    OVERVIEW_SLOT,
    READ,
    IdentityDep,
    Limit,
    RuntimeDep,
    require_json,
)
from service.web.responses.openapi import problems
from service.web.responses.paging import Page, page

router = APIRouter(prefix="/alarms", tags=["alarms"])

ItemId = Annotated[
    str,
    Field(
        max_length=80,
        pattern=r"^[A-Za-z0-9_-]+:[a-z_]+:[0-9a-f]{8}$",
        description=(
            "The item and its reason as they are now; another where the reason changes or returns."
        ),
        examples=["AA39:moved:1f0c22ab"],
    ),
]


class AlarmOut(BaseModel):
    """Something that an operator should look at."""

    id: ItemId
    reason: Reason = Field(description="What kind of alarm it is.")
    severity: Severity = Field(
        description="By the reason: 1 act now, 2 act today, 3 when there is time."
    )
    heliostat: str | None = Field(description="null: the plant as a whole.")
    since: From
    message: str = Field(description="What is wrong.")
    action: str = Field(description="What to do.")
    measurements: list[str] = Field(
        description="Ids of the heliostat's measurements to look at, where there are some."
    )
    acknowledged_by: str | None = Field(description="Name of the key; null if not acknowledged.")
    acknowledged_at: datetime | None = Field(description="When; null: it is not.")
    acknowledged_reason: str | None = Field(description="Why; null: it is not, or none was given.")
    acknowledgement: int | None = Field(
        description="Number of the acknowledgement, which may be undone; null: there is none."
    )


def alarm_out(item: Alarm) -> AlarmOut:
    """An alarm as JSON."""
    return AlarmOut.model_validate(item, from_attributes=True)


class AlarmPage(Page[AlarmOut]):
    """A part of the list of alarms."""

    computed_at: datetime = Field(description="When a worker last wrote the alarms.")
    pending: int = Field(
        description=(
            "Heliostats of which results are still being computed; at least 1 if something was"
            " stored since the alarms were written. Ask again."
        )
    )


class AcknowledgementsIn(Model):
    """Alarms to acknowledge."""

    ids: list[ItemId] = Field(
        min_length=1, max_length=500, description="Ids of items of `GET /v1/alarms`."
    )
    reason: Annotated[fields.Reason, Field(description="Why they are acknowledged.")]


class AcknowledgementOut(BaseModel):
    """Alarms that were acknowledged together."""

    id: Id
    created_at: CreatedAt
    created_by: Author
    reason: str = Field(description="Why; empty if it was acknowledged before reasons were asked.")
    alarms: dict[Reason, int] = Field(description="Number of alarms by their reason.")
    undone_at: datetime | None = Field(description="When it was undone; null: it was not.")
    undone_by: str | None = Field(description="Name of the key that undid it.")


class AlarmHistoryOut(BaseModel):
    """An alarm from its beginning to its end."""

    id: Id
    reason: Reason = Field(description="What kind of alarm it is.")
    severity: Severity = Field(
        description="By the reason: 1 act now, 2 act today, 3 when there is time."
    )
    heliostat: str | None = Field(description="null: the plant as a whole.")
    since: From
    message: str = Field(description="What is or was wrong.")
    ended_at: datetime | None = Field(
        description="Time of the photograph or the decision that ended it; null: it is present."
    )
    recorded_at: datetime = Field(description="When a worker first wrote it.")
    acknowledgements: list[AcknowledgementOut] = Field(
        description="Its acknowledgements, oldest first; also those that were undone."
    )


After = Annotated[Version | None, Query(description="The last id of the page before.")]

_ID = attrgetter("id")


class CommonCauseOut(BaseModel):
    """Alarms that probably have one cause."""

    alarms: dict[Reason, int] = Field(description="Number of alarms by their reason.")
    first_at: From
    last_at: datetime = Field(description="When the newest of them began.")
    evidence: list[str] = Field(
        description="What the store knows of that time; empty if it knows nothing."
    )
    heliostats: list[str] = Field(description="Names of the heliostats.")
    ids: list[ItemId] = Field(description="Ids of the alarms, to acknowledge them together.")


async def _count(request: Request) -> AlarmCount:
    count: AlarmCount = request.app.state.alarms
    return count


AlarmCountDep = Annotated[AlarmCount, Depends(_count)]


@router.get("", responses=problems(), dependencies=[READ, OVERVIEW_SLOT])
def list_alarms(
    runtime: RuntimeDep,
    reason: Annotated[Reason | None, Query(description="Only this reason.")] = None,
    severity: Annotated[
        int | None, Query(ge=1, le=3, description="Only this severity: 1, 2 or 3.")
    ] = None,
    heliostat: Annotated[Name | None, Query(description="Only this heliostat.")] = None,
    acknowledged: Annotated[
        bool | None, Query(description="Only alarms that are, or are not, acknowledged.")
    ] = None,
    limit: Limit = 100,
    after: Annotated[ItemId | None, Query(description="The last id of the page before.")] = None,
) -> AlarmPage:
    """List alarms, in the order of ids. The thresholds are those of the current settings."""
    with runtime.database.reading() as session:
        items, computed_at, pending = read_alarms(session)
    chosen = AlarmFilter(reason, severity, heliostat, acknowledged).choose(items)
    wanted = sorted((item for item in chosen if after is None or item.id > after), key=_ID)
    part = page([alarm_out(item) for item in wanted[: limit + 1]], limit)
    return AlarmPage(items=part.items, next=part.next, computed_at=computed_at, pending=pending)


@router.post(
    "/acknowledgements",
    responses=problems(404, 413, 415),
    dependencies=[OPERATE, Depends(require_json)],
)
def post_acknowledgements(
    runtime: RuntimeDep, identity: IdentityDep, seen: Annotated[AcknowledgementsIn, Body()]
) -> Page[AlarmOut]:
    """Acknowledge alarms together, with a reason.

    An acknowledgement lasts until the reason of the alarm changes or returns, or until it is
    undone. The first one is kept.
    """
    with runtime.database.reading() as session:
        found = read_alarms(session)
    items = acknowledge(runtime, found, seen.ids, identity.name, seen.reason)
    return Page(items=[alarm_out(item) for item in items], next=None)


@router.get("/acknowledgements", responses=problems(), dependencies=[READ])
def list_acknowledgements(
    runtime: RuntimeDep, limit: Limit = 100, after: After = None
) -> Page[AcknowledgementOut]:
    """List acknowledgements, newest first, also those that were undone."""
    with runtime.database.reading() as session:
        rows = acknowledgements.list_batches(session, limit + 1, after)
    return page([_acknowledgement(row) for row in rows], limit)


@router.post(
    "/acknowledgements/{number}/undo", responses=problems(404, 409), dependencies=[OPERATE]
)
def undo_acknowledgements(
    number: Annotated[Version, Path(description="Number of the acknowledgement.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> AcknowledgementOut:
    """Undo an acknowledgement: its alarms are open again."""
    undo_acknowledgement(runtime, number, identity.name)
    with runtime.database.reading() as session:
        (row,) = acknowledgements.list_batches(session, 1, number=number)
    return _acknowledgement(row)


@router.get("/causes", responses=problems(), dependencies=[READ, OVERVIEW_SLOT])
def list_alarm_causes(runtime: RuntimeDep) -> Page[CommonCauseOut]:
    """List probable causes of open alarms, the one of most first."""
    with runtime.database.reading() as session:
        items = read_alarms(session).alarms
        causes = find_common_causes(session, items, runtime.settings)
    return Page(
        items=[
            from_row(
                CommonCauseOut,
                cause,
                alarms=cause.reasons,
                evidence=list(cause.evidence),
                ids=[alarm.id for alarm in cause.alarms],
            )
            for cause in causes
        ],
        next=None,
    )


@router.get("/history", responses=problems(), dependencies=[READ, OVERVIEW_SLOT])
def list_alarm_history(
    runtime: RuntimeDep,
    reason: Annotated[Reason | None, Query(description="Only this reason.")] = None,
    heliostat: Annotated[Name | None, Query(description="Only this heliostat.")] = None,
    limit: Limit = 100,
    after: After = None,
) -> Page[AlarmHistoryOut]:
    """List alarms that are or were present, the newest first."""
    with runtime.database.reading() as session:
        rows = acknowledgements.list_history(session, limit + 1, after, reason, heliostat)
    return page([_history(row) for row in rows], limit)


def _acknowledgement(row: AcknowledgementBatch) -> AcknowledgementOut:
    return from_row(AcknowledgementOut, row, reason=row.comment, alarms=row.reasons)


def _history(entry: AlarmHistory) -> AlarmHistoryOut:
    made = [
        from_row(
            AcknowledgementOut,
            row,
            id=row.batch,
            created_at=row.made_at,
            created_by=row.made_by,
            reason=row.comment,
            alarms={row.reason: 1},
        )
        for row in entry.acknowledgements
    ]
    severity = REASONS[cast(Reason, entry.row.reason)].severity
    return from_row(
        AlarmHistoryOut,
        entry.row,
        heliostat=entry.heliostat,
        severity=severity,
        acknowledgements=made,
    )
