"""Studies, and the versions of the plant model that are adopted from them."""

from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response, status
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Field
from sqlalchemy.orm import Session

from service import store
from service.base.errors import NotFoundError
from service.base.fields import (
    CreatedAt,
    Flag,
    Id,
    Model,
    ModelNumber,
    Reason,
    StudyReport,
    Verdict,
    Version,
    from_row,
)
from service.jobs.kinds import KINDS
from service.store.listing import Order, Period
from service.store.tables import StudyRow
from service.twin.plant import model_versions
from service.twin.runtime.runtime import Runtime
from service.twin.studies.states import AdoptionState, StudyState, study_states
from service.web.api.jobs import add_creator
from service.web.api.models import ModelOut, current_out, model_out
from service.web.auth.dependencies import OPERATE, READ, IdentityDep, Limit, RuntimeDep
from service.web.responses.openapi import TEXT, problems
from service.web.responses.paging import OrderQuery, Page, Since, Until, page


class StudySummary(BaseModel):
    """A study without its figures."""

    id: Id
    created_at: CreatedAt
    created_by: str = Field(description="Name of the key that asked for it.")
    options: dict[str, object] = Field(description="What was asked.")
    heliostats: list[str] = Field(description="Those whose photographs were studied.")
    first_taken_at: datetime | None = Field(
        description="When the first photograph was taken, where that is known."
    )
    last_taken_at: datetime | None = Field(description="When the last one was.")
    model_version: ModelNumber = Field(
        description="Version of the plant's model that the photographs were compared with."
    )
    adopted: int | None = Field(
        description="Version of the model that was adopted from it, unless withdrawn."
    )
    verdict: Verdict = Field(
        description="effect: it is found; none: nothing is missing; unexplained: something is."
    )
    conclusion: str = Field(description="The verdict in one sentence.")
    state: AdoptionState = Field(
        description=(
            "What became of it; replaced: a version that was adopted from it, and a later one is"
            " current."
        )
    )
    open_questions: list[str] = Field(
        description="What it leaves open; to adopt it then needs a reason."
    )


class StudyOut(StudySummary, StudyReport):
    """A study with its report."""


class AdoptedOut(ModelOut):
    """The version that an adoption made, and the surfaces that it outdates."""

    outdated_surfaces: dict[str, int] = Field(
        description=(
            "Versions of active surfaces that another version of the model made, by heliostat; "
            "`POST /v1/jobs/predictions` makes them again."
        )
    )


class AdoptIn(Model):
    """How to adopt the result of a study."""

    force: Flag = Field(
        default=False,
        description=(
            "Also where its verdict is not `effect`, or another version of the model is current by"
            " now, which it then takes the place of."
        ),
    )
    reason: Reason | None = Field(
        default=None,
        description=(
            "Why; kept with the version. Needed if the study leaves questions open: more than half"
            " of the error beyond noise is unexplained, or other effects look alike."
        ),
    )


class WithdrawIn(Model):
    """How to withdraw what was adopted from a study."""

    reason: Reason | None = Field(default=None, description="Why; kept with the version.")


def study_summary(row: StudyRow, state: StudyState) -> StudySummary:
    """A study without its figures."""
    questions = [question.finding for question in state.questions]
    about = {"adopted": state.adopted, "state": state.state, "open_questions": questions}
    return from_row(StudySummary, row, **about)


def study_out(row: StudyRow, state: StudyState) -> StudyOut:
    """A study, loaded with its report, as JSON."""
    return StudyOut.model_validate(
        {**row.report, **dict(study_summary(row, state)), "skipped": row.skipped}
    )


def study_html(runtime: Runtime, number: int) -> str:
    """The report of a study as a page; NotFoundError if it has none."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number, page=True)
    if row.html is None:
        raise NotFoundError(f"study {number} came as a report without a page")
    return row.html


router = APIRouter(tags=["studies"])
Number = Annotated[Version, Path(description="Id of the study.")]

REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action"
    " 'none'; frame-ancestors 'none'; sandbox allow-same-origin"
)
"""Content security policy of the report, which includes its style and images.

Nothing else may load or run in it. It keeps this origin, so that its links work.
"""


add_creator(router, KINDS["studies"], "/studies", "post_study")


@router.get("/studies", responses=problems(), dependencies=[READ])
def list_studies(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
    verdict: Annotated[Verdict | None, Query(description="Only those of this verdict.")] = None,
    since: Since = None,
    until: Until = None,
    order: OrderQuery = "down",
) -> Page[StudySummary]:
    """List studies, newest first."""
    with runtime.database.reading() as session:
        made, direction = Period(since, until), Order(descending=order == "down")
        rows = store.list_studies(
            session, limit + 1, after, verdict=verdict, created=made, order=direction
        )
        states = study_states(session, rows)
    items = [study_summary(row, states[row.id]) for row in rows]
    return page(items, limit)


@router.get("/studies/{number}", responses=problems(404), dependencies=[READ])
def get_study(number: Number, runtime: RuntimeDep) -> StudyOut:
    """Get a study: its verdict, its results, and their benefit."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number)
        return study_out(row, study_states(session, [row])[number])


@router.get(
    "/studies/{number}/report",
    response_class=Response,
    responses={
        **problems(404),
        200: {"description": "A self-contained page.", "content": {"text/html": {"schema": TEXT}}},
    },
    dependencies=[READ],
)
def get_study_report(number: Number, runtime: RuntimeDep) -> HTMLResponse:
    """Get the report of a study as a page for people."""
    headers = {"Content-Security-Policy": REPORT_POLICY}
    return HTMLResponse(study_html(runtime, number), headers=headers)


@router.post(
    "/studies/{number}/adopt",
    status_code=status.HTTP_201_CREATED,
    responses=problems(404, 409, 413),
    dependencies=[OPERATE],
)
def adopt_study(
    number: Number, runtime: RuntimeDep, identity: IdentityDep, request: AdoptIn | None = None
) -> AdoptedOut:
    """Adopt the result of a study. It becomes the current version of the plant model."""
    asked = request or AdoptIn()

    def adopt(session: Session) -> AdoptedOut:
        row = model_versions.adopt(session, number, identity.name, asked.force, asked.reason)
        outdated = {
            one.heliostat: one.version for one in store.outdated_surfaces(session, row.version)
        }
        return AdoptedOut(**dict(model_out(row, is_current=True)), outdated_surfaces=outdated)

    return runtime.database.run_in_transaction(adopt)


@router.post(
    "/studies/{number}/withdraw", responses=problems(404, 409, 413), dependencies=[OPERATE]
)
def withdraw_study(
    number: Number, runtime: RuntimeDep, identity: IdentityDep, request: WithdrawIn | None = None
) -> ModelOut:
    """Withdraw what was adopted from a study.

    The version before it is current again, and is the response.
    """

    def withdraw(session: Session) -> ModelOut:
        model_versions.withdraw(session, number, identity.name, (request or WithdrawIn()).reason)
        return current_out(session)

    return runtime.database.run_in_transaction(withdraw)
