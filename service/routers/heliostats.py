"""Heliostats."""

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Response, status
from sqlalchemy.orm import Session

from service import audit, representations, store
from service.dependencies import OPERATE, READ, IdentityDep, Limit, NamePath, RuntimeDep, require_json
from service.openapi import problems
from service.schemas import HeliostatIn, HeliostatOut, HeliostatProperties, HeliostatSummary, Name, Page
from service.security import Identity

router = APIRouter(tags=["heliostats"])


def _put(
    session: Session, name: str, properties: HeliostatProperties, identity: Identity
) -> tuple[HeliostatOut, store.Change]:
    from service.paint import read_heliostat

    # Reading them as the model does is the check: what is stored can be traced.
    heliostat = read_heliostat(name, properties.raw, np.array(store.get_plant(session).origin))
    row, change = store.put_heliostat(session, name, properties.raw, heliostat.position)
    audit.record(session, identity.name, "heliostat.set", f"heliostat {name}", change=change)
    return representations.heliostat(row), change


@router.get("/heliostats", responses=problems(), dependencies=[READ])
def list_heliostats(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Name | None, Query(description="The last name of the page before.")] = None,
) -> Page[HeliostatSummary]:
    """Heliostats in the order of their names."""
    with runtime.database.reading() as session:
        rows = store.list_heliostats(session, limit + 1, after)
    items = [representations.heliostat_summary(row) for row in rows]
    return representations.page(items, limit, "name")


@router.post(
    "/heliostats",
    status_code=status.HTTP_201_CREATED,
    responses={**problems(409, 413, 415), 200: {"model": HeliostatOut, "description": "It was there already."}},
    dependencies=[OPERATE, Depends(require_json)],
)
def post_heliostat(
    request: HeliostatIn, runtime: RuntimeDep, identity: IdentityDep, response: Response
) -> HeliostatOut:
    """Add a heliostat; the same one again is no error, the same name with other properties is (use PUT)."""
    with runtime.database.writing() as session:
        known = store.find_heliostat(session, request.name)
        if known is not None:
            store.require_same_properties(known, request.properties.raw)
            response.status_code = status.HTTP_200_OK
            return representations.heliostat(known)
        heliostat, _ = _put(session, request.name, request.properties, identity)
    response.headers["Location"] = f"/v1/heliostats/{request.name}"
    return heliostat


@router.get("/heliostats/{name}", responses=problems(404), dependencies=[READ])
def get_heliostat(name: NamePath, runtime: RuntimeDep) -> HeliostatOut:
    """A heliostat with its properties."""
    with runtime.database.reading() as session:
        return representations.heliostat(store.get_heliostat(session, name))


@router.put(
    "/heliostats/{name}",
    responses={**problems(409, 413, 415), 201: {"model": HeliostatOut, "description": "It is new."}},
    dependencies=[OPERATE, Depends(require_json)],
)
def put_heliostat(
    name: NamePath,
    properties: HeliostatProperties,
    runtime: RuntimeDep,
    identity: IdentityDep,
    response: Response,
) -> HeliostatOut:
    """Set a heliostat's PAINT properties."""
    with runtime.database.writing() as session:
        heliostat, change = _put(session, name, properties, identity)
    if change is store.Change.NEW:
        response.status_code = status.HTTP_201_CREATED
    return heliostat
