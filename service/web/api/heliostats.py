"""Heliostats."""

from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Response, status
from pydantic import BaseModel, Discriminator, Field, Tag
from sqlalchemy.orm import Session

from service import store
from service.base.fields import HeliostatOf, Model, Name, Search, from_row
from service.sources.heliostat_document import HeliostatDocument
from service.sources.heliostat_of_type import HeliostatOfType
from service.sources.schema import HeliostatProperties
from service.store import audit
from service.store.rows import Put
from service.store.tables import HeliostatRow
from service.twin.plant import setup
from service.twin.plant.setup import Authorship
from service.web.auth.dependencies import (
    OPERATE,
    READ,
    AuthorshipDep,
    Limit,
    NamePath,
    RuntimeDep,
    require_json,
    set_tag,
)
from service.web.responses.openapi import problems
from service.web.responses.paging import Page, page

_FORMS = {
    "heliostat_position": "(paint)",
    "format": "(document)",
    "position_m": "(document)",
    "type": "(type)",
    "east_m": "(type)",
}
"""Forms of a heliostat's properties by keys; the first key that is there decides."""


def _form(properties: Any) -> str:
    known = _FORMS.items() if isinstance(properties, dict) else ()
    return next((form for key, form in known if key in properties), "(paint)")


AnyHeliostat = Annotated[
    Annotated[HeliostatProperties, Tag("(paint)")]
    | Annotated[HeliostatOfType, Tag("(type)")]
    | Annotated[HeliostatDocument, Tag("(document)")],
    Discriminator(_form),
    Field(
        description=(
            "Its type and place in the terms of plant.yaml, or PAINT's properties, or what GET"
            " gives as `properties`."
        )
    ),
]


class HeliostatIn(Model):
    """A heliostat to store."""

    name: Name
    properties: AnyHeliostat


class HeliostatSummary(BaseModel):
    """A heliostat in a list."""

    name: HeliostatOf
    position_m: tuple[float, float, float] = Field(
        description="East, north, up of the tower base [m]."
    )


class HeliostatOut(HeliostatSummary):
    """A heliostat with its properties."""

    properties: dict[str, object] = Field(
        description=(
            "PAINT's as they were sent; of other heliostats a document with axes and facets. PUT"
            " takes both."
        )
    )
    updated_at: datetime = Field(description="When it was last changed.")


def heliostat_summary(row: HeliostatRow) -> HeliostatSummary:
    """A heliostat without its properties."""
    return from_row(HeliostatSummary, row, position_m=(row.east_m, row.north_m, row.up_m))


def heliostat_out(row: HeliostatRow) -> HeliostatOut:
    """A heliostat as JSON."""
    return from_row(HeliostatOut, row, position_m=(row.east_m, row.north_m, row.up_m))


def _set(
    session: Session,
    by: Authorship,
    name: str,
    given: HeliostatProperties | HeliostatOfType | HeliostatDocument,
    replace: bool = True,
) -> Put[HeliostatRow]:
    if isinstance(given, HeliostatOfType):
        return setup.set_heliostat_of_type(session, by, name, given, replace)
    return setup.set_heliostat(session, by, name, given.raw, replace)


router = APIRouter(tags=["heliostats"])


@router.get("/heliostats", responses=problems(), dependencies=[READ])
def list_heliostats(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Name | None, Query(description="The last name of the page before.")] = None,
    prefix: Annotated[
        Name | None, Query(description="Only names that begin so, in capitals or not.")
    ] = None,
    search: Annotated[
        Search, Query(description="Only names with this in them, in capitals or not.")
    ] = "",
) -> Page[HeliostatSummary]:
    """List heliostats, in the order of their names. `/v1/field` filters them by their metrics."""
    with runtime.database.reading() as session:
        rows = store.list_heliostats(session, limit + 1, after, prefix, search)
    items = [heliostat_summary(row) for row in rows]
    return page(items, limit, "name")


@router.post(
    "/heliostats",
    status_code=status.HTTP_201_CREATED,
    responses={
        **problems(409, 413, 415),
        200: {"model": HeliostatOut, "description": "It was there already."},
    },
    dependencies=[OPERATE, Depends(require_json)],
)
def post_heliostat(
    request: HeliostatIn, runtime: RuntimeDep, by: AuthorshipDep, response: Response
) -> HeliostatOut:
    """Add a heliostat.

    The same heliostat again is no error. The same name with other properties is refused; use PUT.
    """
    row, change = runtime.database.run_in_transaction(
        lambda session: _set(session, by, request.name, request.properties, replace=False)
    )
    if change is store.Change.UNCHANGED:
        response.status_code = status.HTTP_200_OK
    else:
        response.headers["Location"] = f"/v1/heliostats/{request.name}"
    return heliostat_out(row)


@router.get("/heliostats/{name}", responses=problems(404), dependencies=[READ])
def get_heliostat(name: NamePath, runtime: RuntimeDep, response: Response) -> HeliostatOut:
    """Get a heliostat with its properties."""
    with runtime.database.reading() as session:
        set_tag(response, audit.version(session, f"heliostat {name}", "heliostat.set"))
        return heliostat_out(store.get_heliostat(session, name))


@router.put(
    "/heliostats/{name}",
    responses={
        **problems(409, 413, 415),
        201: {"model": HeliostatOut, "description": "It is new."},
    },
    dependencies=[OPERATE, Depends(require_json)],
)
def put_heliostat(
    name: NamePath,
    properties: AnyHeliostat,
    runtime: RuntimeDep,
    by: AuthorshipDep,
    response: Response,
) -> HeliostatOut:
    """Set a heliostat of any type.

    In the terms of plant.yaml it has a `type`, by its name in the imported plant.yaml or written
    out, and the place of its foot. PAINT's properties, and what GET gives as `properties`, are
    taken as well.
    """
    row, change = runtime.database.run_in_transaction(
        lambda session: _set(session, by, name, properties)
    )
    if change is store.Change.NEW:
        response.status_code = status.HTTP_201_CREATED
    return heliostat_out(row)


@router.delete(
    "/heliostats/{name}",
    status_code=status.HTTP_204_NO_CONTENT,
    response_class=Response,
    responses=problems(404, 409),
    dependencies=[OPERATE],
)
def delete_heliostat(name: NamePath, runtime: RuntimeDep, by: AuthorshipDep) -> None:
    """Delete a heliostat that was created by mistake.

    This is refused if photographs, surfaces or anything else refers to it.
    """
    runtime.database.run_in_transaction(
        lambda session: setup.remove(session, by, "heliostat", name)
    )
