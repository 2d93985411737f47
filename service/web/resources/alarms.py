"""Alarms: what is wrong, since when, what to do, who acknowledged it, and the history."""

from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import datetime
from operator import attrgetter
from typing import Annotated, Literal, NamedTuple, Self, get_args
from urllib.parse import urlencode

from fastapi import APIRouter, Body, Depends, Form, Path, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Field, TypeAdapter, computed_field, model_validator

from service.base import fields
from service.base.errors import ConflictError
from service.base.fields import (
    Author,
    CreatedAt,
    From,
    Id,
    Model,
    Name,
    Text,
    Version,
    drop_empty_fields,
    from_row,
)
from service.store import acknowledgements
from service.store.acknowledgements import StoredAlarm
from service.store.job_tables import AcknowledgementRow
from service.twin.alarms.acknowledging import (
    AlarmFilter,
    AlarmGroup,
    acknowledge,
    group_alarms,
    undo_acknowledgement,
)
from service.twin.alarms.alarms import Alarm, AlarmId, AlarmList, read_alarms
from service.twin.alarms.common_causes import CommonCause, find_common_causes
from service.twin.alarms.reasons import (
    REASONS,
    SEVERITIES,
    AlarmCount,
    CountByReason,
    HeliostatOrPlant,
    Reason,
    ReasonOf,
    SeverityOf,
)
from service.twin.runtime import Runtime
from service.web.auth.dependencies import (
    OPERATE,
    OVERVIEW_SLOT,
    READ,
    RENDER_SLOT,
    IdentityDep,
    Limit,
    RuntimeDep,
    require_json,
)
from service.web.responses.lists import AfterId, Page, page, sheet_answer
from service.web.responses.openapi import problems
from service.web.responses.pages import count_badge, go_to, render

router = APIRouter(prefix="/alarms", tags=["alarms"])
pages = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Number of the acknowledgement.")]

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

_LABELS = {"reasons": REASONS, "severities": SEVERITIES}
_SCHEMA = TypeAdapter(Alarm).json_schema(mode="serialization")
_COLUMNS = list(dict.fromkeys(["id", "severity", *_SCHEMA["properties"]]))


class AlarmPage(Page[Alarm]):
    """A part of the list of alarms."""

    computed_at: datetime = Field(description="When a worker last wrote the alarms.")
    pending: int = Field(
        description=(
            "Heliostats of which results are still being computed; at least 1 if something was"
            " stored since the alarms were written. Ask again."
        )
    )


class AcknowledgementOut(BaseModel):
    """Alarms that were acknowledged together."""

    id: Id
    created_at: CreatedAt
    created_by: Author
    reason: str = Field(description="Why; empty if it was acknowledged before reasons were asked.")
    alarms: CountByReason
    undone_at: datetime | None = Field(description="When it was undone; null: it was not.")
    undone_by: str | None = Field(description="Name of the key that undid it.")

    @classmethod
    def of(cls, rows: Sequence[AcknowledgementRow]) -> Self:
        """The acknowledgement of some alarms, which have a row each."""
        return from_row(
            cls,
            rows[0],
            id=rows[0].batch,
            created_at=rows[0].made_at,
            created_by=rows[0].made_by,
            reason=rows[0].comment,
            alarms=Counter(row.reason for row in rows),
        )


class AlarmHistoryOut(BaseModel):
    """An alarm from its beginning to its end."""

    id: Id
    reason: ReasonOf
    heliostat: HeliostatOrPlant
    since: From
    message: str = Field(description="What is or was wrong.")
    ended_at: datetime | None = Field(
        description="Time of the photograph or the decision that ended it; null: it is present."
    )
    recorded_at: datetime = Field(description="When a worker first wrote it.")
    acknowledgements: list[AcknowledgementOut] = Field(
        description="Its acknowledgements, oldest first; also those that were undone."
    )

    @computed_field
    @property
    def severity(self) -> SeverityOf:
        """By the reason: 1 act now, 2 act today, 3 when there is time."""
        return REASONS[self.reason].severity

    @classmethod
    def of(cls, stored: StoredAlarm) -> Self:
        """The history of a stored alarm."""
        made = [AcknowledgementOut.of([row]) for row in stored.acknowledgements]
        return from_row(cls, stored.row, heliostat=stored.heliostat, acknowledgements=made)


class AlarmListQuery(AlarmFilter):
    """Which alarms are listed, in the order of ids."""

    limit: Limit = 100
    after: AlarmId | None = Field(default=None, description="The last id of the page before.")


