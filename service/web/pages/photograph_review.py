"""Queue of photographs to review: accept, exclude or skip each, and undo."""

from contextlib import suppress
from typing import Annotated, Literal

from fastapi import APIRouter, Form, Query, Request, Response
from fastapi.responses import HTMLResponse

from model.errors import InvalidInputError, ModelError
from service.base.errors import NotFoundError, ServiceError
from service.base.fields import ReadVersion, Reason, Version
from service.drawing.charts import PlanePicture
from service.store import audit
from service.store.photographs.correction_log import newest_correction
from service.store.photographs.groups import count_groups, get_group, list_groups
from service.store.tables import CorrectionRow, HeliostatRow, MeasurementRow
from service.twin.forecasts.aim_sources import plant_time_zone
from service.twin.photographs.corrections import (
    NothingToChangeError,
    PhotographChanges,
    correct_photograph,
)
from service.twin.photographs.display import compare_one
from service.web.auth.dependencies import COMPUTE_SLOT, OPERATE, READ, IdentityDep, RuntimeDep
from service.web.resources.heliostat_figures import comparison_figures
from service.web.resources.photographs import PhotographsQuery
from service.web.responses.pages import go_to, render

_PATH = "/photographs/review"
router = APIRouter(include_in_schema=False, prefix=_PATH)

REASONS = (
    "clouds",
    "another heliostat's light on it",
    "not on the target",
    "overexposed",
    "another heliostat",
    "wrong time or sun",
    "other",
)
"""Reasons to exclude that the page offers."""


class ReviewQuery(PhotographsQuery):
    """Filters as of the list, the shown photograph ``at``, and the correction to undo."""

    at: Version | None = None
    undo: Version | None = None

    @property
    def filters(self) -> dict[str, str]:
        """The filters without what the page shows."""
        shown = PhotographsQuery.model_fields
        return {name: one for name, one in super().filters.items() if name in shown}


class ReviewForm(ReviewQuery):
    """The buttons: ``next`` is the photograph after this one."""

    at: Version
    next: Version | None = None
    action: Literal["accept", "exclude"]
    reason: Reason = "reviewed"
    version: ReadVersion = None


class UndoForm(ReviewQuery):
    """The button that undoes the last exclusion."""

    undo: Version


@router.get("", dependencies=[READ, COMPUTE_SLOT])
def get_review_page(
    request: Request, query: Annotated[ReviewQuery, Query()], runtime: RuntimeDep
) -> HTMLResponse:
    """A photograph with its verdict and forecast, its place in the queue, and the buttons."""
    with runtime.database.reading() as session:
        version = newest_correction(session)
        chosen = query.filter(session, plant_time_zone(session, runtime.settings.time_zone))
        listed = list_groups(session, chosen, 1, query.after) if query.at is None else []
        group = get_group(session, query.at) if query.at else next(iter(listed), None)
        total, place, following = count_groups(session, chosen), 0, None
        if group is not None:
            row = next(image for image in group.images if image.id == group.mark)
            place = min(count_groups(session, chosen, row) + 1, max(total, 1))
            following = next(iter(list_groups(session, chosen, 1, group.mark)), None)
    compared, trouble = [], None
    if group is not None and group.best.image_sha256 and group.verdict != "refused":
        try:
            compared = [compare_one(runtime, group.heliostat, group.best.identifier)]
        except (ModelError, ServiceError) as error:
            trouble = str(error)
    return render(
        request,
        "photograph_review.html",
        query=query,
        version=version,
        group=group,
        images={image.kind: image for image in group.images if image.has_file} if group else {},
        following=following,
        place=place,
        total=total,
        comparisons=comparison_figures(compared, runtime.settings.figure_scales["flux_difference"]),
        trouble=trouble,
        plane_picture=PlanePicture,
        reasons=REASONS,
    )


@router.post("", dependencies=[OPERATE, COMPUTE_SLOT])
def post_review_form(
    form: Annotated[ReviewForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Accept or exclude a photograph, and go to the next one."""
    with runtime.database.reading() as session:
        group = get_group(session, form.at)
    undo = None
    if form.action == "accept" and group.verdict == "refused":
        raise InvalidInputError(
            f"action: {group.name} was refused by its measurement; correct it on its page instead"
        )
    changes = PhotographChanges(form.reason, excluded=form.action == "exclude")
    name, identifier, actor = group.heliostat, group.best.identifier, identity.name
    try:
        corrected = correct_photograph(runtime, name, identifier, changes, actor, form.version)
        undo = max(entry.id for entry in corrected.history)
    except NothingToChangeError:
        subject = f"heliostat {name} {identifier}"
        runtime.database.run_in_transaction(
            lambda session: audit.record(session, actor, "measurement.reviewed", subject)
        )
    if form.next is None:
        return go_to(form.link(_PATH, after=form.at, undo=undo))
    return go_to(form.link(_PATH, at=form.next, undo=undo))


@router.post("/undo", dependencies=[OPERATE, COMPUTE_SLOT])
def post_undo_form(
    form: Annotated[UndoForm, Form()], runtime: RuntimeDep, identity: IdentityDep
) -> Response:
    """Undo an exclusion or acceptance, and show the photograph again."""
    with runtime.database.reading() as session:
        correction = session.get(CorrectionRow, form.undo)
        if correction is None or "excluded" not in correction.before:
            raise NotFoundError(f"undo: there is no exclusion {form.undo}")
        row = session.get_one(MeasurementRow, correction.measurement_id)
        name = session.get_one(HeliostatRow, row.heliostat_id).name
    changes = PhotographChanges("review undone", excluded=bool(correction.before["excluded"]))
    with suppress(NothingToChangeError):
        correct_photograph(runtime, name, row.identifier, changes, identity.name, form.undo)
    return go_to(form.link(_PATH, at=row.id))
