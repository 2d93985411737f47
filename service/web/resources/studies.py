"""Studies: which effects the plant's model still lacks, and the decision to adopt them."""

from collections.abc import Sequence
from datetime import date, datetime
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Form, Path, Query, Request, Response, status
from fastapi.responses import HTMLResponse
from markupsafe import Markup
from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    InstanceOf,
    StringConstraints,
    model_validator,
)
from sqlalchemy.orm import Session

from model.effects import CATALOGUE
from model.errors import InvalidInputError
from model.study.loop import MIN_IMAGES
from service import store
from service.base.errors import ConflictError, NotFoundError
from service.base.fields import (
    CreatedAt,
    Flag,
    FormDay,
    Id,
    Method,
    Model,
    ModelNumber,
    ReadVersion,
    Reason,
    StudyReport,
    Text,
    Verdict,
    Version,
    drop_empty_fields,
    from_row,
    start_of_day,
)
from service.base.validation import LINE
from service.drawing.study_charts import amount_charts
from service.drawing.study_report import VERDICTS, report_page
from service.jobs.kinds import KINDS
from service.jobs.kinds.predictions import PredictionsIn
from service.store.tables import PlantRow, StudyRow
from service.twin import model_versions
from service.twin.forecasts.aims import plant_time_zone
from service.twin.runtime import Runtime
from service.twin.studies.adoption import (
    EACH_S,
    AccuracyChange,
    AdoptionState,
    StudyState,
    forecast_changes,
    heliostats_to_forecast,
    study_states,
)
from service.twin.studies.field_change import (
    ContradictionError,
    FieldChange,
    read_field_change,
    require_no_contradiction,
)
from service.twin.studies.study import MAX_STUDY_IMAGES, StudyIn, Surfaces, extent_of
from service.web.auth.dependencies import (
    COMPUTE_SLOT,
    OPERATE,
    READ,
    RENDER_SLOT,
    IdentityDep,
    RuntimeDep,
)
from service.web.resources.job_results import study_timelines
from service.web.resources.job_start import study_cost
from service.web.resources.models import ModelOut, current_out, model_out
from service.web.responses.lists import ListQuery, OrderQuery, Page, page
from service.web.responses.openapi import TEXT, problems
from service.web.responses.pages import go_to, go_to_job, named_by_field, render

router = APIRouter(tags=["studies"])
pages = APIRouter(include_in_schema=False)

Number = Annotated[Version, Path(description="Id of the study.")]

REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action"
    " 'none'; frame-ancestors 'none'; sandbox allow-same-origin"
)
"""Content security policy of the report, which includes its style and images.

Nothing else may load or run in it. It keeps this origin, so that its links work.
"""

_MOST_NAMED = 200


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
    adopts: list[str] = Field(
        description=(
            "What its adoption adds to the model: effects, or `correction (no cause)` for what has"
            " no name."
        )
    )
    adoption: InstanceOf[StudyState] = Field(exclude=True, description="For pages.")


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


EffectEnds = dict[Text, date]


