"""Page of all photographs, newest first, filtered by heliostat, verdict, target and time."""

from collections.abc import Sequence
from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import model_validator
from sqlalchemy import select
from sqlalchemy.orm import Session

from service import store
from service.base.fields import FormDay, Model, Name, Version, drop_empty_fields, start_of_day
from service.store.photographs.groups import (
    PhotographFilter,
    PhotographVerdict,
    TimeState,
    list_groups,
)
from service.store.tables import TargetRow
from service.twin.forecasts.aim_sources import plant_time_zone
from service.web.auth.dependencies import READ, RENDER_SLOT, RuntimeDep
from service.web.responses.pages import render

router = APIRouter(include_in_schema=False, dependencies=[READ, RENDER_SLOT])

LISTED = 50
"""Photographs on a page."""


class PhotographsQuery(Model):
    """Filters of the list.

    ``since`` and ``until`` are days in the plant's zone, both inclusive. ``before`` is where the
    page begins. ``time`` is whether the time of a photograph is known, and ``warned`` whether it
    has warnings.
    """

    heliostat: Name | None = None
    verdict: PhotographVerdict | None = None
    target: Name | None = None
    since: FormDay | None = None
    until: FormDay | None = None
    time: TimeState | None = None
    warned: bool | None = None
    before: Version | None = None

    _filled = model_validator(mode="before")(drop_empty_fields)

    def link(self, before: int | None = None, path: str = "/photographs") -> str:
        """The URL of another page with the same filters."""
        asked = self.model_dump(mode="json", exclude_none=True) | {"before": before}
        query_string = urlencode(
            {name: value for name, value in asked.items() if value is not None}
        )
        return f"{path}?{query_string}" if query_string else path

    @property
    def filters(self) -> dict[str, str]:
        """The fields of the filters that are set, for hidden fields of forms."""
        asked = self.model_dump(mode="json", exclude_none=True, exclude={"before"})
        return {
            name: str(value).lower() if value is True else str(value)
            for name, value in asked.items()
        }

    def filter(self, session: Session, zone: str) -> PhotographFilter:
        """The same as a filter; NotFoundError if heliostat or target are not stored."""
        return PhotographFilter(
            None if self.heliostat is None else store.get_heliostat(session, self.heliostat),
            None if self.target is None else store.get_target(session, self.target),
            self.verdict,
            start_of_day(self.since, zone),
            start_of_day(self.until, zone, 1),
            self.time,
            self.warned,
        )


def target_names(session: Session) -> Sequence[str]:
    """Names of all targets."""
    return session.scalars(select(TargetRow.name).order_by(TargetRow.name)).all()


@router.get("/photographs")
def get_photographs_page(
    request: Request, query: Annotated[PhotographsQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """One page of photographs, with the filter form."""
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
        groups = list_groups(session, query.filter(session, zone), LISTED + 1, query.before)
        targets = target_names(session)
    older = query.link(groups[LISTED - 1].mark) if len(groups) > LISTED else None
    return render(
        request,
        "photographs.html",
        query=query,
        groups=groups[:LISTED],
        targets=targets,
        older=older,
        verdicts=VERDICTS,
    )


VERDICTS: tuple[PhotographVerdict, ...] = ("used", "refused", "excluded")
