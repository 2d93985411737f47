"""Pages of studies: which effects the model still lacks, and the decision to adopt them."""

from typing import Annotated

from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.responses import HTMLResponse

from service import store
from service.base.errors import ConflictError
from service.base.fields import CheckedStudyReport, Method, Model, Version
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import predictions, studies
from service.jobs.kinds.predictions import PredictionsIn
from service.jobs.kinds.studies import StudyIn
from service.store.tables import PlantRow
from service.twin.plant import model_versions
from service.web.api.studies import REPORT_POLICY, study_html
from service.web.auth.dependencies import OPERATE, READ, IdentityDep, RuntimeDep
from service.web.responses.pages import go_to, render

router = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Id of the study.")]

_PAGE = 50

# A report begins with this text. The page replaces it by links back to the study.
_CRUMB = "heliotwin study</p>"


class AdoptForm(Model):
    """The button. ``force`` adopts against the verdict of the study."""

    force: bool = False


class PredictAgainForm(Model):
    """The button that predicts surfaces again with the current model."""

    method: Method = "refined"


@router.get("/studies", dependencies=[READ])
def get_studies_page(
    request: Request, runtime: RuntimeDep, after: Annotated[Version | None, Query()] = None
) -> HTMLResponse:
    """Studies, newest first, and the versions of the plant model that were adopted from them."""
    with runtime.database.reading() as session:
        rows = store.list_studies(session, _PAGE + 1, after)
        adopted = model_versions.adopted_from(session, [row.id for row in rows])
        current = None if session.get(PlantRow, 1) is None else model_versions.get_model(session)
        adoptions = model_versions.list_models(session)
        outdated = store.outdated_surfaces(session, model_versions.current_version(session))
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
    """A study with its report, and the button that adopts its result."""
    with runtime.database.reading() as session:
        row, has_page = store.get_study(session, number), store.has_study_page(session, number)
        adopted, current = (
            model_versions.find_adopted(session, number),
            model_versions.current_number(session),
        )
        outdated = store.outdated_surfaces(session, model_versions.current_version(session))
    report = CheckedStudyReport.model_validate(row.report)
    return render(
        request,
        "studied.html",
        study=row,
        report=report,
        parameters=[
            (effect, name, fitted)
            for effect in report.effects
            for name, fitted in effect.parameters.items()
        ],
        has_page=has_page,
        adopted=adopted,
        current=current,
        outdated=outdated,
    )


@router.get("/studies/{number}/report", dependencies=[READ])
def get_study_report_page(number: Number, runtime: RuntimeDep) -> HTMLResponse:
    """The report as a separate page, with links back to its study."""
    back = (
        f'heliotwin / <a href="/studies">studies</a> / <a href="/studies/{number}">{number}</a> /'
        " report</p>"
    )
    report = study_html(runtime, number).replace(_CRUMB, back, 1)
    return HTMLResponse(report, headers={"Content-Security-Policy": REPORT_POLICY})


@router.post("/studies", dependencies=[OPERATE])
def post_study_form(runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Enqueue a study with default settings, and go to the page of the job."""
    row = enqueue(runtime, studies.KIND, StudyIn(), identity.name)
    return go_to(f"/jobs/{row.id}")


@router.post("/studies/predictions", dependencies=[OPERATE])
def post_predict_again_form(
    form: Annotated[PredictAgainForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Predict the active surfaces again that another version of the model made.

    Go to the page of the job.
    """
    with runtime.database.reading() as session:
        outdated = store.outdated_surfaces(session, model_versions.current_version(session))
    names = [surface.heliostat for surface in outdated if not surface.waits]
    if not names:
        raise ConflictError(
            "all surfaces were made by the current model, or one that was waits aside"
        )
    payload = PredictionsIn(heliostats=names, method=form.method)
    return go_to(f"/jobs/{enqueue(runtime, predictions.KIND, payload, identity.name).id}")


@router.post("/studies/{number}/adopt", dependencies=[OPERATE])
def post_adopt_form(
    number: Number, form: Annotated[AdoptForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Adopt the result of a study as the next plant model."""
    with runtime.database.writing() as session:
        model_versions.adopt(session, number, identity.name, form.force)
    return go_to(f"/studies/{number}")


@router.post("/studies/{number}/withdraw", dependencies=[OPERATE])
def post_withdraw_form(number: Number, runtime: RuntimeDep, identity: IdentityDep) -> Response:
    """Withdraw the adopted model."""
    with runtime.database.writing() as session:
        model_versions.withdraw(session, number, identity.name)
    return go_to(f"/studies/{number}")
