"""Pages of studies: which effects the model still lacks, and the decision to adopt them."""

from typing import Annotated, Literal

from fastapi import APIRouter, Form, Path, Query, Request, Response
from fastapi.responses import HTMLResponse
from pydantic import Field
from sqlalchemy.orm import Session

from service import store
from service.base.errors import ConflictError
from service.base.fields import CheckedStudyReport, Method, Model, ReadVersion, Text, Version
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import predictions
from service.jobs.kinds.predictions import PredictionsIn
from service.store.tables import PlantRow
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.plant import model_versions
from service.twin.studies.changes import (
    EACH_S,
    AccuracyChange,
    forecast_changes,
    heliostats_to_forecast,
)
from service.twin.studies.states import study_states
from service.web.api.studies import REPORT_POLICY, study_html
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    RuntimeDep,
)
from service.web.pages.study_charts import study_timelines
from service.web.responses.pages import go_to, render

router = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Id of the study.")]

_PAGE = 50

# A report begins with this text. The page replaces it by links back to the study.
_CRUMB = "heliotwin study</p>"


class DecisionForm(Model):
    """A form that adopts or withdraws. ``read`` is the tick below warnings.

    ``back`` is the page to return to, and ``current`` the version of the model that it showed.
    """

    read: bool = False
    reason: Annotated[Text, Field(max_length=200)] = ""
    back: Literal["", "list"] = ""
    current: ReadVersion = None

    def path(self, number: int) -> str:
        """The path of the page to return to."""
        return "/studies#studies-title" if self.back else f"/studies/{number}"


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
        states = study_states(session, rows[:_PAGE])
        current = None if session.get(PlantRow, 1) is None else model_versions.get_model(session)
        adoptions = model_versions.list_models(session)
        outdated = store.outdated_surfaces(session, model_versions.current_version(session))
    more = rows[_PAGE - 1].id if len(rows) > _PAGE else None
    return render(
        request,
        "studies.html",
        studies=rows[:_PAGE],
        states=states,
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
        state = study_states(session, [row])[number]
        current = model_versions.current_number(session)
        outdated = store.outdated_surfaces(session, model_versions.current_version(session))
        report = CheckedStudyReport.model_validate(row.report)
        taken = store.times_of_photographs(session, report.before.per_image)
        zone = plant_time_zone(session, runtime.settings.time_zone)
    return render(
        request,
        "studied.html",
        timelines=study_timelines(report, taken, zone),
        study=row,
        report=report,
        parameters=[
            (effect, name, fitted)
            for effect in report.effects
            for name, fitted in effect.parameters.items()
        ],
        has_page=has_page,
        accuracy=_accuracy_change(report),
        n_forecasts=len(heliostats_to_forecast(row)),
        forecast_s=EACH_S * len(heliostats_to_forecast(row)),
        state=state,
        adopted=state.version if state.adopted else None,
        current=current,
        outdated=outdated,
    )


@router.get("/studies/{number}/change", dependencies=[READ, RENDER_SLOT, COMPUTE_SLOT])
def get_change_page(number: Number, request: Request, runtime: RuntimeDep) -> HTMLResponse:
    """What adopting a study would change in forecasts. They are computed for this page."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number)
        state = study_states(session, [row])[number]
    if not state.findings.effects:
        raise ConflictError(f"study {number} found no effect; adopting it changes nothing")
    return render(
        request,
        "study_change.html",
        study=row,
        state=state,
        accuracy=_accuracy_change(CheckedStudyReport.model_validate(row.report)),
        changes=forecast_changes(runtime, row),
    )


def _accuracy_change(report: CheckedStudyReport) -> AccuracyChange | None:
    return AccuracyChange.of(report.before.per_image, report.after.per_image)


@router.get("/studies/{number}/report", dependencies=[READ])
def get_study_report_page(number: Number, runtime: RuntimeDep) -> HTMLResponse:
    """The report as a separate page, with links back to its study."""
    back = (
        f'heliotwin / <a href="/studies">studies</a> / <a href="/studies/{number}">{number}</a> /'
        " report</p>"
    )
    report = study_html(runtime, number).replace(_CRUMB, back, 1)
    return HTMLResponse(report, headers={"Content-Security-Policy": REPORT_POLICY})


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
    number: Number,
    form: Annotated[DecisionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Adopt the result of a study as the next plant model."""

    def adopt(session: Session) -> None:
        state = study_states(session, [store.get_study(session, number)])[number]
        if state.questions and form.reason and not form.read:
            raise ConflictError("read: tick 'I have read this' below the warning")
        reason = form.reason or None
        model_versions.adopt(session, number, identity.name, form.read, reason, form.current)

    runtime.database.run_in_transaction(adopt)
    return go_to(form.path(number))


@router.post("/studies/{number}/withdraw", dependencies=[OPERATE])
def post_withdraw_form(
    number: Number,
    form: Annotated[DecisionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Withdraw the adopted model."""
    runtime.database.run_in_transaction(
        lambda session: model_versions.withdraw(session, number, identity.name, form.reason or None)
    )
    return go_to(form.path(number))
