"""Form of a study: heliostats, days, surfaces and effects, with its cost before it starts."""

from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse
from pydantic import Field, StringConstraints, ValidationError, model_validator
from sqlalchemy.orm import Session

from model.effects import CATALOGUE
from model.errors import InvalidInputError
from model.study.loop import MIN_IMAGES
from service import store
from service.base.fields import FormDay, Model, Text, drop_empty_fields, start_of_day
from service.base.names import LINE
from service.jobs.costs import study_cost
from service.jobs.enqueuing import enqueue
from service.jobs.kinds import studies
from service.jobs.kinds.studies import MAX_STUDY_IMAGES, StudyIn
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.studies.study import StudyRequest, Surfaces, extent_of
from service.web.auth.dependencies import OPERATE, READ, RENDER_SLOT, IdentityDep, RuntimeDep
from service.web.responses.pages import go_to, render

router = APIRouter(include_in_schema=False, prefix="/studies")

_MOST_NAMED = 200


class NewStudyForm(Model):
    """The fields of the form.

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

    def payload(self, session: Session, zone: str) -> StudyIn:
        """The payload of the job.

        Raises
        ------
        InvalidInputError
            If no heliostat has a name with a given part.
        """
        names = _names(session, self.heliostats.replace(",", " ").split())
        try:
            return StudyIn(
                heliostats=names or None,
                max_heliostats=self.max_heliostats,
                images=self.images,
                since=start_of_day(self.since, zone),
                until=start_of_day(self.until, zone, 1),
                surfaces=self.surfaces,
                candidates=self.candidates if 0 < len(self.candidates) < len(CATALOGUE) else None,
            )
        except ValidationError as error:
            raise RequestValidationError(error.errors()) from error


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


@router.get("/new", dependencies=[READ, RENDER_SLOT])
def get_new_study_page(
    request: Request, form: Annotated[NewStudyForm, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """The form, with the photographs that a study would use and its expected duration."""
    with runtime.database.reading() as session:
        zone = plant_time_zone(session, runtime.settings.time_zone)
        payload = form.payload(session, zone)
        extent = extent_of(session, StudyRequest(**payload.model_dump()))
        return render(
            request,
            "new_study.html",
            form=form,
            effects={name: kind.about.partition(": ")[2] for name, kind in CATALOGUE.items()},
            extent=extent,
            cost=study_cost(session, extent.n_photographs, payload.candidates),
            n_effects=len(payload.candidates or CATALOGUE),
            least=MIN_IMAGES,
            most=MAX_STUDY_IMAGES,
        )


@router.post("", dependencies=[OPERATE])
def post_study_form(
    form: Annotated[NewStudyForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Enqueue the study, and go to the page of the job."""
    with runtime.database.reading() as session:
        payload = form.payload(session, plant_time_zone(session, runtime.settings.time_zone))
    return go_to(f"/jobs/{enqueue(runtime, studies.KIND, payload, identity.name).id}")
