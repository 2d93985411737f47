"""Page of alerts: what is wrong, since when, what to do, and who acknowledged it."""

from collections import Counter
from typing import Annotated

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field

from service.base.fields import Model
from service.twin.alerts.alerts import acknowledge, list_alerts
from service.twin.alerts.reasons import REASONS, SEVERITIES, Reason
from service.web.api.attention import AttentionCountDep, ItemId
from service.web.auth.dependencies import (
    OPERATE,
    OVERVIEW_SLOT,
    READ,
    FieldCacheDep,
    IdentityDep,
    RuntimeDep,
)
from service.web.responses.pages import count_badge, go_to, render

router = APIRouter(include_in_schema=False)

# Items on the page, in total or for one reason.
_LISTED = 100


class AcknowledgementForm(Model):
    """The buttons for one item or all listed ones. ``reason`` is the list to return to."""

    ids: Annotated[list[ItemId], Field(min_length=1, max_length=_LISTED)]
    reason: Reason | None = None


@router.get("/attention", dependencies=[READ, OVERVIEW_SLOT])
def get_attention_page(
    request: Request,
    runtime: RuntimeDep,
    cache: FieldCacheDep,
    reason: Annotated[Reason | None, Query()] = None,
    acknowledged: Annotated[bool, Query()] = False,
) -> HTMLResponse:
    """Alerts that are not acknowledged, or those that are; of one reason or of all."""
    with runtime.database.reading() as session:
        items, pending = list_alerts(session, cache, runtime.settings)
    chosen = [item for item in items if (item.acknowledged_by is not None) == acknowledged]
    listed = [item for item in chosen if reason in (None, item.reason)]
    return render(
        request,
        "attention.html",
        reasons=REASONS,
        severities=SEVERITIES,
        counts=Counter(item.reason for item in chosen),
        others=len(items) - len(chosen),
        listed=listed[:_LISTED],
        more=max(0, len(listed) - _LISTED),
        reason=reason,
        acknowledged=acknowledged,
        pending=pending,
        limits=runtime.settings,
    )


@router.get("/attention/count", dependencies=[READ])
def get_attention_count(count: AttentionCountDep) -> Response:
    """The number of alerts that are not acknowledged, for the menu."""
    return HTMLResponse(count_badge(count.read()))


@router.post("/attention/acknowledgements", dependencies=[OPERATE])
def post_acknowledgement_form(
    form: Annotated[AcknowledgementForm, Form()],
    runtime: RuntimeDep,
    cache: FieldCacheDep,
    count: AttentionCountDep,
    identity: IdentityDep,
) -> Response:
    """Acknowledge items, and return to the list."""
    acknowledge(runtime, cache, form.ids, identity.name)
    count.forget()
    return go_to("/attention" if form.reason is None else f"/attention?reason={form.reason}")
