"""What needs attention, and who has acknowledged it."""

from datetime import datetime
from operator import attrgetter
from typing import Annotated

from fastapi import APIRouter, Body, Depends, Query, Request
from pydantic import BaseModel, Field

from service.base.fields import Model
from service.twin.attention import AttentionCount, Item, Reason, acknowledge, needs_attention
from service.web.answers.openapi import problems
from service.web.answers.paging import Page, page
from service.web.door.dependencies import OPERATE, READ, FieldBookDep, IdentityDep, Limit, RuntimeDep, require_json

router = APIRouter(prefix="/attention", tags=["attention"])

ItemId = Annotated[
    str,
    Field(
        max_length=80,
        pattern=r"^[A-Za-z0-9_-]+:[a-z_]+:[0-9a-f]{8}$",
        description="The item and its reason as they are now; another where the reason changes or returns.",
        examples=["AA39:moved:1f0c22ab"],
    ),
]


class AttentionOut(BaseModel):
    """Something that needs attention."""

    id: ItemId
    reason: Reason
    heliostat: str | None = Field(description="null: the plant as a whole.")
    since: datetime
    what: str
    todo: str = Field(description="What to do.")
    photographs: list[str] = Field(description="Ids of the heliostat's measurements to look at, where there are some.")
    acknowledged_by: str | None = Field(description="Name of the key; null where nobody has.")
    acknowledged_at: datetime | None


def attention_out(item: Item) -> AttentionOut:
    """An item as JSON."""
    return AttentionOut.model_validate(item, from_attributes=True)


class AttentionPage(Page[AttentionOut]):
    """A part of all that needs attention."""

    pending: int = Field(description="Heliostats whose pointing error is still being worked out; ask again for them.")


class AcknowledgementsIn(Model):
    """What somebody has seen."""

    ids: list[ItemId] = Field(min_length=1, max_length=500, description="Ids of items of `GET /v1/attention`.")


async def _count(request: Request) -> AttentionCount:
    count: AttentionCount = request.app.state.attention
    return count


AttentionCountDep = Annotated[AttentionCount, Depends(_count)]


@router.get("", responses=problems(), dependencies=[READ])
def list_attention(
    runtime: RuntimeDep,
    book: FieldBookDep,
    reason: Annotated[Reason | None, Query(description="Only this reason.")] = None,
    acknowledged: Annotated[bool | None, Query(description="Only what somebody, or nobody, has acknowledged.")] = None,
    limit: Limit = 100,
    after: Annotated[ItemId | None, Query(description="The last id of the page before.")] = None,
) -> AttentionPage:
    """All that needs attention, in the order of ids: reasons by the settings' thresholds, as they are now."""
    with runtime.database.reading() as session:
        items, pending = needs_attention(session, book, runtime.settings)
    wanted = [
        item
        for item in items
        if reason in (None, item.reason)
        and acknowledged in (None, item.acknowledged_by is not None)
        and (after is None or item.id > after)
    ]
    wanted.sort(key=attrgetter("id"))
    part = page([attention_out(item) for item in wanted[: limit + 1]], limit)
    return AttentionPage(items=part.items, next=part.next, pending=pending)


@router.post("/acknowledgements", responses=problems(404, 413, 415), dependencies=[OPERATE, Depends(require_json)])
def post_acknowledgements(
    runtime: RuntimeDep,
    book: FieldBookDep,
    count: AttentionCountDep,
    identity: IdentityDep,
    seen: Annotated[AcknowledgementsIn, Body()],
) -> list[AttentionOut]:
    """Acknowledge items: who did stays with them until their reason changes or returns. The first who did stays."""
    items = acknowledge(runtime, book, seen.ids, identity.name)
    count.forget()
    return [attention_out(item) for item in items]
