"""The audit trail."""

from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from service.base.fields import CreatedAt, Id, Version, from_row
from service.store import audit
from service.store.job_tables import AuditRow
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


def audit_out(row: AuditRow) -> AuditOut:
    """An entry of the audit trail as JSON."""
    return from_row(AuditOut, row)


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
    items = [audit_out(row) for row in rows]
    return page(items, limit)
