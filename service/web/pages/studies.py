"""Studies: what the photographs say that the model still lacks, and the operator's decision on it."""

from typing import Annotated

from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.responses import HTMLResponse

from service import store
from service.base.faults import NotFoundError
from service.base.fields import Model, Version
from service.jobs.asking import ask_for
from service.jobs.kinds.studies import StudyIn
from service.twin import versions
from service.web.answers.pages import go_to, render
from service.web.door.dependencies import OPERATE, READ, IdentityDep, RuntimeDep

router = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Id of the study.")]

_PAGE = 50

# The report brings its style and pictures along. In its frame, sandboxed, nothing runs and nothing is asked for; only
# this service's own pages may frame it.
_FRAMED = {
    "Content-Security-Policy": (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'self'; sandbox"
    ),
    "X-Frame-Options": "SAMEORIGIN",
}


class AdoptForm(Model):
    """The button; ``force`` is ticked where the operator knows better than the verdict."""

    force: bool = False


@router.get("/studies", dependencies=[READ])
def get_studies_page(
    request: Request, runtime: RuntimeDep, after: Annotated[Version | None, Query()] = None
) -> HTMLResponse:
    """Studies, newest first, and the versions of the plant's model that came of them."""
    with runtime.database.reading() as session:
        rows = store.list_studies(session, _PAGE + 1, after)
        adopted = versions.adopted_from(session, [row.id for row in rows])
        current, adoptions = versions.get_model(session), versions.list_models(session)
    more = rows[_PAGE - 1].id if len(rows) > _PAGE else None
    return render(
        request,
        "studies.html",
        studies=rows[:_PAGE],
        adopted=adopted,
        current=current,
        versions=adoptions,
        more=more,
        after=after,
    )


@router.get("/studies/{number}", dependencies=[READ])
def get_study_page(number: Number, request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """A study with its report, and the button that makes the plant's model out of it."""
    with runtime.database.reading() as session:
        row, has_page = store.get_study(session, number), store.has_study_page(session, number)
        adopted, current = versions.find_adopted(session, number), versions.current_number(session)
    return render(request, "studied.html", study=row, has_page=has_page, adopted=adopted, current=current)


@router.get("/studies/{number}/report", dependencies=[READ])
def get_study_report_page(number: Number, runtime: RuntimeDep) -> HTMLResponse:
    """The report by itself, for the frame in its page."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number, page=True)
    if row.html is None:
        raise NotFoundError(f"study {number} came as a report without a page")
    return HTMLResponse(row.html, headers=_FRAMED)


@router.post("/studies", dependencies=[OPERATE])
def post_study_form(runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Study what is stored, as the settings of a study are by default; go to the job's page."""
    row = ask_for(runtime, "studies", StudyIn().model_dump(mode="json"), identity.name)
    return go_to(f"/jobs/{row.id}")


@router.post("/studies/{number}/adopt", dependencies=[OPERATE])
def post_adopt_form(
    number: Number, form: Annotated[AdoptForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Make what the study found the plant's next model."""
    with runtime.database.writing() as session:
        versions.adopt(session, number, identity.name, form.force)
    return go_to(f"/studies/{number}")


@router.post("/studies/{number}/withdraw", dependencies=[OPERATE])
def post_withdraw_form(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Take back what was adopted."""
    with runtime.database.writing() as session:
        versions.withdraw(session, number, identity.name)
    return go_to(f"/studies/{number}")
