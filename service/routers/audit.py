"""The audit trail."""

from typing import Annotated

from fastapi import APIRouter, Query

from service import audit, representations
from service.dependencies import ADMIN, Limit, RuntimeDep
from service.openapi import problems
from service.schemas import AuditOut, Page, Version

router = APIRouter(tags=["audit"])


@router.get("/audit", responses=problems(), dependencies=[ADMIN])
def list_audit(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
) -> Page[AuditOut]:
    """Who did what, newest first."""
    with runtime.database.reading() as session:
        rows = audit.entries(session, limit + 1, after)
    items = [representations.audit_entry(row) for row in rows]
    return representations.page(items, limit)
