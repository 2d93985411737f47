"""Studies, and the versions of the plant's model that come of them."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Query, Response, status
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from service import models, representations, store
from service.dependencies import OPERATE, READ, IdentityDep, Limit, RuntimeDep
from service.faults import NotFoundError
from service.handlers import KINDS
from service.openapi import problems
from service.routers.jobs import add_creator
from service.schemas import AdoptIn, ModelOut, Page, StudyOut, StudySummary, Version
from service.tables import StudyRow

router = APIRouter(tags=["studies"])

Number = Annotated[Version, Path(description="Id of the study.")]

# The page holds its style and its pictures, and nothing else may run or load in it.
_PAGE_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)

add_creator(router, KINDS["studies"], "/studies", "post_study")


def _adopted(session: Session, row: StudyRow) -> str | None:
    version = models.find_adopted(session, row.id)
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
        items = [representations.study_summary(row, _adopted(session, row)) for row in rows]
    return representations.page(items, limit)


@router.get("/studies/{number}", responses=problems(404), dependencies=[READ])
def get_study(number: Number, runtime: RuntimeDep) -> StudyOut:
    """A study: its verdict, what it found, and what that buys."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number)
        return representations.study(row, _adopted(session, row))


@router.get(
    "/studies/{number}/report",
    response_class=Response,
    responses={**problems(404), 200: {"description": "A page that stands alone.", "content": {"text/html": {}}}},
    dependencies=[READ],
)
def get_study_report(number: Number, runtime: RuntimeDep) -> HTMLResponse:
    """The study as a page for people."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number, page=True)
    if row.html is None:
        raise NotFoundError(f"study {number} came as a report without a page")
    return HTMLResponse(row.html, headers={"Content-Security-Policy": _PAGE_POLICY})


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
) -> ModelOut:
    """Make what the study found the next version of the plant's model, which is used from then on."""
    force = request is not None and request.force
    with runtime.database.writing() as session:
        return representations.model(models.adopt(session, number, identity.name, force), is_current=True)


@router.post("/studies/{number}/withdraw", responses=problems(404, 409), dependencies=[OPERATE])
def withdraw_study(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> ModelOut:
    """Take back what was adopted from the study; the version before is current again, and is the answer."""
    with runtime.database.writing() as session:
        models.withdraw(session, number, identity.name)
        return _current(session)


def _current(session: Session) -> ModelOut:
    row = models.find_current(session)
    return representations.declared_model(True) if row is None else representations.model(row, is_current=True)


@router.get("/models", responses=problems(), dependencies=[READ])
def list_models(runtime: RuntimeDep) -> Page[ModelOut]:
    """All versions of the plant's model, oldest first, withdrawn ones too."""
    with runtime.database.reading() as session:
        return Page(items=representations.all_models(session), next=None)


@router.get("/models/current", responses=problems(), dependencies=[READ])
def get_current_model(runtime: RuntimeDep) -> ModelOut:
    """The version that forecasts and predictions are made by."""
    with runtime.database.reading() as session:
        return _current(session)