class AlarmQuery(AlarmFilter):
    """Filters and order of the page. ``done`` is an acknowledgement that was made just now."""

    acknowledged: bool = False
    sort: Literal["severity", "newest", "oldest", "heliostat"] = "severity"
    done: Version | None = None
    page: Annotated[int, Field(ge=1, le=10**6)] = 1

    _filled = model_validator(mode="before")(drop_empty_fields)

    def link(self, path: str = "/alarms", **changes: object) -> str:
        """The URL of ``path`` with these filters, and with changes."""
        changed = self.model_copy(update={"done": None, "page": 1} | changes)
        asked = changed.model_dump(exclude_defaults=True)
        query = urlencode({key: "true" if value is True else value for key, value in asked.items()})
        return f"{path}?{query}" if query else path

    def choose(self, alarms: Iterable[Alarm]) -> list[Alarm]:
        """The wanted alarms in the wanted order."""
        chosen = super().choose(alarms)
        if self.sort == "heliostat":
            return sorted(chosen, key=lambda alarm: alarm.heliostat or "")
        if self.sort == "severity":
            return chosen
        return sorted(chosen, key=attrgetter("since"), reverse=self.sort == "newest")


class HistoryQuery(Model):
    """Which alarms of the history are listed."""

    reason: Reason | None = Field(default=None, description="Only this reason.")
    heliostat: Name | None = Field(default=None, description="Only this heliostat.")
    limit: Limit = 100
    after: AfterId = None


class HistoryForm(HistoryQuery):
    """The same as a form."""

    _filled = model_validator(mode="before")(drop_empty_fields)


class AcknowledgementsIn(Model):
    """Alarms to acknowledge."""

    ids: list[AlarmId] = Field(
        min_length=1, max_length=500, description="Ids of items of `GET /v1/alarms`."
    )
    reason: Annotated[fields.Reason, Field(description="Why they are acknowledged.")]


class AcknowledgementForm(Model):
    """The ticked alarms and groups, and why they are acknowledged."""

    ids: Annotated[list[AlarmId], Field(default_factory=list, max_length=500)]
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


# --- data


async def _count(request: Request) -> AlarmCount:
    count: AlarmCount = request.app.state.alarms
    return count


AlarmCountDep = Annotated[AlarmCount, Depends(_count)]


def stored_alarms(runtime: Runtime) -> AlarmList:
    """All alarms, acknowledged or not."""
    with runtime.database.reading() as session:
        return read_alarms(session)


def count_again(runtime: RuntimeDep, count: AlarmCountDep) -> AlarmCount:
    """The numbers of open alarms, counted again."""
    with runtime.database.reading() as session:
        count.read(session)
    return count


class ChosenAlarms(NamedTuple):
    """All alarms that were ``found``, and those of a page's query with their causes and groups."""

    query: AlarmQuery
    found: AlarmList
    chosen: list[Alarm]
    causes: list[CommonCause]
    groups: list[AlarmGroup]


def choose_alarms(query: Annotated[AlarmQuery, Query()], runtime: RuntimeDep) -> ChosenAlarms:
    """Read the alarms, and choose those of the query."""
    with runtime.database.reading() as session:
        found = read_alarms(session)
        chosen = query.choose(found.alarms)
        causes = find_common_causes(session, chosen, runtime.settings)
    groups = group_alarms(chosen) if query.sort == "severity" else []
    return ChosenAlarms(query, found, chosen, causes, groups)


ChosenAlarmsDep = Annotated[ChosenAlarms, Depends(choose_alarms)]


def alarm_figures(runtime: Runtime, alarms: ChosenAlarms) -> dict[str, object]:
    """What the page of alarms draws."""
    query, every = alarms.query, alarms.found.alarms
    return alarms._asdict() | {
        "comments": COMMENTS,
        "single": len(alarms.chosen) - sum(cause.count for cause in alarms.causes),
        "listed": _LISTED if query.reason is None else 5 * _LISTED,
        "others": sum((one.acknowledged_by is not None) != query.acknowledged for one in every),
        "done": _acknowledgements(runtime, 1, number=query.done) if query.done else [],
        "limits": runtime.settings,
    }


def _acknowledgements(
    runtime: Runtime, limit: int, after: int | None = None, number: int | None = None
) -> list[AcknowledgementOut]:
    with runtime.database.reading() as session:
        batches = acknowledgements.list_batches(session, limit, after, number)
    return [AcknowledgementOut.of(rows) for rows in batches]


# --- alarms and their causes


@router.get("", responses=problems(), dependencies=[READ, OVERVIEW_SLOT])
def list_alarms(query: Annotated[AlarmListQuery, Query()], runtime: RuntimeDep) -> AlarmPage:
    """List alarms, in the order of ids. The thresholds are those of the current settings."""
    found = stored_alarms(runtime)
    after = query.after or ""
    wanted = [alarm for alarm in query.choose(found.alarms) if alarm.id > after]
    part = page(sorted(wanted, key=attrgetter("id")), query.limit)
    return AlarmPage(**dict(part), computed_at=found.computed_at, pending=found.pending)


