"""Photographs of the whole plant, newest first, by heliostat, verdict, target and time."""

from collections.abc import Sequence
from typing import Annotated, get_args
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import Field, model_validator
from sqlalchemy import select
from sqlalchemy.orm import Session

from service import store
from service.base.fields import FormDay, Name, Version, drop_empty_fields, start_of_day
from service.store.listing import Period
from service.store.photographs.groups import PhotographFilter, PhotographVerdict, list_groups
from service.store.tables import TargetRow
from service.twin.forecasts.aim_sources import plant_time_zone
from service.web.api.measurements import (
    MeasurementFilterQuery,
    MeasurementOut,
    TakenQuery,
    measurement_out,
)
from service.web.auth.dependencies import READ, RENDER_SLOT, RuntimeDep
from service.web.responses.openapi import problems
from service.web.responses.pages import render
from service.web.responses.paging import Page, page

router = APIRouter(prefix="/measurements", tags=["measurements"])
pages = APIRouter(include_in_schema=False)

LISTED = 50
"""Photographs on a page."""

VERDICTS: tuple[PhotographVerdict, ...] = get_args(PhotographVerdict)


class PhotographOut(MeasurementOut):
    """A photograph: the image that decides its verdict, and the ids of all its images."""

    verdict: PhotographVerdict = Field(
        description="used: an image is accepted; else excluded by a person, or refused."
    )
    images: dict[str, str] = Field(description="The `id` of each image by its kind, this one too.")
    mark: int = Field(exclude=True)


class PhotographFilterQuery(MeasurementFilterQuery):
    """Filters of photographs, but for their period."""

    heliostat: Name | None = Field(None, description="Only this heliostat.")
    verdict: PhotographVerdict | None = Field(None, description="Only of this verdict.")
    after: Version | None = Field(None, description="`next` of the page before.")

    def taken_in(self, session: Session, period: Period) -> PhotographFilter:
        """The same as a filter; NotFoundError if heliostat or target are not stored."""
        return PhotographFilter(
            None if self.heliostat is None else store.get_heliostat(session, self.heliostat),
            None if self.target is None else store.get_target(session, self.target),
            self.verdict,
            period,
            self.dated,
            self.warned,
        )


class PhotographListQuery(TakenQuery, PhotographFilterQuery):
    """Which photographs REST lists."""


class PhotographsQuery(PhotographFilterQuery):
    """Filters of the page: ``since`` and ``until`` are days in the plant's zone, both inclusive."""

    since: FormDay | None = None
    until: FormDay | None = None

    _filled = model_validator(mode="before")(drop_empty_fields)

    def link(self, path: str = "/photographs", **more: int | None) -> str:
        """The URL of another page with the same filters."""
        asked = self.filters | {name: str(one) for name, one in more.items() if one is not None}
        return f"{path}?{urlencode(asked)}" if asked else path

    @property
    def filters(self) -> dict[str, str]:
        """The fields of the filters that are set, for hidden fields of forms."""
        asked = self.model_dump(mode="json", exclude_none=True, exclude={"after"})
        return {
            name: str(value).lower() if isinstance(value, bool) else str(value)
            for name, value in asked.items()
        }

    def filter(self, session: Session, zone: str) -> PhotographFilter:
        """The same as a filter; NotFoundError if heliostat or target are not stored."""
        days = Period(start_of_day(self.since, zone), start_of_day(self.until, zone, 1))
        return self.taken_in(session, days)


def target_names(session: Session) -> Sequence[str]:
    """Names of all targets."""
    return session.scalars(select(TargetRow.name).order_by(TargetRow.name)).all()


@router.get("", responses=problems(404), dependencies=[READ])
def list_plant_measurements(
    query: Annotated[PhotographListQuery, Query()], runtime: RuntimeDep
) -> Page[PhotographOut]:
    """List the photographs of the whole plant, newest first. Those of an unknown time come last.

    An item is a photograph. Its kinds of images are separate items of a heliostat's list.
    """
    with runtime.database.reading() as session:
        chosen = query.taken_in(session, query.taken)
        groups = list_groups(session, chosen, query.limit + 1, query.after)
        items = [
            PhotographOut(
                **dict(measurement_out(session, group.heliostat, group.best)),
                verdict=group.verdict,
                images={row.kind: row.identifier for row in group.images},
                mark=group.mark,
            )
            for group in groups
        ]
    return page(items, query.limit, "mark")


@pages.get("/photographs", dependencies=[READ, RENDER_SLOT])
def get_photographs_page(
    request: Request, query: Annotated[PhotographsQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """One page of photographs, with the filter form."""
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
        groups = list_groups(session, query.filter(session, zone), LISTED + 1, query.after)
        targets = target_names(session)
    older = query.link(after=groups[LISTED - 1].mark) if len(groups) > LISTED else None
    return render(
        request,
        "photographs.html",
        query=query,
        groups=groups[:LISTED],
        targets=targets,
        older=older,
        verdicts=VERDICTS,
    )
