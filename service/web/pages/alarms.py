"""Pages of alarms: what is wrong, since when, what to do, who acknowledged it, and the history."""

from operator import attrgetter
from typing import Annotated, Literal, Self, get_args
from urllib.parse import urlencode

from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field, model_validator

from service.base.errors import ConflictError
from service.base.fields import Model, Name, Text, Version, drop_empty_fields
from service.store import acknowledgements
from service.twin.alarms.acknowledging import (
    AlarmFilter,
    acknowledge,
    group_alarms,
    undo_acknowledgement,
)
from service.twin.alarms.alarms import Alarm, read_alarms
from service.twin.alarms.common_causes import find_common_causes
from service.twin.alarms.reasons import REASONS, SEVERITIES, Reason
from service.web.api.alarms import AlarmCountDep, ItemId
from service.web.auth.dependencies import OPERATE, OVERVIEW_SLOT, READ, IdentityDep, RuntimeDep
from service.web.responses.pages import count_badge, go_to, render

router = APIRouter(include_in_schema=False)

# Alarms that the page lists of one reason, or in total if it is sorted otherwise.
_LISTED = 100

# Acknowledgements that the history lists.
_BATCHES = 30

Comment = Literal[
    "Work is ordered",
    "Known; it can wait",
    "Follows from another alarm",
    "Maintenance",
    "False alarm",
    "Other",
]
COMMENTS: tuple[Comment, ...] = get_args(Comment)
"""Reasons to choose from; the last one needs words."""

Sort = Literal["severity", "newest", "oldest", "heliostat"]


class AlarmQuery(Model):
    """Filters and order of the page. ``done`` is an acknowledgement that was made just now."""

    severity: Annotated[int | None, Field(ge=1, le=3)] = None
    reason: Reason | None = None
    heliostat: Name | None = None
    acknowledged: bool = False
    sort: Sort = "severity"
    done: Version | None = None

    _filled = model_validator(mode="before")(drop_empty_fields)

    def link(self, path: str = "/alarms", **changes: object) -> str:
        """The URL of ``path`` with these filters, and with changes."""
        values = self.model_dump(exclude_defaults=True, exclude={"done"}) | changes
        defaults = {None, False, "severity"}
        asked = {
            name: str(value).lower() if isinstance(value, bool) else value
            for name, value in values.items()
            if value not in defaults
        }
        return f"{path}?{urlencode(asked)}" if asked else path

    @property
    def is_filtered(self) -> bool:
        """Whether only some reasons, severities or heliostats are wanted."""
        return any((self.severity, self.reason, self.heliostat))

    def choose(self, alarms: list[Alarm]) -> list[Alarm]:
        """The wanted alarms in the wanted order."""
        wanted = AlarmFilter(self.reason, self.severity, self.heliostat, self.acknowledged)
        chosen = wanted.choose(alarms)
        if self.sort == "heliostat":
            return sorted(chosen, key=lambda alarm: alarm.heliostat or "")
        if self.sort == "severity":
            return chosen
        return sorted(chosen, key=attrgetter("since"), reverse=self.sort == "newest")


class HistoryQuery(Model):
    """Filters of the history, and the record after which it begins."""

    reason: Reason | None = None
    heliostat: Name | None = None
    after: Version | None = None

    _filled = model_validator(mode="before")(drop_empty_fields)

    def older(self, after: int) -> str:
        """The URL of what is older than record ``after``."""
        asked = self.model_dump(exclude_none=True) | {"after": after}
        return f"/alarms/history?{urlencode(asked)}"


class AcknowledgementForm(Model):
    """The ticked alarms and groups, and why they are acknowledged."""

    ids: Annotated[list[ItemId], Field(default_factory=list, max_length=500)]
    groups: Annotated[
        list[Annotated[Text, Field(max_length=80)]], Field(default_factory=list, max_length=100)
    ]
    why: Comment
    words: Annotated[Text, Field(max_length=160)] = ""

    _filled = model_validator(mode="before")(drop_empty_fields)

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if not (self.ids or self.groups):
            raise ValueError("ids: tick at least one alarm, or all of a reason")
        if not self.comment:
            raise ValueError(f"words: write the reason if it is {self.why!r}")
        return self

    @property
    def comment(self) -> str:
        """The reason as it is stored."""
        if self.why == COMMENTS[-1]:
            return self.words
        return f"{self.why}: {self.words}" if self.words else self.why


