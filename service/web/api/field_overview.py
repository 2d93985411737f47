"""Overview of the field: all heliostats with the accuracy of their twins."""

from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from service.base.errors import NotFoundError
from service.base.fields import HeliostatOf, Name, Source
from service.twin.alarms.field_filter import METRICS, HeliostatFilter, filter_heliostats
from service.twin.alarms.field_overview import PATIENCE_S, HeliostatOverview
from service.web.auth.dependencies import OVERVIEW_SLOT, READ, FieldCacheDep, RuntimeDep
from service.web.responses.openapi import problems
from service.web.responses.paging import Page, page


class FieldQuery(HeliostatFilter):
    """Filter and order of heliostats, with paging."""

    limit: int = Field(default=100, ge=1, le=500, description="Most items on a page.")
    after: Name | None = Field(
        default=None, description="The last name of the page before, of the same question."
    )


class FieldLine(BaseModel):
    """A heliostat with its metrics. A value is null if it is unknown or not yet computed."""

    name: HeliostatOf
    position_m: tuple[float, float] = Field(description="East, north of the tower base [m].")
    accuracy: float | None = Field(
        description=(
            "Mean flux accuracy of forecasts on photographs that the surface was not made from [1]."
        )
    )
    judged_by: int | None = Field(description="How many photographs that is the mean of.")
    deviation_mm: float | None = Field(
        description="Root mean square of the heights over the ideal mirror [mm]."
    )
    uncertainty_mm: float | None = Field(
        description="Root mean square of their standard deviations [mm]."
    )
    misfit: float | None = Field(
        description="What the surface leaves unexplained of its photographs [1]."
    )
    age_days: float | None = Field(description="Of the surface [days].")
    pointing_error_mrad: float | None = Field(
        description="How far off light lands by the calibrated mount [mrad]."
    )
    sun_span_deg: float | None = Field(
        description=(
            "Largest angle between the suns of the photographs that the surface was made from"
            " [deg]."
        )
    )
    surface_version: int | None = Field(description="Version of the active surface.")
    source: Source | None = Field(description="How that was obtained.")
    trusted: bool | None = Field(
        description="Null for what is measured, or before surfaces were judged."
    )
    warnings: list[str] = Field(description="Why it is not trusted.")
    warned_since: datetime | None = Field(description="When its warnings began.")
    acknowledged_by: str | None = Field(description="Who has seen the warnings.")
    photographs: int = Field(description="How many photographs are stored.")
    refused: int = Field(description="How many of them were refused.")


def field_line(line: HeliostatOverview) -> FieldLine:
    """A heliostat as JSON."""
    surface = line.surface
    return FieldLine.model_validate(
        {
            "name": line.name,
            "position_m": (line.east_m, line.north_m),
            **{name: metric.value(line) for name, metric in METRICS.items()},
            "age_days": (
                None if surface is None or surface.age_days is None else round(surface.age_days, 1)
            ),
            "judged_by": None if line.rank is None else line.rank.photographs,
            "surface_version": None if surface is None else surface.version,
            "source": None if surface is None else surface.source,
            "trusted": None if surface is None else surface.trusted,
            "warnings": [] if surface is None else surface.warnings or [],
            "warned_since": None if surface is None else surface.warned_since,
            "acknowledged_by": None if surface is None else surface.acknowledged_by,
            "photographs": line.photographs,
            "refused": line.refused,
        }
    )


router = APIRouter(tags=["heliostats"])


@router.get("/field", responses=problems(404), dependencies=[READ, OVERVIEW_SLOT])
def list_field(
    query: Annotated[FieldQuery, Query()], runtime: RuntimeDep, cache: FieldCacheDep
) -> Page[FieldLine]:
    """List heliostats with their metrics. They match the filter, in the order of one metric."""
    with runtime.database.reading() as session:
        per_unit, given = (
            METRICS[query.metric].per_unit,
            query.model_dump(exclude={"limit", "after"}),
        )
        limits = {
            name: given[name] * per_unit for name in ("low", "high") if given[name] is not None
        }
        wanted = HeliostatFilter.model_validate(given | limits)
        lines = cache.recent(
            session,
            wanted,
            lambda: filter_heliostats(cache.read(session, PATIENCE_S).lines, wanted),
        )
    begin = 0
    if query.after is not None:
        names = [line.name for line in lines]
        if query.after not in names:
            raise NotFoundError(
                f"after: heliostat {query.after} is not among these any more; begin again"
                " without it"
            )
        begin = names.index(query.after) + 1
    return page(
        [field_line(line) for line in lines[begin : begin + query.limit + 1]], query.limit, "name"
    )
