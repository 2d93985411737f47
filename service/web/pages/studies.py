"""Studies: what the photographs say that the model still lacks, and the operator's decision on it."""

from typing import Annotated

from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.responses import HTMLResponse

from service import store
from service.base.faults import ConflictError, NotFoundError
from service.base.fields import Method, Model, Version
from service.jobs.asking import ask_for
from service.jobs.kinds.predictions import PredictionsIn
from service.jobs.kinds.studies import StudyIn
from service.twin import versions
from service.web.answers.pages import go_to, render
from service.web.api.studies import REPORT_POLICY
from service.web.door.dependencies import OPERATE, READ, IdentityDep, RuntimeDep

router = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Id of the study.")]

_PAGE = 50

# What a report begins with, whoever it is mailed to; here it leads back to its study.
_CRUMB = "heliotwin study</p>"


class AdoptForm(Model):
    """The button; ``force`` is ticked where the operator knows better than the verdict."""

    force: bool = False


class RemakeForm(Model):
    """The button that makes surfaces anew by the current model."""

    method: Method = "refined"


@router.get("/studies", dependencies=[READ])
def get_studies_page(
    request: Request, runtime: RuntimeDep, after: Annotated[Version | None, Query()] = None
) -> HTMLResponse:
    """Studies, newest first, and the versions of the plant's model that came of them."""
    with runtime.database.reading() as session:
        rows = store.list_studies(session, _PAGE + 1, after)
        adopted = versions.adopted_from(session, [row.id for row in rows])
        current, adoptions = versions.get_model(session), versions.list_models(session)
        outdated = store.outdated_surfaces(session, current.version)
    more = rows[_PAGE - 1].id if len(rows) > _PAGE else None
    return render(
        request,
        "studies.html",
        studies=rows[:_PAGE],
        adopted=adopted,
        current=current,
        outdated=outdated,
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
        outdated = store.outdated_surfaces(session, versions.current_version(session))
    return render(
        request, "studied.html", study=row, has_page=has_page, adopted=adopted, current=current, outdated=outdated
    )


@router.get("/studies/{number}/report", dependencies=[READ])
def get_study_report_page(number: Number, runtime: RuntimeDep) -> HTMLResponse:
    """The report, a page of its own, which leads back to its study."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number, page=True)
    if row.html is None:
        raise NotFoundError(f"study {number} came as a report without a page")
    back = f'heliotwin / <a href="/studies">studies</a> / <a href="/studies/{number}">{number}</a> / report</p>'
    return HTMLResponse(row.html.replace(_CRUMB, back, 1), headers={"Content-Security-Policy": REPORT_POLICY})


@router.post("/studies", dependencies=[OPERATE])
def post_study_form(runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Study what is stored, as the settings of a study are by default; go to the job's page."""
    row = ask_for(runtime, "studies", StudyIn().model_dump(mode="json"), identity.name)
    return go_to(f"/jobs/{row.id}")


@router.post("/studies/remake", dependencies=[OPERATE])
def post_remake_form(form: Annotated[RemakeForm, Form()], runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Make those of today's surfaces anew that another version of the model made; go to the job's page."""
    with runtime.database.reading() as session:
        outdated = store.outdated_surfaces(session, versions.current_version(session))
    names = [surface.heliostat for surface in outdated if not surface.waits]
    if not names:
        raise ConflictError("all surfaces were made by the current model, or one that was waits aside")
    payload = PredictionsIn(heliostats=names, method=form.method).model_dump(mode="json")
    return go_to(f"/jobs/{ask_for(runtime, 'predictions', payload, identity.name).id}")


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