@router.get("/alarms", dependencies=[READ, OVERVIEW_SLOT])
def get_alarms_page(
    request: Request,
    query: Annotated[AlarmQuery, Query()],
    runtime: RuntimeDep,
    count: AlarmCountDep,
) -> HTMLResponse:
    """Alarms that are not acknowledged, or those that are, by severity and reason or in a list."""
    with runtime.database.reading() as session:
        items, computed_at, pending = read_alarms(session)
        count.read(session)
        done = query.done and acknowledgements.list_batches(session, 1, number=query.done)
        chosen = query.choose(items)
        causes = find_common_causes(session, chosen, runtime.settings)
    groups = group_alarms(chosen)
    return render(
        request,
        "alarms.html",
        query=query,
        reasons=REASONS,
        severities=SEVERITIES,
        comments=COMMENTS,
        groups=groups if query.sort == "severity" else [],
        chosen=chosen,
        causes=causes,
        single=len(chosen) - sum(len(cause.alarms) for cause in causes),
        listed=_LISTED if query.reason is None else 5 * _LISTED,
        others=sum((item.acknowledged_by is not None) != query.acknowledged for item in items),
        done=done[0] if done else None,
        computed_at=computed_at,
        pending=pending,
        limits=runtime.settings,
    )


@router.get("/alarms/count", dependencies=[READ])
def get_alarm_count(runtime: RuntimeDep, count: AlarmCountDep) -> Response:
    """The number of alarms that are not acknowledged, for the menu."""
    with runtime.database.reading() as session:
        count.read(session)
    return HTMLResponse(count_badge(count.last))


@router.post("/alarms/acknowledgements", dependencies=[OPERATE])
def post_acknowledgement_form(
    query: Annotated[AlarmQuery, Query()],
    form: Annotated[AcknowledgementForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Acknowledge the ticked alarms and groups with one reason, and return to the list."""
    ids = dict.fromkeys(form.ids)
    with runtime.database.reading() as session:
        found = read_alarms(session)
        chosen = query.choose(found.alarms)
        causes = find_common_causes(session, chosen, runtime.settings)
    groups = {group.token: group.alarms for group in group_alarms(chosen)}
    groups |= {cause.token: cause.alarms for cause in causes}
    for token in form.groups:
        if token not in groups:
            name = "cause" if token.startswith("cause:") else "reason"
            raise ConflictError(
                f"groups: the alarms of this {name} changed since the page was opened; look at"
                " them again"
            )
        ids |= dict.fromkeys(alarm.id for alarm in groups[token])
    done = acknowledge(runtime, found, list(ids), identity.name, form.comment)
    return go_to(query.link(done=done[0].acknowledgement))


@router.post("/alarms/acknowledgements/{number}/undo", dependencies=[OPERATE])
def post_undo_form(
    number: Annotated[Version, Path(description="Number of the acknowledgement.")],
    runtime: RuntimeDep,
    identity: IdentityDep,
    page: Annotated[Literal["alarms", "history"], Query()] = "alarms",
    heliostat: Annotated[Name | None, Query()] = None,
) -> Response:
    """Undo an acknowledgement, and return to the page."""
    undo_acknowledgement(runtime, number, identity.name)
    if heliostat is not None:
        return go_to(f"/heliostats/{heliostat}#warnings-title")
    return go_to("/alarms" if page == "alarms" else "/alarms/history")


@router.get("/alarms/history", dependencies=[READ, OVERVIEW_SLOT])
def get_alarm_history_page(
    request: Request, query: Annotated[HistoryQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """Acknowledgements with their reasons, and alarms that are or were present."""
    with runtime.database.reading() as session:
        rows = acknowledgements.list_history(
            session, _LISTED + 1, query.after, query.reason, query.heliostat
        )
        batches = acknowledgements.list_batches(session, _BATCHES)
    return render(
        request,
        "alarm_history.html",
        reasons=REASONS,
        severities=SEVERITIES,
        query=query,
        batches=[] if query.after else batches,
        rows=rows[:_LISTED],
        older=query.older(rows[_LISTED - 1].row.id) if len(rows) > _LISTED else None,
    )
