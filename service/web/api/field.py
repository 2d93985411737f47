"""The field at a glance: all heliostats with what their twins are worth."""

from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from service.base.faults import NotFoundError
from service.base.fields import Name, Source
from service.twin.field import PATIENCE_S, Line
from service.twin.finding import METRICS, Wanted, find
from service.web.answers.openapi import problems
from service.web.answers.paging import Page, page
from service.web.door.dependencies import READ, FieldBookDep, RuntimeDep


class FieldQuery(Wanted):
    """Heliostats that are looked for, page by page."""

    limit: int = Field(default=100, ge=1, le=500, description="Most items on a page.")
    after: Name | None = Field(default=None, description="The last name of the page before, of the same question.")


class FieldLine(BaseModel):
    """A heliostat with what its twin is worth; what is null is not known, or not yet worked out."""

    name: str
    position_m: tuple[float, float] = Field(description="East, north of the tower base [m].")
    accuracy: float | None = Field(
        description="Mean flux accuracy of forecasts on photographs that the surface was not made from [%]."
    )
    judged_by: int | None = Field(description="How many photographs that is the mean of.")
    deviation: float | None = Field(description="Root mean square of the heights over the ideal mirror [mm].")
    uncertainty: float | None = Field(description="Root mean square of their standard deviations [mm].")
    misfit: float | None = Field(description="What the surface leaves unexplained of its photographs [%].")
    age: float | None = Field(description="Of the surface [days].")
    pointing: float | None = Field(description="How far off light lands by the calibrated mount [mrad].")
    sun_span: float | None = Field(
        description="Largest angle between the suns of the photographs that the surface was made from [deg]."
    )
    surface: int | None = Field(description="Version of today's surface.")
    source: Source | None
    trusted: bool | None = Field(description="Null for what is measured, or before surfaces were judged.")
    doubts: list[str] = Field(description="Why it is not trusted.")
    doubted_since: datetime | None
    seen_by: str | None = Field(description="Who has seen the doubts.")
    photographs: int
    refused: int


def field_line(line: Line) -> FieldLine:
    """A heliostat as JSON."""
    surface = line.surface
    return FieldLine.model_validate(
        {
            "name": line.name,
            "position_m": (line.east_m, line.north_m),
            **{name: metric.value(line) for name, metric in METRICS.items()},
            "age": None if surface is None or surface.age_days is None else round(surface.age_days, 1),
            "judged_by": None if line.rank is None else line.rank.photographs,
            "surface": None if surface is None else surface.version,
            "source": None if surface is None else surface.source,
            "trusted": None if surface is None else surface.trusted,
            "doubts": [] if surface is None else surface.doubts or [],
            "doubted_since": None if surface is None else surface.doubted_since,
            "seen_by": None if surface is None else surface.seen_by,
            "photographs": line.photographs,
            "refused": line.refused,
        }
    )


router = APIRouter(tags=["heliostats"])


@router.get("/field", responses=problems(404), dependencies=[READ])
def list_field(query: Annotated[FieldQuery, Query()], runtime: RuntimeDep, book: FieldBookDep) -> Page[FieldLine]:
    """Heliostats that fit what is asked, with their figures, in the order of one of them."""
    with runtime.database.reading() as session:
        lines = find(book.read(session, PATIENCE_S).lines, query)
    begin = 0
    if query.after is not None:
        names = [line.name for line in lines]
        if query.after not in names:
            raise NotFoundError(f"after: heliostat {query.after} is not among these any more; begin again without it")
        begin = names.index(query.after) + 1
    return page([field_line(line) for line in lines[begin : begin + query.limit + 1]], query.limit, "name")
