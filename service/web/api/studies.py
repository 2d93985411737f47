"""Studies, and the versions of the plant's model that come of them."""

from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Body, Path, Query, Response, status
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Field
from sqlalchemy.orm import Session

from service import store
from service.base.faults import NotFoundError
from service.base.fields import Flag, Model, StudyReport, Verdict, Version
from service.jobs.kinds import KINDS
from service.store.tables import StudyRow
from service.twin import versions
from service.web.answers.openapi import TEXT, problems
from service.web.answers.paging import Page, page
from service.web.api.jobs import add_creator
from service.web.api.models import ModelOut, current_out, model_out
from service.web.door.dependencies import OPERATE, READ, IdentityDep, Limit, RuntimeDep


class StudySummary(BaseModel):
    """A study without its figures."""

    id: int
    created_at: datetime
    created_by: str = Field(description="Name of the key that asked for it.")
    options: dict[str, Any] = Field(description="What was asked.")
    heliostats: list[str] = Field(description="Those whose photographs were studied.")
    taken_from: datetime | None = Field(description="When the first photograph was taken, where that is known.")
    taken_to: datetime | None = Field(description="When the last one was.")
    model_version: str = Field(description="Version of the plant's model that the photographs were held against.")
    adopted: str | None = Field(description="Version of the model that stands for what was found, unless withdrawn.")
    verdict: Verdict = Field(description="effect: it is found; none: nothing is missing; unexplained: something is.")
    conclusion: str


class StudyOut(StudySummary, StudyReport):
    """A study with its report."""


class AdoptedOut(ModelOut):
    """The version that an adoption made, and the surfaces that were not made by it."""

    outdated_surfaces: dict[str, int] = Field(
        description="Versions of today's surfaces that another version of the model made, by heliostat; "
        "`POST /v1/jobs/predictions` makes them anew."
    )


class AdoptIn(Model):
    """How to adopt what a study found."""

    force: Flag = Field(
        default=False,
        description="Also where its verdict is not `effect`, or another version of the model is current by now, which "
        "it then takes the place of.",
    )


def _study_fields(row: StudyRow, adopted: str | None) -> dict[str, Any]:
    names = StudySummary.model_fields.keys() - {"adopted"}
    return {name: getattr(row, name) for name in names} | {"adopted": adopted}


def study_summary(row: StudyRow, adopted: str | None) -> StudySummary:
    """A study without its figures; ``adopted`` is the version that stands for what it found."""
    return StudySummary.model_validate(_study_fields(row, adopted))


def study_out(row: StudyRow, adopted: str | None) -> StudyOut:
    """A study, loaded with its report, as JSON."""
    return StudyOut.model_validate({**row.report, **_study_fields(row, adopted), "skipped": row.skipped})


router = APIRouter(tags=["studies"])
Number = Annotated[Version, Path(description="Id of the study.")]

REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; sandbox allow-same-origin"
)
"""The page holds its style and its pictures, and nothing else may run or load in it; of this origin, for its links."""


add_creator(router, KINDS["studies"], "/studies", "post_study")


def _adopted(session: Session, row: StudyRow) -> str | None:
    version = versions.find_adopted(session, row.id)
    return None if version is None else version.version


@router.get("/studies", responses=problems(), dependencies=[READ])
def list_studies(
    runtime: RuntimeDep,
    limit: Limit = 100,
    after: Annotated[Version | None, Query(description="The last id of the page before.")] = None,
) -> Page[StudySummary]:
    """Studies, newest first."""
    with runtime.database.reading() as session:
        rows = store.list_studies(session, limit + 1, after)
        adopted = versions.adopted_from(session, [row.id for row in rows])
    versions_of = {study: version.version for study, version in adopted.items()}
    items = [study_summary(row, versions_of.get(row.id)) for row in rows]
    return page(items, limit)


@router.get("/studies/{number}", responses=problems(404), dependencies=[READ])
def get_study(number: Number, runtime: RuntimeDep) -> StudyOut:
    """A study: its verdict, what it found, and what that buys."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number)
        return study_out(row, _adopted(session, row))


@router.get(
    "/studies/{number}/report",
    response_class=Response,
    responses={
        **problems(404),
        200: {"description": "A page that stands alone.", "content": {"text/html": {"schema": TEXT}}},
    },
    dependencies=[READ],
)
def get_study_report(number: Number, runtime: RuntimeDep) -> HTMLResponse:
    """The study as a page for people."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number, page=True)
    if row.html is None:
        raise NotFoundError(f"study {number} came as a report without a page")
    return HTMLResponse(row.html, headers={"Content-Security-Policy": REPORT_POLICY})


@router.post(
    "/studies/{number}/adopt",
    status_code=status.HTTP_201_CREATED,
    responses=problems(404, 409, 413),
    dependencies=[OPERATE],
)
def adopt_study(
    number: Number,
    runtime: RuntimeDep,
    identity: IdentityDep,
    request: Annotated[AdoptIn | None, Body(examples=[{"force": False}])] = None,
) -> AdoptedOut:
    """Make what the study found the next version of the plant's model, which is used from then on."""
    force = request is not None and request.force
    with runtime.database.writing() as session:
        row = versions.adopt(session, number, identity.name, force)
        outdated = {one.heliostat: one.version for one in store.outdated_surfaces(session, row.version)}
        return AdoptedOut(**dict(model_out(row, is_current=True)), outdated_surfaces=outdated)


@router.post("/studies/{number}/withdraw", responses=problems(404, 409), dependencies=[OPERATE])
def withdraw_study(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> ModelOut:
    """Take back what was adopted from the study; the version before is current again, and is the answer."""
    with runtime.database.writing() as session:
        versions.withdraw(session, number, identity.name)
        return current_out(session)
