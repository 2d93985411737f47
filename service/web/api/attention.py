"""Alerts, and who has acknowledged them."""

from datetime import datetime
from operator import attrgetter
from typing import Annotated

from fastapi import APIRouter, Body, Depends, Query, Request
from pydantic import BaseModel, Field

from service.base.fields import From, Model
from service.twin.alerts.alerts import Alert, AlertCount, acknowledge, list_alerts
from service.twin.alerts.reasons import Reason, Severity
from service.web.auth.dependencies import (
    OPERATE,
    OVERVIEW_SLOT,
    READ,
    FieldCacheDep,
    IdentityDep,
    Limit,
    RuntimeDep,
    require_json,
)
from service.web.responses.openapi import problems
from service.web.responses.paging import Page, page

router = APIRouter(prefix="/attention", tags=["attention"])

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


class AttentionOut(BaseModel):
    """An alert: something that needs attention."""

    id: ItemId
    reason: Reason = Field(description="What kind of alert it is.")
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


def attention_out(item: Alert) -> AttentionOut:
    """An alert as JSON."""
    return AttentionOut.model_validate(item, from_attributes=True)


class AttentionPage(Page[AttentionOut]):
    """A part of the list of alerts."""

    pending: int = Field(
        description="Heliostats whose pointing error is still being computed; ask again for them."
    )


class AcknowledgementsIn(Model):
    """Alerts to acknowledge."""

    ids: list[ItemId] = Field(
        min_length=1, max_length=500, description="Ids of items of `GET /v1/attention`."
    )


async def _count(request: Request) -> AlertCount:
    count: AlertCount = request.app.state.attention
    return count


AttentionCountDep = Annotated[AlertCount, Depends(_count)]


@router.get("", responses=problems(), dependencies=[READ, OVERVIEW_SLOT])
def list_attention(
    runtime: RuntimeDep,
    cache: FieldCacheDep,
    reason: Annotated[Reason | None, Query(description="Only this reason.")] = None,
    severity: Annotated[
        int | None, Query(ge=1, le=3, description="Only this severity: 1, 2 or 3.")
    ] = None,
    acknowledged: Annotated[
        bool | None, Query(description="Only alerts that are, or are not, acknowledged.")
    ] = None,
    limit: Limit = 100,
    after: Annotated[ItemId | None, Query(description="The last id of the page before.")] = None,
) -> AttentionPage:
    """List alerts, in the order of ids. The thresholds are those of the current settings."""
    with runtime.database.reading() as session:
        items, pending = list_alerts(session, cache, runtime.settings)
    wanted = [
        item
        for item in items
        if reason in (None, item.reason)
        and severity in (None, item.severity)
        and acknowledged in (None, item.acknowledged_by is not None)
        and (after is None or item.id > after)
    ]
    wanted.sort(key=attrgetter("id"))
    part = page([attention_out(item) for item in wanted[: limit + 1]], limit)
    return AttentionPage(items=part.items, next=part.next, pending=pending)


@router.post(
    "/acknowledgements",
    responses=problems(404, 413, 415),
    dependencies=[OPERATE, Depends(require_json)],
)
def post_acknowledgements(
    runtime: RuntimeDep,
    cache: FieldCacheDep,
    count: AttentionCountDep,
    identity: IdentityDep,
    seen: Annotated[AcknowledgementsIn, Body()],
) -> Page[AttentionOut]:
    """Acknowledge alerts.

    An acknowledgement lasts until the reason of the alert changes or returns. The first one is
    kept.
    """
    items = acknowledge(runtime, cache, seen.ids, identity.name)
    count.forget()
    return Page(items=[attention_out(item) for item in items], next=None)