@pages.get("/alarms", dependencies=[READ, OVERVIEW_SLOT])
def get_alarms_page(
    request: Request, alarms: ChosenAlarmsDep, runtime: RuntimeDep, count: AlarmCountDep
) -> HTMLResponse:
    """Alarms that are not acknowledged, or those that are, by severity and reason or in a list."""
    count.last = sum(alarm.acknowledged_by is None for alarm in alarms.found.alarms)
    return render(request, "alarms.html", **_LABELS, **alarm_figures(runtime, alarms))


@pages.get("/alarms.csv", dependencies=[READ, RENDER_SLOT])
def get_alarms_table(runtime: RuntimeDep) -> Response:
    """All alarms, acknowledged or not."""
    alarms = stored_alarms(runtime).alarms
    rows = ([getattr(alarm, name) for name in _COLUMNS] for alarm in alarms)
    return sheet_answer("alarms", _COLUMNS, rows)


@pages.get("/alarms/count", dependencies=[READ])
def get_alarm_count(count: Annotated[AlarmCount, Depends(count_again)]) -> Response:
    """The number of alarms that are not acknowledged, for the menu."""
    return HTMLResponse(count_badge(count.last))


@router.get("/causes", responses=problems(), dependencies=[READ, OVERVIEW_SLOT])
def list_alarm_causes(runtime: RuntimeDep) -> Page[CommonCause]:
    """List probable causes of open alarms, the one of most first."""
    with runtime.database.reading() as session:
        alarms = read_alarms(session).alarms
        return Page(items=find_common_causes(session, alarms, runtime.settings), next=None)


# --- acknowledgements


@router.post(
    "/acknowledgements",
    responses=problems(404, 413, 415),
    dependencies=[OPERATE, Depends(require_json)],
)
def post_acknowledgements(
    runtime: RuntimeDep, identity: IdentityDep, seen: Annotated[AcknowledgementsIn, Body()]
) -> Page[Alarm]:
    """Acknowledge alarms together, with a reason.

    An acknowledgement lasts until the reason of the alarm changes or returns, or until it is
    undone. The first one is kept.
    """
    found = stored_alarms(runtime)
    items = acknowledge(runtime, found, seen.ids, identity.name, seen.reason)
    return Page(items=items, next=None)


@pages.post("/alarms/acknowledgements", dependencies=[OPERATE])
def post_acknowledgement_form(
    alarms: ChosenAlarmsDep,
    form: Annotated[AcknowledgementForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Acknowledge the ticked alarms and groups with one reason, and return to the list."""
    ids = dict.fromkeys(form.ids)
    groups = {group.token: group.members for group in (*alarms.groups, *alarms.causes)}
    for token in form.groups:
        if token not in groups:
            name = "cause" if token.startswith("cause:") else "reason"
            raise ConflictError(
                f"groups: the alarms of this {name} changed since the page was opened; look at"
                " them again"
            )
        ids |= dict.fromkeys(alarm.id for alarm in groups[token])
    done = acknowledge(runtime, alarms.found, list(ids), identity.name, form.comment)
    return go_to(alarms.query.link(done=done[0].acknowledgement))


@router.get("/acknowledgements", responses=problems(), dependencies=[READ])
def list_acknowledgements(
    runtime: RuntimeDep, limit: Limit = 100, after: AfterId = None
) -> Page[AcknowledgementOut]:
    """List acknowledgements, newest first, also those that were undone."""
    return page(_acknowledgements(runtime, limit + 1, after), limit)


@router.post(
    "/acknowledgements/{number}/undo", responses=problems(404, 409), dependencies=[OPERATE]
)
def undo_acknowledgements(
    number: Number, runtime: RuntimeDep, identity: IdentityDep
) -> AcknowledgementOut:
    """Undo an acknowledgement: its alarms are open again."""
    undo_acknowledgement(runtime, number, identity.name)
    return _acknowledgements(runtime, 1, number=number)[0]


@pages.post("/alarms/acknowledgements/{number}/undo", dependencies=[OPERATE])
def post_undo_form(
    number: Number,
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


# --- history


@router.get("/history", responses=problems(), dependencies=[READ, OVERVIEW_SLOT])
def list_alarm_history(
    query: Annotated[HistoryQuery, Query()], runtime: RuntimeDep
) -> Page[AlarmHistoryOut]:
    """List alarms that are or were present, the newest first."""
    with runtime.database.reading() as session:
        stored = acknowledgements.list_history(
            session, query.limit + 1, query.after, query.reason, query.heliostat
        )
    return page([AlarmHistoryOut.of(one) for one in stored], query.limit)


@pages.get("/alarms/history", dependencies=[READ, OVERVIEW_SLOT])
def get_alarm_history_page(
    request: Request, query: Annotated[HistoryForm, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """Acknowledgements with their reasons, and alarms that are or were present."""
    history = list_alarm_history(query, runtime)
    older = request.url.include_query_params(after=history.next) if history.next else None
    return render(
        request,
        "alarm_history.html",
        **_LABELS,
        query=query,
        batches=[] if query.after else _acknowledgements(runtime, _BATCHES),
        rows=history.items,
        older=older,
    )
