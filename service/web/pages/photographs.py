"""All photographs of the field: newest first, small, by heliostat, verdict, target and time."""

from datetime import UTC, date, datetime, time, timedelta
from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import Field, model_validator
from sqlalchemy import select

from service import store
from service.base.fields import Model, Name, Version, filled
from service.store.shots import PhotographVerdict, Wanted, list_shots
from service.store.tables import TargetRow
from service.web.answers.pages import render
from service.web.door.dependencies import DRAWS, READ, RuntimeDep

router = APIRouter(include_in_schema=False, dependencies=[READ, DRAWS])

LISTED = 50
"""Photographs on a page."""


class PhotographsQuery(Model):
    """What is looked for; ``since`` and ``until`` are days of UTC, both with it; ``before`` is where a page begins."""

    heliostat: Name | None = None
    verdict: PhotographVerdict | None = None
    target: Name | None = None
    since: date | None = None
    until: date | None = Field(default=None, lt=date.max)
    before: Version | None = None

    _filled = model_validator(mode="before")(filled)

    def link(self, before: int | None) -> str:
        """The address of another page of the same."""
        asked = {**self.model_dump(mode="json", exclude_none=True, exclude={"before"}), "before": before}
        told = urlencode({name: value for name, value in asked.items() if value is not None})
        return f"/photographs?{told}" if told else "/photographs"


def _midnight(day: date | None, later: int = 0) -> datetime | None:
    return None if day is None else datetime.combine(day + timedelta(days=later), time(), UTC)


@router.get("/photographs")
def get_photographs_page(
    request: Request, query: Annotated[PhotographsQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """A page of them, with the form that finds others."""
    with runtime.database.reading() as session:
        wanted = Wanted(
            None if query.heliostat is None else store.get_heliostat(session, query.heliostat),
            None if query.target is None else store.get_target(session, query.target),
            query.verdict,
            _midnight(query.since),
            _midnight(query.until, 1),
        )
        shots = list_shots(session, wanted, LISTED + 1, query.before)
        targets = session.scalars(select(TargetRow.name).order_by(TargetRow.name)).all()
    older = query.link(shots[LISTED - 1].mark) if len(shots) > LISTED else None
    return render(
        request, "photographs.html", query=query, shots=shots[:LISTED], targets=targets, older=older, verdicts=VERDICTS
    )


VERDICTS: tuple[PhotographVerdict, ...] = ("used", "refused", "excluded")