class AdoptIn(Model):
    """How to adopt the result of a study."""

    force: Flag = Field(
        default=False,
        description=(
            "Also where another version of the model is current by now, which it then takes the"
            " place of; with a reason, also where it makes photographs after the study"
            " significantly worse."
        ),
    )
    until: Annotated[EffectEnds, Field(max_length=100)] = Field(
        default={},
        description=(
            "Effects that ended, as `GET /v1/studies/{number}/change` names them: day of the first"
            " photograph without each. An adopted study gets these ends in a next version."
        ),
        examples=[{"slope_error": "2026-06-21"}],
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


def _ends_of_form(given: object) -> object:
    """Effects with the days of their ends, from `name day` each."""
    values = [given] if isinstance(given, str) else given
    return dict(one.rpartition(" ")[::2] for one in values) if isinstance(values, list) else values


class DecisionForm(WithdrawIn):
    """The body of a decision as a form.

    ``read`` is the tick below warnings, ``back`` the page to return to, and ``current`` the version
    of the model that it showed. ``ended`` are effects, each with the day of its end.
    """

    read: bool = False
    back: Literal["", "list"] = ""
    ended: Annotated[EffectEnds, BeforeValidator(_ends_of_form)] = Field(default={}, max_length=100)
    current: ReadVersion = None

    _filled = model_validator(mode="before")(drop_empty_fields)

    def return_from(self, number: int) -> Response:
        """Go back to the page."""
        return go_to("/studies#studies-title" if self.back else f"/studies/{number}")


class NewStudyForm(Model):
    """The body of a new study as a form.

    ``heliostats`` are names, and parts of names between asterisks. Without them ``max_heliostats``
    are spread over the field. ``since`` and ``until`` are the first and the last day in the plant's
    zone. Without ``candidates`` all effects are tried.
    """

    heliostats: Annotated[str, StringConstraints(pattern=LINE, max_length=8000)] = ""
    max_heliostats: int = 12
    images: int = 12
    since: FormDay | None = None
    until: FormDay | None = None
    surfaces: Surfaces = "current"
    candidates: list[Text] = Field(default=[], max_length=100)

    _filled = model_validator(mode="before")(drop_empty_fields)

    def body(self, session: Session, zone: str) -> StudyIn:
        """The body of REST. Raises InvalidInputError if no heliostat has a given part of a name."""
        names = _names(session, self.heliostats.replace(",", " ").split())
        is_choice = 0 < len(self.candidates) < len(CATALOGUE)
        changes = {
            "heliostats": names or None,
            "since": start_of_day(self.since, zone),
            "until": start_of_day(self.until, zone, 1),
            "candidates": self.candidates if is_choice else None,
        }
        with named_by_field():
            return StudyIn.model_validate(self.model_dump() | changes)


def _names(session: Session, words: Sequence[str]) -> list[str]:
    """The names that the words give; a word with an asterisk is a part of names."""
    names: dict[str, None] = {}
    for word in words:
        if "*" not in word:
            names[word] = None
            continue
        found = store.list_heliostats(session, _MOST_NAMED + 1, search=word.replace("*", ""))
        if not found:
            raise InvalidInputError(f"heliostats: no heliostat has a name like {word}")
        names |= dict.fromkeys(row.name for row in found)
    return list(names)


# --- data


def _summaries(session: Session, rows: Sequence[StudyRow]) -> list[StudySummary]:
    states = study_states(session, rows)
    return [from_row(StudySummary, row, **_about(states[row.id])) for row in rows]


def _about(state: StudyState) -> dict[str, object]:
    questions = [question.finding for question in state.questions]
    return {
        "adopted": state.adopted,
        "state": state.state,
        "open_questions": questions,
        "adopts": state.adopts,
        "adoption": state,
    }


def study_figures(runtime: Runtime, study: StudyOut) -> dict[str, object]:
    """What the page of a study draws."""
    with runtime.database.reading() as session:
        taken = store.times_of_photographs(session, study.before.per_image)
        zone = plant_time_zone(session, runtime.settings.time_zone)
        has_page = store.has_study_page(session, study.id)
        outdated = store.outdated_surfaces(session, model_versions.current_version(session))
    n_forecasts = len(heliostats_to_forecast(study.heliostats))
    found = study.discrepancy
    return {
        "timelines": study_timelines(study, taken, zone),
        "amounts": [] if found is None else amount_charts(found.model_dump()["coefficients"]),
        "parameters": [
            (effect, name, fitted)
            for effect in study.effects
            for name, fitted in effect.parameters.items()
        ],
        "accuracy": AccuracyChange.of(study.before.per_image, study.accuracies),
        "n_forecasts": n_forecasts,
        "forecast_s": EACH_S * n_forecasts,
        "has_page": has_page,
        "outdated": outdated,
    }


def model_history(runtime: Runtime) -> dict[str, object]:
    """The plant's model for the page of all studies: its versions, and what they outdate."""
    with runtime.database.reading() as session:
        is_set = session.get(PlantRow, 1) is not None
        return {
            "current": model_versions.get_model(session) if is_set else None,
            "versions": model_versions.list_models(session),
            "outdated": store.outdated_surfaces(session, model_versions.current_version(session)),
        }


def outdated_surfaces(runtime: Runtime) -> list[store.Outdated]:
    """Active surfaces that another version of the model made."""
    with runtime.database.reading() as session:
        return store.outdated_surfaces(session, model_versions.current_version(session))


def body_of_form(runtime: Runtime, form: NewStudyForm) -> StudyIn:
    """The body of REST that a form means."""
    with runtime.database.reading() as session:
        return form.body(session, plant_time_zone(session, runtime.settings.time_zone))


def new_study_figures(runtime: Runtime, form: NewStudyForm) -> dict[str, object]:
    """What a study would use, and its expected duration."""
    body = body_of_form(runtime, form)
    with runtime.database.reading() as session:
        extent = extent_of(session, body)
        cost = study_cost(session, extent.n_photographs, body.candidates)
    return {
        "effects": {name: kind.about.partition(": ")[2] for name, kind in CATALOGUE.items()},
        "extent": extent,
        "cost": cost,
        "n_effects": len(body.candidates or CATALOGUE),
        "least": MIN_IMAGES,
        "most": MAX_STUDY_IMAGES,
    }


def _report(runtime: Runtime, number: int, crumbs: str) -> HTMLResponse:
    with runtime.database.reading() as session:
        row = store.get_study(session, number, page=True)
    if row.html is None:
        raise NotFoundError(f"study {number} came as a report without a page")
    page_of_report = report_page(row.html, f"Study {number}: {VERDICTS[row.verdict]}", crumbs)
    return HTMLResponse(page_of_report, headers={"Content-Security-Policy": REPORT_POLICY})


# --- lists and studies


class StudiesQuery(ListQuery):
    """Which studies are listed, newest first by default."""

    verdict: Annotated[Verdict | None, Query(description="Only those of this verdict.")] = None
    order: OrderQuery = "down"


@router.get("/studies", responses=problems(), dependencies=[READ])
def list_studies(
    query: Annotated[StudiesQuery, Query()], runtime: RuntimeDep
) -> Page[StudySummary]:
    """List studies, newest first."""
    with runtime.database.reading() as session:
        rows = store.list_studies(session, query.portion, query.verdict)
        return page(_summaries(session, rows), query.limit)


@pages.get("/studies", dependencies=[READ])
def get_studies_page(
    request: Request,
    runtime: RuntimeDep,
    studies: Annotated[Page[StudySummary], Depends(list_studies)],
) -> HTMLResponse:
    """Studies, and the versions of the plant model that were adopted from them."""
    after = request.query_params.get("after")
    older = request.url.include_query_params(after=studies.next) if studies.next else None
    about = model_history(runtime)
    return render(request, "studies.html", studies=studies.items, after=after, older=older, **about)


@pages.get("/studies/new", dependencies=[READ, RENDER_SLOT])
def get_new_study_page(
    request: Request, form: Annotated[NewStudyForm, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """The form, with the photographs that a study would use and its expected duration."""
    return render(request, "new_study.html", form=form, **new_study_figures(runtime, form))


@pages.post("/studies", dependencies=[OPERATE])
def post_study_form(
    form: Annotated[NewStudyForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Enqueue the study, and go to the page of the job."""
    return go_to_job(runtime, KINDS["studies"], body_of_form(runtime, form), identity)


@router.get(
    "/studies/{number}",
    responses=problems(404),
    dependencies=[READ],
    response_model_exclude_unset=True,
)
def get_study(number: Number, runtime: RuntimeDep) -> StudyOut:
    """Get a study: its verdict, its results, and their benefit."""
    with runtime.database.reading() as session:
        row = store.get_study(session, number)
        (summary,) = _summaries(session, [row])
    return StudyOut.model_validate({**row.report, **dict(summary), "skipped": row.skipped})


@pages.get("/studies/{number}", dependencies=[READ])
def get_study_page(
    request: Request, runtime: RuntimeDep, study: Annotated[StudyOut, Depends(get_study)]
) -> HTMLResponse:
    """A study with its report, and the button that adopts its result."""
    return render(request, "studied.html", study=study, **study_figures(runtime, study))


@pages.get("/studies/{number}/change", dependencies=[READ, RENDER_SLOT, COMPUTE_SLOT])
def get_change_page(
    request: Request, runtime: RuntimeDep, study: Annotated[StudyOut, Depends(get_study)]
) -> HTMLResponse:
    """What adopting a study would change in forecasts. They are computed for this page."""
    if not study.adopts:
        raise ConflictError(f"study {study.id} found no effect; adopting it changes nothing")
    return render(
        request,
        "study_change.html",
        study=study,
        accuracy=AccuracyChange.of(study.before.per_image, study.accuracies),
        changes=forecast_changes(runtime, study.id),
        field=read_field_change(runtime, study.id),
    )


@router.get(
    "/studies/{number}/change", responses=problems(404, 409), dependencies=[READ, COMPUTE_SLOT]
)
def get_study_change(number: Number, runtime: RuntimeDep) -> FieldChange:
    """Get what adoption changes in forecasts of stored photographs.

    They are of the whole field, and of the time after the study. They are forecast for this
    response. Adopting does the same, and answers 409 if `is_harmful`.
    """
    return read_field_change(runtime, number)


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
    return _report(runtime, number, "heliotwin study")


@pages.get("/studies/{number}/report", dependencies=[READ])
def get_study_report_page(number: Number, runtime: RuntimeDep) -> HTMLResponse:
    """The report as a separate page, with links back to its study."""
    crumbs = 'heliotwin / <a href="/studies">studies</a> / <a href="/studies/{0}">{0}</a> / report'
    return _report(runtime, number, Markup(crumbs).format(number))


# --- decisions


def _adopt(
    runtime: Runtime, number: int, actor: str, asked: AdoptIn, shown: int | None = None
) -> AdoptedOut:
    with runtime.database.reading() as session:
        is_current = model_versions.is_current(session, number)
    if not (is_current and not asked.until) and not (asked.force and asked.reason):
        require_no_contradiction(runtime, number, asked.until)

    def adopt(session: Session) -> AdoptedOut:
        row = model_versions.adopt(
            session, number, actor, asked.force, asked.reason, shown, asked.until
        )
        outdated = {
            one.heliostat: one.version for one in store.outdated_surfaces(session, row.version)
        }
        return AdoptedOut(**dict(model_out(row, is_current=True)), outdated_surfaces=outdated)

    return runtime.database.run_in_transaction(adopt)


@router.post(
    "/studies/{number}/adopt",
    status_code=status.HTTP_201_CREATED,
    responses=problems(404, 409, 413),
    dependencies=[OPERATE, COMPUTE_SLOT],
)
def adopt_study(
    number: Number, runtime: RuntimeDep, identity: IdentityDep, request: AdoptIn | None = None
) -> AdoptedOut:
    """Adopt the result of a study. It becomes the current version of the plant model.

    What has no name is adopted as a correction, and never as a cause. The response is 409 if what
    was found explains only a part of the error, or if a correction makes heliostats or days worse
    that no fit saw. It is also 409 if it makes photographs after the study significantly worse.
    """
    return _adopt(runtime, number, identity.name, request or AdoptIn())


@pages.post("/studies/{number}/adopt", dependencies=[OPERATE, COMPUTE_SLOT])
def post_adopt_form(
    number: Number,
    form: Annotated[DecisionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Adopt the result of a study as the next plant model."""
    if form.reason and not form.read and get_study(number, runtime).open_questions:
        raise ConflictError("read: tick 'I have read this' below the warning")
    asked = AdoptIn(force=form.read, reason=form.reason, until=form.ended)
    try:
        _adopt(runtime, number, identity.name, asked, form.current)
    except ContradictionError:  # its page shows the change, and offers what to do
        return go_to(f"/studies/{number}/change#adopt-title")
    return form.return_from(number)


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


@pages.post("/studies/{number}/withdraw", dependencies=[OPERATE])
def post_withdraw_form(
    number: Number,
    form: Annotated[DecisionForm, Form()],
    runtime: RuntimeDep,
    identity: IdentityDep,
) -> Response:
    """Withdraw the adopted model."""
    withdraw_study(number, runtime, identity, form)
    return form.return_from(number)


@pages.post("/studies/predictions", dependencies=[OPERATE])
def post_predict_again_form(
    runtime: RuntimeDep, identity: IdentityDep, method: Annotated[Method, Form()] = "refined"
) -> Response:
    """Predict the active surfaces again that another version of the model made.

    Go to the page of the job.
    """
    names = [surface.heliostat for surface in outdated_surfaces(runtime) if not surface.waits]
    if not names:
        raise ConflictError(
            "all surfaces were made by the current model, or one that was waits aside"
        )
    body = PredictionsIn(heliostats=names, method=method)
    return go_to_job(runtime, KINDS["predictions"], body, identity)
