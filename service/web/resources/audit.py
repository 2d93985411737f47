"""The audit trail, and pages for administrators: settings, keys, and who did what."""

from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Field

from service.base.fields import CreatedAt, Id, Version, from_row
from service.store import audit, keys
from service.store.job_tables import KeyRow
from service.web.auth.dependencies import ADMIN, Limit, RuntimeDep
from service.web.responses.lists import AfterId, Page, page
from service.web.responses.openapi import problems
from service.web.responses.pages import render


class AuditOut(BaseModel):
    """An entry of the audit trail."""

    id: Id
    created_at: CreatedAt
    actor: str = Field(
        description="Name of the key; `local` where none is demanded, `cli` and the user elsewhere."
    )
    action: str = Field(description="What was done.")
    subject: str = Field(description="What it was done to.")
    detail: dict[str, object] = Field(description="More about it, by the kind of action.")


router = APIRouter(tags=["audit"])
pages = APIRouter(include_in_schema=False)

# Entries that the page lists.
_PAGE = 100


@router.get("/audit", responses=problems(), dependencies=[ADMIN])
def list_audit(runtime: RuntimeDep, limit: Limit = 100, after: AfterId = None) -> Page[AuditOut]:
    """List the audit trail: who did what, newest first."""
    with runtime.database.reading() as session:
        rows = audit.entries(session, limit + 1, after)
    return page([from_row(AuditOut, row) for row in rows], limit)


@pages.get("/plant/audit", dependencies=[ADMIN])
def get_audit_page(
    request: Request, runtime: RuntimeDep, after: Annotated[Version | None, Query()] = None
) -> HTMLResponse:
    """Who did what, newest first."""
    listed = list_audit(runtime, _PAGE, after)
    return render(request, "audit.html", entries=listed.items, more=listed.next, after=after)


@pages.get("/plant/settings", dependencies=[ADMIN])
def get_settings_page(request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """The settings in force, without secrets."""
    return render(request, "settings.html", settings=runtime.settings.in_force)


def _keys(runtime: RuntimeDep) -> Sequence[KeyRow]:
    with runtime.database.reading() as session:
        return keys.list_keys(session)


@pages.get("/plant/keys", dependencies=[ADMIN])
def get_keys_page(
    request: Request, listed: Annotated[Sequence[KeyRow], Depends(_keys)]
) -> HTMLResponse:
    """Who has a key. The keys themselves are not stored."""
    return render(request, "keys.html", keys=listed)
