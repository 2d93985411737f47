"""The audit trail."""

from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from service.base.fields import CreatedAt, Id, Version, from_row
from service.store import audit
from service.web.auth.dependencies import ADMIN, Limit, RuntimeDep
from service.web.responses.openapi import problems
from service.web.responses.paging import Page, page


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


@router.get("/audit", responses=problems(), dependencies=[ADMIN])
def list_audit(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
) -> Page[AuditOut]:
    """List the audit trail: who did what, newest first."""
    with runtime.database.reading() as session:
        rows = audit.entries(session, limit + 1, after)
    return page([from_row(AuditOut, row) for row in rows], limit)
