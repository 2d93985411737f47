"""Needs attention: what, since when, what to do, and who has seen it."""

from collections import Counter
from typing import Annotated, Any

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import HTMLResponse
from markupsafe import Markup
from pydantic import Field

from service.base.fields import Model
from service.twin.attention import REASONS, Reason, acknowledge, needs_attention
from service.web.answers.pages import go_to, render
from service.web.api.attention import AttentionCountDep, ItemId
from service.web.door.dependencies import OPERATE, READ, FieldBookDep, IdentityDep, RuntimeDep

router = APIRouter(include_in_schema=False)

# Items on the page; a reason's own list shows as many of it.
_LISTED = 100


class AcknowledgementForm(Model):
    """The buttons: one item, or all that the page lists; ``reason`` is where to go back to."""

    ids: Annotated[list[ItemId], Field(min_length=1, max_length=_LISTED)]
    reason: Reason | None = None


@router.get("/attention", dependencies=[READ])
def get_attention_page(
    request: Request,
    runtime: RuntimeDep,
    book: FieldBookDep,
    reason: Annotated[Reason | None, Query()] = None,
    acknowledged: Annotated[bool, Query()] = False,
) -> HTMLResponse:
    """What nobody has acknowledged, or what somebody has; of one reason or of all."""
    with runtime.database.reading() as session:
        items, pending = needs_attention(session, book, runtime.settings)
    chosen = [item for item in items if (item.acknowledged_by is not None) == acknowledged]
    listed = [item for item in chosen if reason in (None, item.reason)]
    return render(
        request,
        "attention.html",
        reasons=REASONS,
        counts=Counter(item.reason for item in chosen),
        others=len(items) - len(chosen),
        listed=listed[:_LISTED],
        more=max(0, len(listed) - _LISTED),
        reason=reason,
        acknowledged=acknowledged,
        pending=pending,
        limits=_limits(runtime),
    )


def _limits(runtime: RuntimeDep) -> dict[str, Any]:
    settings = runtime.settings
    return {name: getattr(settings, name) for name in type(settings).model_fields if name.startswith("attention_")}


@router.get("/attention/count", dependencies=[READ])
def get_attention_count(count: AttentionCountDep) -> Response:
    """How many items nobody has acknowledged, as the menu shows it."""
    number = count.read()
    told = Markup('<span class="count">{}<span class="hidden"> not acknowledged</span></span>').format(number)
    return HTMLResponse(told if number else "")


@router.post("/attention/acknowledgements", dependencies=[OPERATE])
def post_acknowledgement_form(
    form: Annotated[AcknowledgementForm, Form()],
    runtime: RuntimeDep,
    book: FieldBookDep,
    count: AttentionCountDep,
    identity: IdentityDep,
) -> Response:
    """Acknowledge items, and go back to the list."""
    acknowledge(runtime, book, form.ids, identity.name)
    count.forget()
    return go_to("/attention" if form.reason is None else f"/attention?reason={form.reason}")
